"""CMU's skeleton as joints of a body: which bone is which joint, how the rest poses differ, what counts in a fit."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from magnet.body.apart import widened
from magnet.body.fit import swing
from magnet.datamodules.reading.asf_amc import AmcRecording, AsfSkeleton, Bools, Floats, euler, together
from magnet.datamodules.reading.recording import DataError, Recording
from magnet.errors import counted
from magnet.motion.rotations import from_rotvec, geodesic, to_quat
from magnet.motion.runs import true_runs
from magnet.motion.scene import BODY_JOINTS, FPS

from magnet.body.joints import (  # isort: skip
    ANKLES, ELBOWS, HEAD, HIPS, KNEES, L_ANKLE, L_ELBOW, L_FOOT, L_HIP, L_KNEE, L_SHOULDER, L_WRIST, NECK,
    PARENTS, PELVIS, R_ANKLE, R_ELBOW, R_FOOT, R_HIP, R_KNEE, R_SHOULDER, R_WRIST, SHOULDERS, SPINE1, SPINE2,
    SPINE3, TOES, WRISTS,
)  # fmt: skip

JUMP = 0.15
"""Metres between two frames: 9 m/s at 60 fps, which no body joint of the recordings reaches by itself."""
TURNED = 65.0
"""Degrees between the lines through hips and shoulders: further is a pelvis fitted the wrong way round."""
FOLDED = 70.0
"""Degrees between the pelvis and the spine's first bone, further than which a pelvis is wrong as well."""
REACH = 0.35
"""Seconds within which a jump back belongs to the jump before it, and all between is wrong."""
SHORT = 0.1
"""Seconds of bad frames up to which interpolation stands in for them; longer stretches are masked."""
MARGIN = 2
"""Frames beside a jump that the capture's own filter has smeared."""
UNMODELLED = ("fingers", "thumb", "hand")


@dataclass(frozen=True)
class Glitches:
    """What was wrong with one person's recording."""

    jumps: int  # pairs of frames between which any bone end jumps, fingers included
    body_jumps: int  # those among them where a bone jumps that the body model has
    repaired: Bools  # (T,) frames replaced by interpolation
    masked: Bools  # (T,) those of them that stand in too long a stretch to be trusted


def _turned(recording: AmcRecording, end: Floats) -> Bools:
    """Frames whose pelvis does not go with the trunk. (T,)"""
    names = recording.skeleton.names
    if not {"lhipjoint", "rhipjoint", "lclavicle", "rclavicle", "lowerback"} <= set(names):
        return np.zeros(recording.frames, dtype=bool)
    hips = end[:, names.index("lhipjoint")] - end[:, names.index("rhipjoint")]
    shoulders = end[:, names.index("lclavicle")] - end[:, names.index("rclavicle")]
    cosine = (hips * shoulders).sum(-1) / (np.linalg.norm(hips, axis=-1) * np.linalg.norm(shoulders, axis=-1))
    bend = (np.trace(recording.local[:, names.index("lowerback")], axis1=-2, axis2=-1) - 1) / 2
    return (cosine < np.cos(np.radians(TURNED))) | (bend < np.cos(np.radians(FOLDED)))


def repaired(recording: AmcRecording) -> tuple[AmcRecording, Glitches]:
    """The recording with glitches interpolated over, and what they were."""
    _, end = recording.world()
    far = np.linalg.norm(np.diff(end, axis=0), axis=-1) > JUMP
    body = [k for k, name in enumerate(recording.skeleton.names) if not name.endswith(UNMODELLED)]
    jumps = np.flatnonzero(far[:, body].any(axis=1))
    bad = _turned(recording, end)
    for a, b in true_runs(bad):
        bad[max(0, a - MARGIN) : b + MARGIN] = True
    reach = round(REACH * recording.fps)
    for i, jump in enumerate(jumps):
        bad[max(0, jump + 1 - MARGIN) : jump + 1 + MARGIN] = True
        if i and jump - jumps[i - 1] <= reach:
            bad[jumps[i - 1] + 1 : jump + 1] = True
    masked = np.zeros_like(bad)
    for a, b in true_runs(bad):
        # Without a good frame on both sides there is nothing to interpolate between.
        masked[a:b] = (b - a) / recording.fps > SHORT + 1e-9 or a == 0 or b == recording.frames
    found = Glitches(int(far.any(axis=1).sum()), len(jumps), bad, masked)
    return (recording, found) if not bad.any() or bad.all() else (_bridged(recording, bad), found)


