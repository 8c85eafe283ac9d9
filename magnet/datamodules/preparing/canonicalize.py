"""A recording to canonical clips: y up, 30 fps at exact times, floor at 0, origin, cuts at lost tracking."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from magnet.body import Body
from magnet.body.family import title
from magnet.body.fit import BodyFit, fit_body, floor_height
from magnet.body.floor import off_their_floor
from magnet.datamodules.clip import Clip, Split
from magnet.datamodules.preparing import check_motion, check_people
from magnet.datamodules.preparing.check_people import Flag
from magnet.datamodules.reading.recording import Axis, DataError, Family, Recording
from magnet.export.rig import UP
from magnet.export.smpl_keys import SMPLX_PELVIS
from magnet.motion.frames import rigid
from magnet.motion.resample import resample_points, resample_rotations, resample_valid
from magnet.motion.rotations import from_quat, quat_from_rotvec, to_quat
from magnet.motion.runs import filled, true_runs
from magnet.motion.scene import BODY_JOINTS, FPS, Scene, cat_agents

CANONICALIZE_VERSION = 5
"""Raise it whenever the same recording would become other clips: prepared takes are then made anew."""
FLOOR_PERCENTILE = 5.0
"""Of everybody's lowest soles over a whole take: people stand nearly always, and few soles are tracked too low."""

R_WORLD_FILE: dict[Axis, Tensor] = {axis: torch.from_numpy(UP[axis.removeprefix("+")]) for axis in get_args(Axis)}
"""Rotation that takes a file's up axis to +y."""


@dataclass(frozen=True)
class CanonicalizeOptions:
    """What can be chosen about `canonicalize`; part of what a prepared store is remembered by.

    Args:
        min_frames: shortest clip that is kept, at 30 fps.
        up: the files' up axis, in place of the one that the reader declares; None: the reader's.
        trust_fps: do not refuse people who move too fast or too slowly for the declared frame rate.
    """

    min_frames: int = 30
    up: Axis | None = None
    trust_fps: bool = False

    def __post_init__(self) -> None:
        if self.min_frames < 1:
            raise ValueError(f"min_frames: got {self.min_frames}, expected at least 1")
        if self.up is not None and self.up not in R_WORLD_FILE:
            raise ValueError(f"up: got {self.up!r}, expected one of {', '.join(R_WORLD_FILE)}")


@dataclass(frozen=True)
class WorldMotion:
    """T frames of P people at 30 fps on their way to clips."""

    rotations: Tensor  # (T, P, 22, 3, 3) float32, the pelvis's in the world, others relative to their parents
    pelvis: Tensor  # (T, P, 3) float64 metres, the joint
    betas: Tensor  # (P, 10)
    valid: NDArray[np.bool_]  # (T, P)
    joints: Tensor  # (T, P, 22, 3) float32 world
    notes: tuple[str, ...] = ()

    def turned(self, R: Tensor) -> WorldMotion:
        """Seen from a world turned by R_new_old (3, 3) float64, or each from an own one, (P, 3, 3)."""
        rotations = self.rotations.clone()
        rotations[:, :, 0] = R.float() @ rotations[:, :, 0]
        pelvis = self.pelvis @ R.T if R.ndim == 2 else (self.pelvis[..., None, :] @ R.mT)[..., 0, :]
        return replace(self, rotations=rotations, pelvis=pelvis, joints=self.joints @ R.mT.float())

    def lowered(self, height: float) -> WorldMotion:
        """With the floor, now at `height`, at 0."""
        down = torch.tensor([0.0, height, 0.0], dtype=torch.float64)
        return replace(self, pelvis=self.pelvis - down, joints=self.joints - down.float())


class Canonicalized(NamedTuple):
    """The clips of one take, and what should be known about them."""

    clips: list[Clip]
    notes: tuple[str, ...]


