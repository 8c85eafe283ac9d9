"""Wrong units, up axes and frame rates, found in the motion itself."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magnet.body.joints import (  # isort: skip
    ANKLES, HEAD, HIPS, JOINT_NAMES, L_ANKLE, L_FOOT, NECK, PELVIS, R_ANKLE, R_FOOT, SHOULDERS,
)  # fmt: skip
from magnet.datamodules.preparing.check_people import WILD_ANGLE, who
from magnet.datamodules.reading.recording import Axis, DataError, Recording

Array = NDArray[np.floating[Any]]
Bools = NDArray[np.bool_]

WALKING = [PELVIS, L_ANKLE, L_FOOT, R_ANKLE, R_FOOT]
"""Joints that tell the frame rate: the pelvis, then each foot's two."""
TURN = 2 * math.pi * 1.05
"""Longest rotation vector in radians; even recordings with unwrapped angles stay below."""
STANDING, BESIDE = 0.5, 0.75
"""Metres that heads must be over ankles, and the share of it that another axis may have, for an axis to be up."""
APART, SPAN, BOB, HIGH, INSIDE = 20.0, 150.0, 3.0, 30.0, 0.02
"""Metres: between people, of ground covered, that feet rise and sink, over the file's origin; least between people."""
TRUNK = (0.2, 0.9)
"""Metres from the middle of the hips to the middle of the shoulders."""
JUMP = 0.4
"""Metres that no pelvis moves from one frame to the next at 30 fps."""
RUNNING, PUSH = 8.0, 35.0
"""m/s and m/s2 that a pelvis stays below for 95 % of the time; leaping dancers reach 31 m/s2."""
FALL = 21.0
"""m/s2 of a pelvis downwards, over 0.1 s, for 2 % of the time: nothing but gravity pulls, and leaping dancers, who
fold their legs, reach 18. Whoever leaps at twice the rate exceeds it."""
STEP, STEPS = (0.14, 1.1), 4
"""Seconds that a foot is on its way in a step, by the median of at least so many footsteps."""
STROLL, SLOWLY = 0.9, 0.7
"""m/s of a foot on its way, and of a pelvis, that somebody with long steps stays below if time runs too slowly."""

KEEP = "(--trust_fps keeps such takes)"
CONVERT = "convert the file, or take it as it was published"


def usable(recording: Recording) -> Bools:
    """The recording's valid frames, when its numbers can be used at all. -> (T, P)"""
    fps = recording.fps
    if not (math.isfinite(fps) and 1.0 <= fps <= 1000.0):
        raise DataError(f"frame rate: got {fps}, expected 1 to 1000 frames a second; mend that number")
    T = recording.frames
    motion = [a for a in (recording.poses, recording.transl, recording.positions) if a is not None]
    P = motion[0].shape[1]
    valid = np.ones((T, P), dtype=bool) if recording.valid is None else np.asarray(recording.valid, dtype=bool)
    if not valid.any(axis=0).all():
        lost = np.flatnonzero(~valid.any(axis=0)).tolist()
        called = f" ({', '.join(recording.persons[p] for p in lost)})" if recording.persons else ""
        raise DataError(
            f"people {lost}{called} are valid in none of {T} frames: never tracked, or the tracking mask means the "
            f"opposite; leave the take out"
        )
    for name in ("poses", "transl", "pelvis", "positions"):
        array = getattr(recording, name)
        if array is not None and not (fine := np.isfinite(array).reshape(T, P, -1).all(axis=-1) | ~valid).all():
            frame, person = np.argwhere(~fine)[0].tolist()
            raise DataError(
                f"{name} holds NaN or infinity in {int((~fine).sum())} of {fine.size} frames, the first is frame "
                f"{frame} of {who(person, recording.persons)}; mark such frames as not valid, or copy the file again"
            )
    if recording.betas is not None and not np.isfinite(recording.betas).all():
        raise DataError("betas hold NaN or infinity; copy the file again")
    return valid


def check_angles(poses: Array, valid: Bools, names: Sequence[str] = ()) -> None:
    """Check that axis-angle vectors (T, P, 22, 3) are in radians."""
    with np.errstate(all="ignore"):  # of frames that are not valid
        size = np.linalg.norm(np.asarray(poses, dtype=np.float64), axis=-1)
        size[np.abs(poses).max(axis=-1) > WILD_ANGLE] = 0.0  # what is no angle at all is another matter
    size[~valid] = 0.0
    share = float((size[valid] > TURN).mean())
    if share > 0.005:
        what = "degrees" if np.percentile(size[valid], 99) < 400 else "neither radians nor degrees"
        frame, person, joint = np.unravel_index(size.argmax(), size.shape)
        raise DataError(
            f"{100 * share:.0f} % of the rotation vectors are longer than a full turn (the longest is "
            f"{size.max():.4g}, {JOINT_NAMES[joint]} of {who(int(person), names)} in frame {frame}), expected "
            f"radians up to 3.15: they look like {what}; {CONVERT}"
        )


