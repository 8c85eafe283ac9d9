"""A part of a file's frames, which `--start` and `--end` choose, and files of several clocks or rates as one scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from magnet.errors import counted
from magnet.motion.resample import resampled
from magnet.motion.scene import Scene, cat_agents


def kept_frames(path: str | Path, frames: int, start: int, end: int | None) -> slice:
    """The frames of a file that are kept: those from `start` up to `end`, which is not among them; None: all the rest.

    Raises:
        ValueError: the file, which has so many frames, has no such part.
    """
    if start < 0 or (end is not None and end <= start):
        said = f"start {start}" + ("" if end is None else f", end {end}")
        raise ValueError(
            f"{said}: expected 0 or more, and an end after the start; frames count from 0 (--start, --end)"
        )
    for name, frame, most in (("start", start, frames - 1), ("end", end, frames)):
        if frame and frame > most:
            held = f"holds {counted(frames, 'frame')}"
            raise ValueError(f"{path}: {held}, so {name} {frame} is behind them; give --{name} {max(most, 0)} or less")
    return slice(start, end)


def require_one_clock(paths: Sequence[str | Path], rates: Sequence[float], start: int, end: int | None) -> None:
    """Refuse to cut files of different rates by one number of frames, which would be another moment in each."""
    if (start or end is not None) and len(set(rates)) > 1:
        each = _each(paths, [f"{rate:g} fps" for rate in rates])
        raise ValueError(f"frame rates differ: {each}; --start and --end count frames, so cut each with magnet export")


@dataclass(frozen=True)
class Begin:
    """Where a file's first frame is on the clocks that it tells."""

    frame: float | None  # as the file counts frames
    second: float | None
    count: float  # frames a second of that count


def shared_frames(
    paths: Sequence[Path], frames: Sequence[int], rates: Sequence[float], begins: Sequence[Begin]
) -> tuple[list[slice], list[str]]:
    """The frames of each file that are of the moments of all, and a note if any is cut.

    Clocks on which all begin at once tell nothing: each file's may have been set to 0. Nor do times without a common
    moment beside such frame numbers: each file's may count from when its sensor was switched on.

    Raises:
        ValueError: there is no such moment.
    """
    clocks: dict[str, list[float]] = {}
    counted = [begin.frame / begin.count for begin in begins if begin.frame is not None]
    if len(counted) == len(begins) and len({begin.count for begin in begins}) == 1:
        clocks["frame numbers"] = counted
    timed = [begin.second for begin in begins if begin.second is not None]
    if len(timed) == len(begins):
        clocks["times"] = timed
    apart = [what for what, starts in clocks.items() if np.ptp(starts) > 0.5 / max(rates)]
    if not apart:
        return [slice(None)] * len(paths), []
    starts, each = clocks[apart[0]], list(zip(frames, rates, strict=True))
    late = [round((max(starts) - start) * rate) for start, rate in zip(starts, rates, strict=True)]
    lasts = min((many - begin) / rate for (many, rate), begin in zip(each, late, strict=True))
    if lasts <= 0 and len(clocks) > len(apart):
        begun = f"by their {apart[0]} files share no moment, and they begin at the same frame number"
        return [slice(None)] * len(paths), [f"{begun}: taken to begin together"]
    if lasts <= 0:
        said = ", ".join(
            f"{path} from {start - min(starts):.6g} to {start - min(starts) + many / rate:.6g} s"
            for path, start, (many, rate) in zip(paths, starts, each, strict=True)
        )
        raise ValueError(
            f"by their {apart[0]} files share no moment: {said}; people of one scene are of one clock: where these "
            "are not, leave out the columns that count frames and time, and say the rate with --in_fps"
        )
    kept = [
        slice(begin, min(begin + max(round(lasts * rate), 1), many))
        for (many, rate), begin in zip(each, late, strict=True)
    ]
    begun = f"by their {apart[0]} files begin up to {np.ptp(starts):.3g} s apart"
    return kept, [f"{begun}: each was cut to the {lasts:.3g} s of all"]


def rates_note(rates: Sequence[float], fps: float) -> list[str]:
    """A note that files were resampled; none where all have this rate.

    >>> rates_note([120.0, 30.0, 120.0], 30.0)
    ['files of 30 and 120 frames a second, all brought to 30']
    >>> rates_note([120.0], 30.0), rates_note([30.0], 30.0)
    (['resampled from 120 to 30 frames a second'], [])
    """
    different = list(dict.fromkeys(f"{rate:g}" for rate in sorted(rates)))
    if different in ([], [f"{fps:g}"]):
        return []
    if len(different) == 1:
        return [f"resampled from {different[0]} to {fps:g} frames a second"]
    return [f"files of {' and '.join(different)} frames a second, all brought to {fps:g}"]


def together(people: Sequence[Scene], labels: Sequence[str], *, fps: float | None = None, trim: bool = False) -> Scene:
    """Several people, each a scene with B = 1, as one scene in one world.

    Args:
        labels: what to call each in errors, such as its file.
        fps: bring all to this rate; None: they must agree.
        trim: cut all to the shortest; else lengths must agree.

    Raises:
        ValueError: rates, lengths or bodies differ.
    """
    if fps is not None:
        people = [resampled(person, fps) for person in people]
    require_one_rate(labels, [person.fps for person in people])
    bodies = {person.body for person in people}
    if len(bodies) > 1:
        raise ValueError(f"bodies differ: {_each(labels, [person.body for person in people])}")
    shortest = min(person.frames for person in people)
    if not trim and any(person.frames != shortest for person in people):
        raise ValueError(
            f"lengths differ: {_each(labels, [counted(person.frames, 'frame') for person in people])}; people of one "
            "scene share their frames: cut all to the shortest with --trim (trim=True)"
        )
    people = [person.slice(0, shortest) for person in people]
    valid = None
    if any(person.valid is not None for person in people):
        all_good = torch.ones(1, shortest, dtype=torch.bool)
        valid = torch.stack([all_good if p.valid is None else p.valid for p in people]).all(dim=0)
    given = None
    if any(person.given is not None for person in people):
        given = [
            torch.zeros_like(p.T_world_root[..., 0, 0], dtype=torch.bool) if p.given is None else p.given
            for p in people
        ]
    return cat_agents(people).replace(valid=valid, given=None if given is None else torch.cat(given, dim=2))


def require_one_rate(labels: Sequence[object], rates: Sequence[float]) -> None:
    """Refuse files of different frame rates, where nobody says one for all."""
    if len(set(rates)) > 1:
        each = _each(labels, [f"{rate:g} fps" for rate in rates])
        raise ValueError(
            f"frame rates differ: {each}; bring all to one with magnet export --fps 30, or fps=30 in Python"
        )


def _each(labels: Sequence[object], what: Sequence[str]) -> str:
    return ", ".join(f"{label} {value}" for label, value in zip(labels, what, strict=True))
