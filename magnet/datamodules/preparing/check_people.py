"""Faults of one person in some frames although every number is finite.

Impossible bodies, numbers far beyond any motion, everything at zero, somebody who is frozen while the others move,
joints that jump. Takes keep their other frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magnet.body.base import MOST_SHAPE
from magnet.body.joints import ANKLES, HEAD, JOINT_NAMES
from magnet.datamodules.reading.recording import DataError, Recording
from magnet.motion.runs import true_runs

Array = NDArray[np.floating[Any]]
Bools = NDArray[np.bool_]

STATURE = (0.6, 2.1)
"""Metres from ankles to head joint at rest."""
WILD_ANGLE, WILD_PLACE = 100.0, 1e6
"""Radians of a rotation vector, sixteen turns, and units of a place from the person's median, far beyond any motion."""
STILL, STILL_QUAT = 1e-5, 5e-5
"""Metres and quaternion entries that somebody frozen moves by in a frame at most: half the least seen of people who
stand still (CMU: 0.03 mm and 1.6e-4), and more than the rows of a store round to."""
FROZEN, STUCK = 15, 60
"""Frames at 30 fps: shortest that a whole body is held, and that a place or a pose alone is."""
TURN = 120.0
"""Degrees that no joint turns by in 1/30 s; the fastest of CMU's dancers, boxers and jumpers reach 54."""
FLUNG = 0.6
"""Metres that no joint moves by in 1/30 s from its pelvis's place; the fastest of CMU's reach 0.41."""
AGAIN = "leave the take out, or take the file as it was published"


@dataclass(frozen=True)
class Flag:
    """A fault of one person during some frames."""

    person: int
    start: int
    stop: int  # one past the last
    what: str  # such as "frozen while others move"
    cut: bool = False  # between `start` and the frame before it, rather than in frames

    def said(self, names: Sequence[str], fps: float, met: bool = True) -> str:
        """The flag in words, with frames and seconds, and with what is done about it where that is `met`."""
        begin = self.start / fps
        if self.cut:
            when, then = f"from frame {self.start - 1} to {self.start} at {fps:g} fps ({begin:.2f} s)", ": cut there"
        elif self.stop - self.start == 1:
            when, then = f"in frame {self.start} at {fps:g} fps ({begin:.2f} s)", ": cut out"
        else:
            seconds = f"{begin:.2f} to {self.stop / fps:.2f} s"
            when, then = f"in frames {self.start} to {self.stop - 1} at {fps:g} fps ({seconds})", ": cut out"
        return f"{who(self.person, names)}: {self.what} {when}{then if met else ''}"


def who(person: int, names: Sequence[str]) -> str:
    """How a person is called in messages."""
    return f"person {person} ({names[person]})" if person < len(names) else f"person {person}"


# -- bodies ------------------------------------------------------------------------------------


def check_shapes(betas: Array, names: Sequence[str] = ()) -> None:
    """Check that shape numbers (P, 10) are possible."""
    size = np.abs(betas).max(axis=1)
    if wrong := np.flatnonzero(~(size <= MOST_SHAPE)).tolist():
        listed = "; ".join(f"{who(p, names)}: {', '.join(f'{b:.3g}' for b in betas[p])}" for p in wrong)
        raise DataError(
            f"betas up to {size[wrong].max():.3g}, expected at most {MOST_SHAPE:g}, which are standard deviations from "
            f"the mean shape: nobody has such a body ({listed}); {AGAIN}"
        )


def check_stature(rest: Array, names: Sequence[str] = ()) -> None:
    """Check that bodies at rest (P, 22, 3) have a possible size."""
    tall = rest[:, HEAD, 1] - rest[:, ANKLES, 1].mean(axis=1)
    for p in np.flatnonzero(~((tall >= STATURE[0]) & (tall <= STATURE[1]))).tolist():
        raise DataError(
            f"{who(p, names)}: the head is {tall[p]:.2f} m over the ankles in the body that betas make, expected "
            f"{STATURE[0]} to {STATURE[1]} m; check that --body is of the data set's family, or {AGAIN}"
        )


# -- as the file holds them --------------------------------------------------------------------


def screened(recording: Recording, valid: Bools) -> tuple[Bools, list[Flag]]:
    """Valid frames (T, P) without those whose numbers are no motion, and flags for the latter."""
    found: list[Flag] = []
    for mask, what in _nonsense(recording, valid):
        for person in range(valid.shape[1]):
            bad = mask[:, person] & valid[:, person]
            found += [Flag(person, a, b, what) for a, b in true_runs(bad)]
            if bad.any() and not (valid[:, person] & ~bad).any():
                raise DataError(
                    f"{who(person, recording.persons)}: {what} in all of {len(valid)} frames: nothing was tracked; "
                    f"leave the take out, or copy the file again"
                )
        valid = valid & ~mask
    return valid, found


def _nonsense(recording: Recording, valid: Bools) -> list[tuple[Bools, str]]:
    """Masks (T, P) of frames that are no motion, and what they are; what is not valid may be anything."""
    found: list[tuple[Bools, str]] = []
    with np.errstate(all="ignore"):  # of frames that are not valid
        place = recording.transl if recording.pelvis is None else recording.pelvis
        if recording.poses is not None and place is not None:
            size = np.abs(recording.poses).max(axis=(2, 3))
            found.append((size > WILD_ANGLE, f"rotations of more than {WILD_ANGLE:g} radians"))
            found.append((_far(place[:, :, None], valid), "a place more than a thousand kilometres off"))
            nowhere = (size == 0) & (np.abs(place).max(axis=-1) == 0)
            found.append((nowhere, "all rotations and the place are exactly 0"))
        elif recording.positions is not None:
            found.append((_far(recording.positions, valid), "joints more than a million units off"))
            nowhere = (recording.positions == recording.positions[:, :, :1]).all(axis=(2, 3))
            found.append((nowhere, "all joints are at one point"))
    return found


