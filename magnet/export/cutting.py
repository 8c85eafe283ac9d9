"""A part of a file's frames, which `--start` and `--end` choose, and files of several frame rates."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path


def kept_frames(path: Path, frames: int, start: int, end: int | None) -> slice:
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
            held = f"holds {frames} frames"
            raise ValueError(f"{path}: {held}, so {name} {frame} is behind them; give --{name} {max(most, 0)} or less")
    return slice(start, end)


def require_one_clock(paths: Sequence[Path], rates: Sequence[float], start: int, end: int | None) -> None:
    """Refuse to cut files of different rates by one number of frames, which would be another moment in each.

    Raises:
        ValueError: names the rates.
    """
    if (start or end is not None) and len(set(rates)) > 1:
        each = ", ".join(f"{path} {rate:g} fps" for path, rate in zip(paths, rates, strict=True))
        raise ValueError(f"frame rates differ: {each}; --start and --end count frames, so cut each with magnet export")


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