def up_vector(joints: Array, valid: Bools) -> tuple[Array, str]:
    """Head minus ankles, mean over people and valid frames (3,), and what it is; else of the neck or the shoulders, or
    shoulders minus hips."""
    people = joints[valid]
    tops = (("head", (HEAD,)), ("neck", (NECK,)), ("shoulders", SHOULDERS))
    ways = [(f"{name} minus ankles", high, ANKLES) for name, high in tops]
    for what, high, low in (*ways, ("shoulders minus hips", SHOULDERS, HIPS)):
        up = people[:, list(high)].mean(axis=1) - people[:, list(low)].mean(axis=1)
        if np.isfinite(up).all():
            return up.mean(axis=0), what
    raise DataError(
        "neither head and ankles nor shoulders and hips are among the joints: no up axis can be found; give the "
        "axis with --up"
    )


def check_up(declared: Axis, joints: Array, valid: Bools, chosen: bool = False) -> None:
    """Check that heads are above ankles along the declared up axis. joints: (T, P, 22, 3)

    Args:
        declared: by the reader, or by the user.
        joints: in the file's axes, metres or not; NaN where a joint is not known.
        valid: (T, P).
        chosen: the user gave the axis, perhaps because people lie down: only a clear contradiction is refused.
    """
    vector, what = up_vector(joints, valid)
    size = np.abs(vector)
    first, second = np.argsort(-size)[:2]
    found = ("+" if vector[first] > 0 else "-") + "xyz"[first]
    seen = "{} is on average x {:.2f}, y {:.2f}, z {:.2f} m".format(what, *vector)
    clear = size[first] >= STANDING and size[second] <= BESIDE * size[first]
    if clear and found != declared:
        raise DataError(
            f"the declared up axis is {declared}, but people stand along {found} ({seen}): give --up={found} if all "
            f"files are so, or take the file as it was published"
        )
    if not clear and not chosen:
        raise DataError(
            f"no up axis stands out: {declared} is declared, {seen}; if people lie or crouch in this take, confirm "
            f"the axis with --up={declared}"
        )


def check_lengths(joints: Array, pelvis: Array, valid: Bools) -> None:
    """Check that translations are in metres, as bodies are. joints (T, P, 22, 3), pelvis (T, P, 3), y up"""
    lowest = joints[:, :, WALKING[1:], 1].min(axis=-1)
    bob = float(np.ptp(np.percentile(lowest[valid], [5, 95])))
    here = pelvis[valid]
    span = float(np.ptp(np.percentile(here, [1, 99], axis=0), axis=0).max())
    high = float(np.abs(np.median(here[:, 1])))
    measures = [(bob, BOB, "feet rise and sink by"), (high, HIGH, "pelvises are over the file's origin by")]
    measures.append((span, SPAN, "people cover"))
    apart = _apart(pelvis, valid)
    if apart is not None:
        measures.append((apart, APART, "people are apart by"))
    for length, most, what in measures:
        if length > most:
            raise DataError(
                f"{what} {length:.0f} m, expected less than {most:.0f} m: translations look like "
                f"{_unit(max(got / limit for got, limit, _ in measures))}, expected metres; {CONVERT}"
            )


def check_apart(transl: Array, valid: Bools) -> None:
    """Check that translations (T, P, 3) alone keep people apart, before their shapes move pelvises."""
    apart = _apart(transl, valid)
    if apart == 0:
        raise DataError(
            "translations of different people are the same: their files are one and the same recording, or hold no "
            "translations; give each person's own"
        )
    if apart is not None and apart < INSIDE:
        raise DataError(
            f"translations of different people are {1000 * apart:.1f} mm apart: they look too small, perhaps they were "
            f"divided by 1000 twice; expected metres; {CONVERT}"
        )


def check_limbs(points: Array, joints: Sequence[int], valid: Bools) -> None:
    """Check that positions (T, P, M, 3) are in metres: trunks have a person's length."""
    place = {joint: i for i, joint in enumerate(joints)}
    if not {*HIPS, *SHOULDERS} <= set(place):
        raise DataError(
            f"positions are of joints {list(joints)}; both hips (1, 2) and shoulders (16, 17) are needed: give "
            "their places, too"
        )
    people = points[valid]
    trunk = people[:, [place[j] for j in SHOULDERS]].mean(axis=1) - people[:, [place[j] for j in HIPS]].mean(axis=1)
    length = float(np.median(np.linalg.norm(trunk, axis=-1)))
    if not TRUNK[0] <= length <= TRUNK[1]:
        what = _unit(length / 0.05) if length > TRUNK[1] else "too small a unit, or are of something else"
        raise DataError(
            f"trunks are {length:.4g} m long, expected {TRUNK[0]} to {TRUNK[1]} m: positions look like {what}, "
            f"expected metres; {CONVERT}"
        )