def _far(places: Array, valid: Bools) -> Bools:
    """(T, P, M, 3) -> (T, P)"""
    middle = np.nanmedian(np.where(valid[..., None, None], places, np.nan), axis=(0, 2), keepdims=True)
    return np.abs(places - middle).max(axis=(2, 3)) > WILD_PLACE


# -- at 30 frames a second ---------------------------------------------------------------------


def frozen(still_place: Bools, still_pose: Bools, valid: Bools) -> list[Flag]:
    """Flags people who are held still while others move.

    still_place, still_pose: (T - 1, P) whether the pelvis is where it was in the frame before, and joints as they were.
    """
    both = valid[1:] & valid[:-1]
    kinds: tuple[tuple[Bools, int, str], ...] = (
        (still_place & still_pose, FROZEN, "frozen while others move"),
        (still_place, STUCK, "at one point while others move"),
        (still_pose, STUCK, "in one pose while others move"),
    )
    found: list[Flag] = []
    for person in range(valid.shape[1]):
        moving = np.delete(~(still_place | still_pose) & both, person, axis=1)
        others: Bools = np.logical_or.reduce(moving, axis=1)
        for still, least, what in kinds:
            for start, stop in true_runs(still[:, person] & both[:, person], least - 1):
                known = any(f.person == person and f.start <= start and stop < f.stop for f in found)
                if not known and others[start:stop].mean() > 0.5:
                    found.append(Flag(person, start, stop + 1, what))
    return found


def held(pelvis: Array, quat: Array) -> tuple[Bools, Bools]:
    """Whether places (T, P, 3) and rotations (T, P, 22, 4) are those of the frame before. -> (T - 1, P) twice"""
    moved = np.abs(np.diff(pelvis, axis=0)).max(axis=-1)
    turned = np.minimum(*(np.abs(quat[1:] + sign * quat[:-1]).max(axis=-1) for sign in (1.0, -1.0))).max(axis=-1)
    return moved < STILL, turned < STILL_QUAT


def held_points(points: Array) -> tuple[Bools, Bools]:
    """The same of joints (T, P, M, 3): where their middle is, and how they lie about it. -> (T - 1, P) twice"""
    middle = points.mean(axis=2, keepdims=True)
    place, pose = (np.abs(np.diff(part, axis=0)).max(axis=(2, 3)) for part in (middle, points - middle))
    return place < STILL, pose < STILL


def jumps(quat: Array | None, joints: Array | None, valid: Bools, but: Sequence[Flag] = ()) -> list[Flag]:
    """Flags joints that turn or move further from one frame to the next than any joint can.

    Args:
        quat: (T, P, 22, 4) unit quaternions, the pelvis's in the world; None: not looked at.
        joints: (T, P, 22, 3) metres, NaN where a joint is not known; None: not looked at.
        valid: (T, P).
        but: jumps that are known already.
    """
    both = valid[1:] & valid[:-1]
    for flag in but:
        both[flag.start - 1, flag.person] &= not flag.cut
    found: dict[tuple[int, int], Flag] = {}
    if quat is not None:
        cosine = np.clip(np.abs((quat[1:] * quat[:-1]).sum(axis=-1)), 0.0, 1.0)
        least = np.cos(np.radians(TURN) / 2)
        for t, p in np.argwhere((cosine < least).any(axis=-1) & both).tolist():
            joint = int(cosine[t, p].argmin())
            angle = np.degrees(2 * np.arccos(cosine[t, p, joint]))
            found[p, t] = Flag(p, t + 1, t + 2, f"{JOINT_NAMES[joint]} turns by {angle:.0f} degrees", cut=True)
    if joints is not None:
        with np.errstate(all="ignore"):
            move = np.linalg.norm(np.diff(joints - joints[:, :, :1], axis=0), axis=-1)
            for t, p in np.argwhere((move > FLUNG).any(axis=-1) & both).tolist():
                joint = int(np.nanargmax(move[t, p]))
                what = f"{JOINT_NAMES[joint]} is flung {move[t, p, joint]:.1f} m"
                found.setdefault((p, t), Flag(p, t + 1, t + 2, what, cut=True))
    return [found[key] for key in sorted(found)]


def without(valid: Bools, flags: Sequence[Flag], names: Sequence[str], fps: float) -> Bools:
    """(T, P) less the frames of flags that are cut out."""
    left = valid.copy()
    for flag in flags:
        if not flag.cut:
            left[flag.start : flag.stop, flag.person] = False
    for person in np.flatnonzero(~left.any(axis=0)).tolist():
        mine = [flag for flag in flags if flag.person == person]
        raise DataError(f"{'; '.join(described(mine, names, fps))}: nothing is left; tracking was lost: {AGAIN}")
    return left


def described(flags: Sequence[Flag], names: Sequence[str], fps: float, met: bool = True, most: int = 5) -> list[str]:
    """Flags in words; of one kind and person at most so many, and how many more there are."""
    count: dict[tuple[int, bool], int] = {}
    said: list[str] = []
    for flag in flags:
        key = (flag.person, flag.cut)
        count[key] = count.get(key, 0) + 1
        if count[key] <= most:
            said.append(flag.said(names, fps, met))
    for (person, cut), number in count.items():
        if number > most:
            said.append(f"{who(person, names)}: {number - most} more such {'jumps' if cut else 'stretches'}")
    return said