def _bridged(recording: AmcRecording, bad: Bools) -> AmcRecording:
    root, local = recording.root.copy(), recording.local.copy()
    for a, b in true_runs(bad):
        before, after = max(a - 1, 0), min(b, recording.frames - 1)
        if a == 0:
            before = after
        if b == recording.frames:
            after = before
        ends = replace(recording, root=recording.root[[before, after]], local=recording.local[[before, after]])
        filled = ends.at(np.arange(1, b - a + 1) / (b - a + 1))
        root[a:b], local[a:b] = filled.root, filled.local
    return replace(recording, root=root, local=local)


ENDS = {
    L_HIP: "lhipjoint", R_HIP: "rhipjoint", L_KNEE: "lfemur", R_KNEE: "rfemur", L_ANKLE: "ltibia", R_ANKLE: "rtibia",
    L_FOOT: "lfoot", R_FOOT: "rfoot", L_SHOULDER: "lclavicle", R_SHOULDER: "rclavicle", L_ELBOW: "lhumerus",
    R_ELBOW: "rhumerus", L_WRIST: "lwrist", R_WRIST: "rwrist", NECK: "lowerneck",
}  # fmt: skip
"""Joint: the bone whose end it is. The spine's joints lie elsewhere in the two skeletons: only rotations are used.

The bone `wrist` is the last third of the forearm: it lies in one line with `radius` and only rolls. The hand bends at
its end, and so there is the wrist (`radius` ends 7 to 10 cm before it).
"""
WEIGHT = {NECK: 0.1, L_WRIST: 3.0, R_WRIST: 3.0}
"""The neck's joint differs too, and so only leans on the fit; dancers hold hands, so that wrists matter."""
TOUCH, TOUCH_WEIGHT = 0.12, 25.0
"""Metres within which two people's wrists count as touching, and what their weights grow by."""
TURNS = {
    PELVIS: "root", L_HIP: "lfemur", R_HIP: "rfemur", SPINE1: "lowerback", L_KNEE: "ltibia", R_KNEE: "rtibia",
    SPINE2: "upperback", L_ANKLE: "lfoot", R_ANKLE: "rfoot", SPINE3: "thorax", L_FOOT: "ltoes", R_FOOT: "rtoes",
    NECK: "upperneck", HEAD: "head", L_SHOULDER: "lhumerus", R_SHOULDER: "rhumerus", L_ELBOW: "lradius",
    R_ELBOW: "rradius", L_WRIST: "lhand", R_WRIST: "rhand",
}  # fmt: skip
"""Joint: the bone whose rotation it takes."""
LEG_SPREAD = 20.0
"""Degrees that CMU's rest pose has each leg out to the side, foot and toes with it."""
ELBOW_PLANE = 30.0
"""Degrees that CMU's elbows bend upwards of forwards in the rest pose, where ours bend forwards."""
LIMITS = {SPINE1: 60.0, NECK: 80.0, HEAD: 50.0, L_ANKLE: 80.0, R_ANKLE: 80.0}
"""Degrees between a joint's part of the body and its parent's beyond which the bone was recorded wrongly turned."""
FLIP_MARGIN = 4
"""Frames at 30 fps in which a foot swings over into the wrong way round and back."""
ROLL_LIMIT, WRIST_LIMIT = 120.0, 85.0
"""The same for a hand against its forearm: about the forearm's length and away from it."""
FASTEST_PELVIS, FASTEST_HAND, SLOWEST_HAND, LIKELY_FALL = 4.5, 11.5, 0.1, 24.0
"""Metres a second at the 99th percentile (3.1, 8.3 and 1.8 in the recordings); and m/s2 downwards at the 1st."""


def _about(letter: str, degrees: float) -> Tensor:
    angles = np.zeros(3)
    angles["xyz".index(letter)] = np.radians(degrees)
    return torch.from_numpy(euler(angles, "xyz"))