def jumps(pelvis: Array, valid: Bools, fps: float) -> NDArray[np.intp]:
    """Frames at which somebody jumps elsewhere. pelvis (T, P, 3) -> (number,) first frame after each jump"""
    step = np.linalg.norm(np.diff(pelvis, axis=0), axis=-1)
    both = valid[1:] & valid[:-1]
    far = (step > JUMP) & both
    if far.sum() > max(3, 0.02 * both.sum()):
        speed = float(np.percentile(step[both], 95)) * fps
        raise DataError(
            f"pelvises move at {speed:.0f} m/s for 5 % of the time, expected at most {RUNNING:g} m/s: check the unit "
            f"of translations (metres) and the frame rate (perhaps 30 frames a second are called 120)"
        )
    return np.flatnonzero(far.any(axis=1)) + 1


def check_rate(joints: Array, valid: Bools, declared: float, fps: float) -> None:
    """Check the declared frame rate by how fast people move. joints of `WALKING`, y up

    A rate that is too high shows in the pelvis, in drops faster than falling, and in short footsteps; one that is too
    low shows in long footsteps alone, where somebody walks.
    """
    together: Bools = np.logical_and.reduce(valid, axis=1)
    if together.sum() < 2 * fps:
        return  # too short to say
    joints = joints.astype(np.float64)
    move = np.diff(joints, axis=0) * fps
    fine = together[1:] & together[:-1]
    if np.linalg.norm(move[fine], axis=-1).max() < 1e-3:
        raise DataError(f"nothing moves in {len(joints)} frames: the file repeats one frame; {CONVERT}")
    pelvis = move[:, :, 0]
    pull = np.diff(pelvis, axis=0) * fps
    push = np.linalg.norm(pull, axis=-1)
    speed = float(np.percentile(np.linalg.norm(pelvis[fine], axis=-1), 95))
    sure = fine[1:] & fine[:-1]
    push95 = float(np.percentile(push[sure], 95)) if sure.any() else 0.0
    over = sure[2:] & sure[1:-1] & sure[:-2]
    down = -(pull[2:, :, 1] + pull[1:-1, :, 1] + pull[:-2, :, 1])[over] / 3
    fall = float(np.percentile(down, 98)) if over.any() else 0.0
    durations, pace = footsteps(joints, together, fps)
    seen = f"at the declared {declared:g} frames a second pelvises move at {speed:.1f} m/s with {push95:.0f} m/s2"
    median = float(np.median(durations)) if len(durations) >= STEPS else None
    if median is not None:
        seen += f" and feet take {median:.2f} s for a step"
    if fall > FALL:
        seen += f" and drop with {fall:.0f} m/s2, faster than falling"
    if speed > RUNNING or push95 > PUSH or fall > FALL or (median is not None and median < STEP[0]):
        raise DataError(
            f"{seen}: too fast for people; perhaps 30 frames a second are called 120: check the rate {KEEP}"
        )
    if median is not None and median > STEP[1] and float(np.median(pace)) < STROLL and speed < SLOWLY:
        raise DataError(
            f"{seen}: too slow for people; perhaps 120 frames a second are called 30: check the rate {KEEP}"
        )


def footsteps(joints: Array, together: Bools, fps: float) -> tuple[Array, Array]:
    """Seconds and mean speed of every footstep, a foot's way from one place to another. (T, P, 5, 3) -> two (number,)

    What counts as moving is a share of the foot's own speed, so that footsteps are found whatever the frame rate.
    """
    durations, pace = [], []
    for person in range(joints.shape[1]):
        for foot in (1, 3):
            place = joints[:, person, foot : foot + 2].mean(axis=1)
            speed = np.linalg.norm(np.diff(place, axis=0), axis=-1) * fps
            speed = np.convolve(speed, np.ones(3) / 3, mode="same")
            speed[~(together[1:] & together[:-1])] = 0.0
            moving = speed > 0.25 * np.percentile(speed, 98)
            edges = np.flatnonzero(np.diff(moving.astype(np.int8))) + 1
            starts = edges[moving[edges]]
            for start in starts:
                ends = edges[(edges > start) & ~moving[edges]]
                if not len(ends):
                    continue
                way = float(np.linalg.norm(place[ends[0]] - place[start]))
                if way > 0.15:
                    durations.append((ends[0] - start) / fps)
                    pace.append(way * fps / (ends[0] - start))
    return np.array(durations), np.array(pace)


def _apart(place: Array, valid: Bools) -> float | None:
    """Median distance of everybody from the first person, metres."""
    both = valid[:, 1:] & valid[:, :1]
    if not both.any():
        return None
    return float(np.median(np.linalg.norm(place[:, 1:] - place[:, :1], axis=-1)[both]))


def _unit(times_too_large: float) -> str:
    return "millimetres" if times_too_large > 12 else "centimetres or millimetres"