def canonicalize(
    recording: Recording,
    body: Body,
    name: str,
    source: str,
    split: Split,
    family: Family = "smplx",
    options: CanonicalizeOptions | None = None,
) -> Canonicalized:
    """Convert a recording as read to clips of `body`.

    Args:
        recording: as read, at any rate and with any up axis.
        body: whose shape numbers `betas` are; for positions: the body to fit.
        name: the take's; parts of it are called "name [start:stop]" by their frames at 30 fps.
        source: the data set, whose `family` says what its files hold.

    Raises:
        DataError: NaN, units, up axis or frame rate that cannot be right, no stretch that is long enough, or
            positions that the body does not fit within 4 cm.
    """
    options = options or CanonicalizeOptions()
    recording = of_body(recording, body, source, family)
    names = recording.persons
    notes = list(recording.notes)
    for p, gender in enumerate(recording.genders):  # of a body that nobody gave
        notes.append(f"{names[p] if names else f'person {p}'}: {gender}; the shape is used with the body model given")
    motion, flags, flagged = _moved(recording, body, options)
    quat = to_quat(motion.rotations).numpy()
    flags += check_people.jumps(quat, motion.joints.numpy(), motion.valid, but=flags)
    flagged += check_people.described(flags, names, FPS)
    notes += [*flagged, *motion.notes]
    jumps = check_motion.jumps(motion.pelvis.numpy(), motion.valid, FPS)
    if len(jumps):
        notes.append(f"cut at {len(jumps)} jumps of more than {check_motion.JUMP:g} m between frames")
    if not options.trust_fps:
        check_motion.check_rate(
            motion.joints[:, :, check_motion.WALKING].numpy(), motion.valid, recording.said_fps or recording.fps, FPS
        )
    soles = floor_height(motion.joints, body, motion.betas.float()).numpy()
    floor = float(np.percentile(soles[motion.valid], FLOOR_PERCENTILE))
    heights = [
        float(np.percentile(own[there], FLOOR_PERCENTILE)) if there.any() else np.nan
        for own, there in zip(soles.T, motion.valid.T, strict=True)
    ]
    notes += off_their_floor([height - floor for height in heights], names)
    motion = motion.lowered(floor)
    cuts = sorted({*jumps.tolist(), *(flag.start for flag in flags if flag.cut)})
    clips = []
    for start, stop in _stretches(motion.valid, cuts, flagged, options.min_frames):
        label = name if (start, stop) == (0, len(motion.valid)) else f"{name} [{start}:{stop}]"
        clips.append(Clip(_scene(motion, start, stop, body, label), label, source, split))
    return Canonicalized(clips, tuple(notes))


def _moved(recording: Recording, body: Body, options: CanonicalizeOptions) -> tuple[WorldMotion, list[Flag], list[str]]:
    """At 30 fps, y up; what is wrong with whom there, and in words what was so in the file's own frames."""
    up, valid = options.up or recording.up, check_motion.usable(recording)
    if recording.poses is not None:
        check_motion.check_angles(recording.poses, valid, recording.persons)
    valid, wild = check_people.screened(recording, valid)
    if recording.poses is not None:
        motion, flags = _posed(recording, valid, body)
        own = recording.ups if options.up is None else ()  # each one's axis is known, so that somebody may lie
        if own:
            motion, up = motion.turned(torch.stack([R_WORLD_FILE[axis] for axis in own])), "+y"
        check_motion.check_up(up, motion.joints.numpy(), motion.valid, chosen=bool(own) or options.up is not None)
        motion = motion.turned(R_WORLD_FILE[up])
        check_motion.check_lengths(motion.joints.numpy(), motion.pelvis.numpy(), motion.valid)
    else:
        motion, flags = _fitted(recording, valid, body, up, options)
    return motion, flags, check_people.described(wild, recording.persons, recording.fps)