def alignment(skeleton: AsfSkeleton, rest: Tensor) -> Tensor:
    """Rotation of each joint's part of the body from our rest pose to CMU's. rest (22, 3) -> (22, 3, 3)"""
    aligned = torch.eye(3, dtype=torch.float64).repeat(BODY_JOINTS, 1, 1)
    rest = rest.double()

    def align(joint: int, child: int, bone: str, first: Tensor) -> None:
        ours = (first @ (rest[child] - rest[joint])[:, None])[:, 0]
        theirs = torch.from_numpy(skeleton.offset[skeleton.names.index(bone)])
        aligned[joint] = swing(ours, theirs) @ first

    for side, sign in ((0, 1.0), (1, -1.0)):
        spread = _about("z", sign * LEG_SPREAD)
        hip, knee, ankle, toes = (pair[side] for pair in (HIPS, KNEES, ANKLES, TOES))
        for joint, child in ((hip, knee), (knee, ankle), (ankle, toes)):
            align(joint, child, TURNS[joint], spread)
        aligned[toes] = spread
        shoulder, elbow, wrist = (pair[side] for pair in (SHOULDERS, ELBOWS, WRISTS))
        align(shoulder, elbow, TURNS[shoulder], _about("x", -ELBOW_PLANE))
        align(elbow, wrist, TURNS[elbow], _about("x", -ELBOW_PLANE / 2))
    return aligned


def hints(recording: AmcRecording, rest: Tensor) -> Tensor:
    """World rotations of our joints as far as the recording knows them. rest (22, 3) -> (T, 22, 3, 3), NaN elsewhere"""
    names = recording.skeleton.names
    turned, _ = recording.world()
    world = torch.from_numpy(turned)
    aligned = alignment(recording.skeleton, rest)
    known = torch.full((recording.frames, BODY_JOINTS, 3, 3), torch.nan, dtype=torch.float64)
    for joint, bone in TURNS.items():
        known[:, joint] = world[:, names.index(bone)] @ aligned[joint]
    for letter, elbow, wrist in zip("lr", ELBOWS, WRISTS, strict=True):
        forearm, hand = world[:, names.index(f"{letter}radius")], world[:, names.index(f"{letter}hand")]
        half, wrong = _half_roll(forearm.transpose(-1, -2) @ hand)
        # A forearm rolls along all its length: the elbow takes half of it, the wrist the rest.
        known[:, elbow] = forearm @ half @ aligned[elbow]
        known[wrong, wrist] = torch.nan
    for joint, limit in LIMITS.items():
        # Written so that a joint whose parent is not known is not known either.
        wrong = ~(geodesic(known[:, PARENTS[joint]], known[:, joint]) <= np.radians(limit))
        if joint in ANKLES:
            wrong = widened(wrong[None], FLIP_MARGIN)[0]
        known[wrong, joint] = torch.nan
        if joint in ANKLES:
            known[wrong, TOES[ANKLES.index(joint)]] = torch.nan  # the toes went with the foot
    return known


def _half_roll(hand: Tensor) -> tuple[Tensor, Tensor]:
    """Half of a hand's roll about its forearm, which lies along x, and where the hand cannot be right.

    (T, 3, 3) -> (T, 3, 3), the identity where it is wrong; (T,) bool
    """
    x, y, z, w = to_quat(hand).unbind(-1)
    roll = 2 * torch.atan2(x, w)
    roll = torch.atan2(roll.sin(), roll.cos())
    bend = 2 * torch.atan2((y * y + z * z).sqrt(), (x * x + w * w).sqrt())
    wrong = (roll.abs() > np.radians(ROLL_LIMIT)) | (bend > np.radians(WRIST_LIMIT))
    axis = torch.zeros(len(hand), 3, dtype=hand.dtype)
    axis[:, 0] = torch.where(wrong, 0.0, roll / 2)
    return from_rotvec(axis), wrong


@dataclass(frozen=True)
class CMUHints:
    """Rotations of a take's people at 30 fps, and how much each of `ENDS` counts in a fit."""

    recordings: tuple[AmcRecording, ...]
    targets: Tensor  # (T, P, M, 3)

    def __call__(self, rest: Tensor) -> tuple[Tensor, Tensor]:
        """As `FitHints` says."""
        joints = list(ENDS)
        turn = torch.stack([hints(recording, rest) for recording in self.recordings], dim=1)
        weights = torch.tensor([WEIGHT.get(j, 1.0) for j in joints], dtype=torch.float64)
        weights = weights * touching(self.targets, joints)
        for ankle, ball in zip(ANKLES, TOES, strict=True):
            # A foot turned the wrong way round has its ball on the wrong side.
            weights[:, :, joints.index(ball)] *= turn[:, :, ankle].isfinite().all(dim=-1).all(dim=-1)
        return turn, weights


