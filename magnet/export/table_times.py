"""Which frames the rows of a table are of, by their times; and tables of several recordings, rates or people that are
told by nothing, which are refused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magnet.export.rig_motion import LONGEST, Floats

Whole = NDArray[np.int64]

NEAR = 0.3
"""Share of a frame within which times of several people are of one frame."""
APART = 0.7
"""Share of a frame from one person's row to another's, at most, where each has a clock of their own."""
SHUFFLED = 3.0
"""Rows that go forward in time, on average, before one goes back: two in shuffled ones, many in two recordings."""
OVERLAP = 2
"""Rows of each of two stretches that may be of the other's moments, and steps that times may go back where frames go
on, where rows came late."""
DRIFT, DRIFTS = 1.5, 0.1
"""Frames and seconds, whichever is more, that a row counted as a frame may be from its time."""
REGULAR, SAME, COUNTED = 0.9, 0.2, 10
"""Share of somebody's steps that are within a share of the usual one, and how many there are, whose rate is sure."""
OTHER_RATE = 1.15
"""Times one person's sure rate that another's is, at least, who is of another rate."""
JUMPING = 3.0
"""Times farther from a row to the next than to the one a time later, at least, where they are of two people."""


@dataclass(frozen=True)
class TableRows:
    """The N rows of a table.

    Args:
        path: the table.
        told: whose each is; "" of nobody in particular.
        lines: where each stands in the file.
    """

    path: Path
    told: Sequence[str]
    lines: Sequence[int]

    @cached_property
    def of_each(self) -> list[Whole]:
        """Each person's rows, in the file's order."""
        whose = np.unique(np.array(self.told), return_inverse=True)[1]
        return [np.flatnonzero(whose == p) for p in range(int(whose.max(initial=-1)) + 1)]

    def name(self, rows: Whole) -> str:
        """Whose rows of one person are."""
        return self.told[rows[0]]

    def whose(self, rows: Whole) -> str:
        """The same within a sentence."""
        return f" for {self.name(rows)}" if self.name(rows) else ""


def require_one_recording(table: TableRows, values: Floats, what: str) -> None:
    """Refuse rows of somebody whose times or frames go through the same moments twice, as two recordings do.

    Rows in any order pass. values: (N,) times or numbers of frames, as `what` says
    """
    for rows in table.of_each:
        own = values[rows]
        forward = np.diff(own)
        ends = np.concatenate([np.flatnonzero(forward < 0), [len(own) - 1]])
        if len(ends) == 1 or len(own) / len(ends) < SHUFFLED or not (forward > 0).any():
            continue
        begins = np.concatenate([[0], ends[:-1] + 1])
        last, *others = np.argsort(own[begins], kind="stable").tolist()  # the stretch that has gone on for longest
        for k in others:
            before, after = own[begins[last] : ends[last] + 1], own[begins[k] : ends[k] + 1]
            shared = min(len(before) - np.searchsorted(before, after[0], "right"), np.searchsorted(after, before[-1]))
            if shared > OVERLAP or (before[-1] == after[-1] and begins[k] < ends[k]):
                row = max(begins[k], begins[begins > 0].min())
                of = (
                    "two recordings" if table.name(rows) else "two recordings, or of two people without a column person"
                )
                raise ValueError(
                    f"{table.path}, line {table.lines[rows[row]]}: {what} go back from {own[row - 1]:.6g} to "
                    f"{own[row]:.6g} and through the same moments again{table.whose(rows)}, as of {of}: save each in a "
                    "file of its own"
                )
            last = k if after[-1] > before[-1] else last


def require_times_with_frames(table: TableRows, seconds: Floats, numbers: Floats) -> None:
    """Refuse times that go back where numbers of frames go on."""
    good = np.isfinite(seconds) & np.isfinite(numbers)
    for every in table.of_each:
        rows = every[good[every]]
        rows = rows[np.argsort(numbers[rows], kind="stable")]
        later = np.diff(seconds[rows])
        if not (later > 0).any():
            continue
        back = np.flatnonzero(later < -OVERLAP * np.median(later[later > 0]))
        if len(back):
            one, other = rows[back[0]], rows[back[0] + 1]
            raise ValueError(
                f"{table.path}, line {table.lines[other]}: times go back from {seconds[one]:.6g} to "
                f"{seconds[other]:.6g} s where frames go on{table.whose(rows)}, as of two recordings: save each in a "
                "file of its own, or leave the times out and say the rate with --in_fps"
            )


def require_told_apart(path: Path, seconds: Floats, at: Floats) -> None:
    """Refuse rows of nobody in particular of which several have each time and are at different places by turns.

    at: (N, 3 K) coordinates in the rows' order
    """
    if not np.isfinite(seconds).all():
        return
    _, count = np.unique(seconds, return_counts=True)
    many = int(count[0])
    if many < 2 or len(count) < COUNTED or (count != many).any() or (np.diff(seconds) < 0).any():
        return
    near, far = (float(np.median(np.nansum(np.abs(at[k:] - at[:-k]), axis=1))) for k in (many, 1))
    if far > JUMPING * max(near, 1e-9):
        raise ValueError(
            f"{path}: {many} rows of each time, at different places by turns, as of {many} people: add a column "
            "person that tells whose each is"
        )