def of_body(recording: Recording, body: Body, source: str, family: Family) -> Recording:
    """The recording if its shape numbers can be used with `body`.

    Where files may hold anything (`family` any), rotations of SMPL's family go with the open body in its mean shape.
    """
    if recording.poses is None or recording.body == body.id:
        return recording
    if recording.body:
        raise DataError(
            f"its shape numbers belong to body {recording.body!r}, not to {body.id!r}: give that one's file with "
            "--body, or no --body for the open one"
        )
    if not body.id.startswith("open"):
        if recording.shapes_of and body.family not in ("", recording.shapes_of):
            raise DataError(
                f"its shape numbers are {title(recording.shapes_of)}'s by the number of joints, but body {body.id!r} "
                f"is {title(body.family)}'s: give that one's file with --body or --bodies, or none for the open one"
            )
        return recording
    if family != "any":
        raise DataError(
            f"rotations and shape numbers of {source} belong to SMPL-X's body, not to {body.id}: "
            "give --body SMPLX_NEUTRAL.npz"
        )
    said = f"rotations of SMPL's family on body {body.id} in its mean shape: limbs are approximate without --body FILE"
    flat = np.zeros_like(np.asarray(recording.betas))
    if recording.ups and recording.transl is not None:  # in worlds of different axes it matters whose pelvis is at rest
        recording = replace(recording, transl=None, pelvis=recording.transl + np.asarray(SMPLX_PELVIS))
    return replace(recording, betas=flat, genders=(), notes=(*recording.notes, said))


# -- the two kinds of recording ----------------------------------------------------------------


def _posed(recording: Recording, valid: NDArray[np.bool_], body: Body) -> tuple[WorldMotion, list[Flag]]:
    place = recording.transl if recording.pelvis is None else recording.pelvis
    assert recording.poses is not None and place is not None and recording.betas is not None
    poses = filled(np.asarray(recording.poses, dtype=np.float64), valid)
    place = filled(np.asarray(place, dtype=np.float64), valid)
    check_motion.check_apart(place, valid)
    betas = torch.from_numpy(np.array(recording.betas, dtype=np.float64))
    quat = quat_from_rotvec(torch.from_numpy(poses))
    quat = resample_rotations(quat, recording.fps)
    rotations = from_quat(quat).float()
    rest = body.rest_joints(betas)
    check_people.check_stature(rest.numpy(), recording.persons)
    # SMPL's root turns about the rest pelvis and is moved by transl after that
    pelvis = resample_points(torch.from_numpy(place), recording.fps)
    if recording.pelvis is None:
        pelvis = pelvis + rest[:, 0]
    joints = body.forward_kinematics(rotations[:, :, 1:], rigid(rotations[:, :, 0], pelvis.float()), betas.float())
    good = resample_valid(valid, recording.fps)
    flags = check_people.frozen(*check_people.held(pelvis.numpy(), quat.numpy()), good)
    good = check_people.without(good, flags, recording.persons, FPS)
    return WorldMotion(rotations, pelvis, betas, good, joints), flags