def measured(recordings: Sequence[AmcRecording], trim: bool = False) -> tuple[Recording, tuple[Glitches, ...]]:
    """People captured together as joints at 30 fps, with hints for the fit; and what was mended on the way."""
    recordings = together(recordings, trim)
    mended, glitches = zip(*(repaired(recording) for recording in recordings), strict=True)
    resampled = tuple(recording.resampled(FPS) for recording in mended)
    ends, valid = [], []
    for recording, glitch in zip(resampled, glitches, strict=True):
        _, end = recording.world()
        ends.append(torch.from_numpy(end[:, [recording.skeleton.names.index(ENDS[j]) for j in ENDS]]))
        valid.append(~_seen(glitch.masked, recording.frames, recordings[0].fps))
    targets, good = torch.stack(ends, dim=1), torch.stack(valid, dim=1)
    notes = [
        f"{recording.path.name}: glitches in {counted(int(glitch.repaired.sum()), 'frame')}, "
        f"{int(glitch.masked.sum())} of them too long to be interpolated"
        for recording, glitch in zip(recordings, glitches, strict=True)
        if glitch.repaired.any()
    ]
    recording = Recording(
        fps=FPS,
        up="+y",
        positions=targets.numpy(),
        joints=tuple(ENDS),
        hints=CMUHints(resampled, targets),
        valid=good.numpy(),
        persons=tuple(f"subject {each.path.name.split('_')[0]}" for each in recordings),
        notes=tuple(notes),
        said_fps=recordings[0].fps,
    )
    return recording, tuple(glitches)


def _seen(masked: np.ndarray, frames: int, fps: float) -> Tensor:
    """Which resampled frames lie on or beside a masked one. -> (frames,) bool"""
    at = np.arange(frames) * (fps / FPS)
    low = np.clip(np.floor(at + 1e-9).astype(int), 0, len(masked) - 1)
    high = np.clip(np.ceil(at - 1e-9).astype(int), 0, len(masked) - 1)
    return torch.from_numpy(masked[low] | masked[high])


def touching(targets: Tensor, joints: Sequence[int]) -> Tensor:
    """Weights that grow where wrists of two people come together. (T, P, M, 3) -> (T, P, M)"""
    grown = torch.ones(targets.shape[:3], dtype=targets.dtype)
    wrists = [joints.index(wrist) for wrist in WRISTS]
    for p in range(targets.shape[1]):
        others = [q for q in range(targets.shape[1]) if q != p]
        if others:
            theirs = targets[:, others][:, :, wrists].flatten(1, 2)
            near = torch.cdist(targets[:, p, wrists], theirs).amin(dim=-1)
            grown[:, p, wrists] += TOUCH_WEIGHT * torch.exp(-((near / TOUCH) ** 2))
    return grown


def check_rate(recording: AmcRecording) -> None:
    """Refuse a frame rate at which nobody could move so: it is not in the file, and a wrong one shows in speeds.

    A rate that is wrong by two shows only where somebody jumps or falls, and then gives a warning: 143_35, called
    120 fps, was found so.
    """
    if recording.frames < recording.fps:
        return  # too short to say
    _, end = recording.resampled(FPS).world()
    names = recording.skeleton.names
    pelvis = np.diff(end[:, names.index("root")], axis=0) * FPS
    wrists = np.diff(end[:, [names.index(ENDS[L_WRIST]), names.index(ENDS[R_WRIST])]], axis=0) * FPS
    speed = float(np.percentile(np.linalg.norm(pelvis, axis=-1), 99))
    hand = float(np.percentile(np.linalg.norm(wrists, axis=-1), 99))
    fall = float(-np.percentile(np.diff(pelvis[:, 1]) * FPS, 1))
    found = (
        f"{recording.path}: at {recording.fps:g} fps the pelvis moves at {speed:.1f} m/s, hands at {hand:.1f} m/s "
        f"and the pelvis falls with {fall:.0f} m/s2"
    )
    if hand < SLOWEST_HAND:
        raise DataError(f"{found}: somebody stands still, which nobody does for long; leave the recording out")
    if speed > FASTEST_PELVIS or hand > FASTEST_HAND:
        raise DataError(f"{found}, which nobody does; give the frame rate of its subject with `fps`")
    if fall > LIKELY_FALL:
        warnings.warn(f"{found}, which is unlikely; check the frame rate of its subject (`fps`)", stacklevel=2)