def frames_by_time(table: TableRows, seconds: Floats) -> Whole:
    """The frames of rows by their times, (N,), all finite; some frames may be missing.

    The rows of one person are frames in order, so that times may be as coarse as whole seconds. Rows of several people
    with one time are of one frame; people of clocks that are a part of a frame apart have each their nearest.

    Raises:
        ValueError: two recordings, people of different rates, or times that do not tell which rows go together.
    """
    require_one_recording(table, seconds, "times")
    people = [rows[np.argsort(seconds[rows], kind="stable")] for rows in table.of_each]
    steps = [np.diff(seconds[rows]) for rows in people]
    step, usual = _step(np.concatenate(steps))
    frame = np.zeros(len(seconds), np.int64)
    if len(people) == 1:
        frame[people[0]] = _counted(table.path, seconds[people[0]], step)
        return frame
    if any((own == 0).any() for own in steps):
        return _in_order(table, seconds, people, step)
    _require_one_rate(table, people, steps)
    times = np.unique(seconds)
    later = np.diff(times)
    seen = np.zeros((len(times), len(people)), bool)
    for p, rows in enumerate(people):
        seen[np.searchsorted(times, seconds[rows]), p] = True
    others = ~(seen[1:] & seen[:-1]).any(axis=1)
    if (others & (later > NEAR * usual) & (later < APART * usual)).any():
        return _of_own_clocks(table, seconds, people, step)
    new = np.concatenate([[True], later > (NEAR * usual if np.isfinite(usual) else 0.0)])
    of_new = _counted(table.path, times[new], step)
    return np.asarray(of_new[np.cumsum(new) - 1][np.searchsorted(times, seconds)], np.int64)


def _step(steps: Floats) -> tuple[float, float]:
    """Seconds from a frame to the next: on average where none is missing, and the usual ones; infinite of one time."""
    if not (steps > 0).any():
        return np.inf, np.inf
    usual = float(np.quantile(steps[steps > 0], 0.5, method="lower"))
    return float(steps[np.abs(steps - usual) < usual / 2].mean()), usual


def _counted(path: Path, times: Floats, step: float) -> Whole:
    """The frames of one clock's times, which rise, from 0."""
    later = np.diff(times)
    # A frame late counts as a gap, half a frame does not.
    frame = np.concatenate([[0], np.cumsum(np.clip(np.floor(later / step + NEAR), 1, LONGEST))]).astype(np.int64)
    since = times - times[0]
    if len(times) < 3 or not (later > 0).all() or frame[-1] >= LONGEST:
        return frame
    off = np.abs(since - frame * (since[-1] / frame[-1])).max()
    if off <= max(DRIFT * step, DRIFTS):
        return frame
    for each in (step, float(np.quantile(later, 0.1, method="lower"))):  # rates change: places by time, not by count
        placed = np.round(since / each)
        if (np.diff(placed) > 0).all():
            return np.minimum(placed, LONGEST).astype(np.int64)
    raise ValueError(
        f"{path}: rows come between {1 / later.max():.3g} and {1 / later.min():.3g} times a second, so that counting "
        f"them is up to {off:.2g} s off: bring them to one rate"
    )


def _in_order(table: TableRows, seconds: Floats, people: Sequence[Whole], step: float) -> Whole:
    """The frames of people with several rows of one time each: equally many of all are of the same frames in order."""
    first = people[0]
    for rows in people[1:]:
        if len(rows) != len(first) or (seconds[rows] != seconds[first]).any():
            every = np.unique(seconds)
            counts = [
                np.searchsorted(seconds[one], every, "right") - np.searchsorted(seconds[one], every)
                for one in (first, rows)
            ]
            k = int(np.flatnonzero(counts[0] != counts[1])[0])
            raise ValueError(
                f"{table.path}: at {every[k]:.6g} s {table.name(first)} has {counts[0][k]} rows and "
                f"{table.name(rows)} {counts[1][k]}, and nothing says which go together; add a column frame, or write "
                "times that tell frames apart"
            )
    frame = np.zeros(len(seconds), np.int64)
    for rows in people:
        frame[rows] = _counted(table.path, seconds[rows], step)
    return frame


def _require_one_rate(table: TableRows, people: Sequence[Whole], steps: Sequence[Floats]) -> None:
    """Refuse people whose rows come at different rates, each of which is sure."""
    rates = {}
    for rows, own in zip(people, steps, strict=True):
        usual = float(np.median(own)) if len(own) >= COUNTED else 0.0
        if usual and (np.abs(own - usual) < SAME * usual).mean() >= REGULAR:
            rates[table.name(rows)] = 1 / usual
    if rates and max(rates.values()) > OTHER_RATE * min(rates.values()):
        said = ", ".join(f"{name} {rate:.3g}" for name, rate in rates.items())
        raise ValueError(
            f"{table.path}: people's rows come at different rates ({said} a second): give each a file of their own, "
            "and read these together with --fps 30"
        )


def _of_own_clocks(table: TableRows, seconds: Floats, people: Sequence[Whole], step: float) -> Whole:
    """The frames of people whose times are a part of a frame apart: each counts on from the nearest common one."""
    own = [_counted(table.path, seconds[rows], step) for rows in people]
    spans = [np.ptp(seconds[rows]) / count[-1] for rows, count in zip(people, own, strict=True) if count[-1] > 0]
    even = float(np.median(spans)) if spans else step
    start, frame = float(seconds.min()), np.zeros(len(seconds), np.int64)
    for rows, count in zip(people, own, strict=True):
        since = (seconds[rows] - start) / even
        frame[rows] = count + round(float(np.median(since - count)))
        off = even * float(np.abs(since - frame[rows]).max())
        if off > max(DRIFT * even, DRIFTS):
            raise ValueError(
                f"{table.path}: times of people run apart{table.whose(rows)} by up to {off:.2g} s: bring them to one "
                "clock and rate"
            )
    return np.asarray(frame - frame.min(), np.int64)
