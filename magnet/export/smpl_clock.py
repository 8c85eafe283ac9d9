"""The clock of people whose files number the frames of a video in which they were seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magnet.errors import DataError

Numbers = NDArray[np.int64]

FRAMES = "frame_ids"
"""Under which trackers say which frames of a video somebody was seen in."""
LONGEST = 1_000_000
"""Frames between the first and the last one of a file that are believed: nine hours at 30 a second."""
MEND = "; mend them, or leave them out"


def frame_numbers(
    where: object, held: Mapping[str, Any], frames: int, people: int, alone: bool = False
) -> tuple[tuple[Numbers | None, ...], tuple[str, ...]]:
    """Which frames of a video the frames of each of P people are.

    Args:
        where: for messages.
        held: what the file has of one person, or of several along the first axis.
        frames: T.
        people: P.
        alone: nobody else is in the scene, so that one person does not need them.

    Returns:
        Of each person (T,), or None where the file does not say, or not by numbers; and a note where one person alone
        has some that cannot be used.

    Raises:
        DataError: not one whole number a frame, or they do not rise.
    """
    try:
        value = _table(where, held.get(FRAMES))
        if value.dtype.kind not in "iuf" or not value.size:  # names of pictures, say
            return (None,) * people, ()
        if value.shape == (frames, 1):
            value = value.T
        if value.shape not in ((frames,), (1, frames), (people, frames)):
            several = f", or {(people, frames)} for {people} people" if people > 1 else ""
            raise DataError(
                f"{where}: {FRAMES}: got shape {value.shape}, expected {(frames,)}, a number a frame{several}{MEND}"
            )
        each = np.broadcast_to(value, (people, frames))
        return tuple(_whole(where, row) for row in each), ()
    except DataError as error:
        if not alone or people > 1:
            raise
        return (None,), (f"{str(error).removesuffix(MEND)}; left out, as one person alone needs none",)


def _table(where: object, value: Any) -> NDArray[Any]:
    """What a file has under `FRAMES` as an array."""
    try:
        return np.asarray(value)
    except ValueError as error:
        raise DataError(f"{where}: {FRAMES}: lists of unequal length, expected a number a frame{MEND}") from error


def _whole(where: object, row: NDArray[Any]) -> Numbers:
    """Whole numbers of one person's frames (T,) -> the same; refused where they do not rise."""
    with np.errstate(invalid="ignore"):
        given = row.astype(np.float64)
        numbers = given.astype(np.int64)
    if (given != numbers).any() or (np.diff(given) <= 0).any() or np.ptp(given) >= LONGEST:
        raise DataError(
            f"{where}: {FRAMES}: got {given[0]:g} to {given[-1]:g} for {len(row)} frames, expected whole numbers that "
            f"rise from frame to frame, by less than {LONGEST:,} in all{MEND}"
        )
    return numbers


@dataclass(frozen=True)
class SharedClock:
    """The frames of a video that all of several people have, from the first to the last one of these.

    Args:
        numbers: (T,) what the video's frames are called.
        at: of each person (T,) which of their own frames is taken; the one before where there is none.
        seen: of each person (T,) whether they have that frame.
        notes: what should be known of it.
    """

    numbers: Numbers
    at: tuple[Numbers, ...]
    seen: tuple[NDArray[np.bool_], ...]
    notes: tuple[str, ...]


def shared_clock(
    where: object, numbers: Sequence[Numbers | None], names: Sequence[str], lost: str = "cut out"
) -> SharedClock | None:
    """The clock of people from the frame that the last of them begins with to the one that the first of them ends with.

    None where nobody's frames are numbered. names: of the people, for messages; lost: what happens to frames in which
    somebody was not seen, for the note on them.

    Raises:
        DataError: only some have numbers, or there is no frame in which all were seen.
    """
    known = [one for one in numbers if one is not None]
    if not known:
        return None
    if len(known) < len(numbers):
        lack = ", ".join(name for name, one in zip(names, numbers, strict=True) if one is None)
        raise DataError(
            f"{where}: {FRAMES} say when others were seen, but {lack} has none; give everybody theirs, or leave all out"
        )
    spans = [f"{one[0]} to {one[-1]}" for one in known]
    first, last = max(one[0] for one in known), min(one[-1] for one in known)
    step = max(int(np.gcd.reduce(np.concatenate([one - known[0][0] for one in known]))), 1)
    clock = np.arange(first, last + 1, step)
    at = [np.searchsorted(one, clock, side="right") - 1 for one in known]
    seen = [one[frame] == clock for one, frame in zip(known, at, strict=True)]
    if not np.logical_and.reduce(seen).any():
        raise DataError(
            f"{where}: people were never seen together: {FRAMES} {', '.join(spans)}; take each alone, or leave "
            f"{FRAMES} out if they count from different beginnings"
        )
    notes = [f"{where}: {FRAMES} rise by {step}: frames are taken for neighbours"] if step > 1 else []
    if len(set(spans)) > 1:
        notes.append(f"{where}: {FRAMES} are {', '.join(spans)}: cut to what all have, {first} to {last}")
    for name, there in zip(names, seen, strict=True):
        if missed := int((~there).sum()):
            notes.append(f"{name}: {missed} of {len(clock)} frames are not in {FRAMES}, taken as not tracked: {lost}")
    return SharedClock(clock, tuple(at), tuple(seen), tuple(notes))


def require_one_beginning(where: object, begun: Mapping[str, int | None], advice: str) -> None:
    """Refuse files of different frame rates that begin with frames of different numbers: they have no common clock.

    begun: the number of each file's first frame, where it has one, by the file's name; advice: what to do.
    """
    known = {name: number for name, number in begun.items() if number is not None}
    if len(set(known.values())) > 1:
        said = ", ".join(f"{number} ({name})" for name, number in known.items())
        raise DataError(f"{where}: {FRAMES} of files of different frame rates begin at {said}; {advice}")