def _fitted(
    recording: Recording, valid: NDArray[np.bool_], body: Body, up: Axis, options: CanonicalizeOptions
) -> tuple[WorldMotion, list[Flag]]:
    assert recording.positions is not None
    positions = filled(np.asarray(recording.positions, dtype=np.float64), valid)
    points = resample_points(torch.from_numpy(positions), recording.fps)
    good = resample_valid(valid, recording.fps)
    flags = check_people.frozen(*check_people.held_points(points.numpy()), good)
    good = check_people.without(good, flags, recording.persons, FPS)
    check_motion.check_limbs(points.numpy(), recording.joints, good)
    spread = np.full((*points.shape[:2], BODY_JOINTS, 3), np.nan)
    spread[:, :, list(recording.joints)] = points.numpy()
    check_motion.check_up(up, spread, good, chosen=options.up is not None)
    flags += check_people.jumps(None, spread, good)
    spread = spread @ R_WORLD_FILE[up].numpy().T
    walking = spread[:, :, check_motion.WALKING]
    if np.isfinite(walking).all():
        check_motion.check_apart(spread[:, :, 0], good)
        check_motion.check_lengths(spread, spread[:, :, 0], good)
        if not options.trust_fps:  # before a fit of minutes
            check_motion.check_rate(walking, good, recording.said_fps or recording.fps, FPS)
    targets = (points @ R_WORLD_FILE[up].T).float()
    try:
        if recording.skeletons:
            people, offs = zip(*(rig.onto(body, up, FPS) for rig in recording.skeletons), strict=True)
            scene = cat_agents(people)
            residual = torch.stack(offs, dim=1)
        else:
            fit = fit_positions(recording, targets, good, body, up)
            scene, residual = fit.scene, fit.residual
    except ValueError as error:
        raise DataError(str(error)) from error
    rotations = torch.cat([scene.T_world_root[0, :, :, None, :3, :3], scene.body_rot[0]], dim=2)
    off = 100 * residual.numpy()[good]
    said = f"mean residual {off.mean():.1f} cm, 95 % below {np.percentile(off, 95):.1f} cm"
    notes = (f"body {body.id} fitted to {'skeletons' if recording.skeletons else 'positions'}: {said}",)
    pelvis = scene.T_world_root[0, :, :, :3, 3].double()
    return WorldMotion(rotations, pelvis, scene.betas[0].double(), good, body.joints(scene)[0], notes), flags


def fit_positions(
    recording: Recording,
    targets: Tensor,
    valid: NDArray[np.bool_],
    body: Body,
    up: Axis = "+y",
    progress: Callable[[int, int], None] | None = None,
) -> BodyFit:
    """A body fitted to a recording's positions and to the rotations that it may know.

    targets: (T, P, M, 3) its positions at 30 fps, y up; valid: (T, P); up: axis of the file's world, which hints are in
    progress: is told of steps done, and of how many there are

    Raises:
        ValueError: the body does not fit.
    """
    rotations = weights = None
    if recording.hints is not None:
        rotations, weights = recording.hints(body.rest_joints(torch.zeros(10)))
        if up != "+y":
            rotations = R_WORLD_FILE[up] @ rotations
    return fit_body(
        targets,
        recording.joints,
        body,
        rotations=rotations,
        weights=weights,
        valid=torch.from_numpy(valid),
        grounded=True,
        fps=FPS,
        progress=progress,
    )


# -- cutting -----------------------------------------------------------------------------------


def _stretches(valid: NDArray[np.bool_], cuts: list[int], flagged: list[str], least: int) -> list[tuple[int, int]]:
    """Stretches of `least` frames or more between cuts where everybody is valid: first frame, and one past the last.

    valid: (T, P); cuts: frames that begin a stretch of their own; flagged: what was wrong, for messages
    """
    together: NDArray[np.bool_] = np.logical_and.reduce(valid, axis=1)
    frames = len(together)
    parts = pairwise([0, *cuts, frames])
    found = [(first + a, first + b) for first, end in parts for a, b in true_runs(together[first:end], least)]
    if not found:
        raise DataError(
            f"no stretch of {least} frames at 30 fps where everybody is tracked: {frames} frames, "
            f"{int(together.sum())} of them valid{''.join(f'; {one}' for one in flagged)}; lower --min_frames to keep "
            f"shorter ones"
        )
    return found


def _scene(motion: WorldMotion, start: int, stop: int, body: Body, label: str) -> Scene:
    """Frames `start:stop`, at first about the origin."""
    rotations, pelvis = motion.rotations[start:stop], motion.pelvis[start:stop]
    origin = pelvis[0].mean(dim=0) * torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64)
    return Scene(
        body_rot=rotations[None, :, :, 1:],
        T_world_root=rigid(rotations[:, :, 0], (pelvis - origin).float())[None],
        betas=motion.betas.float()[None],
        present=torch.ones(1, len(motion.betas), dtype=torch.bool),
        fps=FPS,
        body=body.id,
        names=(label,),
    )
