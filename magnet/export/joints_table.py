"""Tables of joint positions: ours, and those of trackers of joints."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magnet.export import table_times
from magnet.export.naming import recognised
from magnet.export.rig_motion import LONGEST, MOST_AWAY, Floats, usual_rate
from magnet.export.table_times import TableRows
from magnet.files import regular, said_sign

COLUMN = re.compile(r"(?i)^(.+?)[ _.:-]*([xyz])(?:[ _.(\[]*(mm|cm|m)[)\]]?)?$")
"""A joint's name, an axis, and perhaps a unit: left_hip_x_m, LeftHip.X, nose_y (mm)."""
AXIS_FIRST = re.compile(r"(?i)^([xyz])[ _.:-]+(.+?)(?:[ _.(\[]+(mm|cm|m)[)\]]?)?$")
"""An axis, a joint's name, and perhaps a unit: x_LHip, X.LeftHip (mm)."""
FRAME, TIME = ("frame", "frame_id", "frame_index"), ("time_s", "time", "seconds", "t", "timestamp")
PERSON = ("person", "person_id", "id", "track", "track_id", "subject", "actor", "skeleton")
SLOWEST = 1.0
"""Seconds from a frame to the next at most."""
COARSE = 3.0
"""Frames of each time, on average, from which times say a rate only by when they change, as whole seconds do."""
SLOW, FAST = 10.0, 1000.0
"""Frames a second of no tracker's, below and above."""
PARTS = {1.0: "seconds", 1e3: "milliseconds", 1e6: "microseconds", 1e7: "ticks of 100 ns", 1e9: "nanoseconds"}
"""What times may be in, by how many of it a second has."""
MOST_PEOPLE = 200
"""People of a table at most, as in a crowd."""


@dataclass(frozen=True)
class JointTable:
    """Joints of all P people of one scene, NaN where they are missing."""

    names: tuple[str, ...]  # K
    people: tuple[str, ...]
    at: Floats  # (T, P, K, 3) in the table's unit and axes
    fps: float | None
    unit: str | None
    step: int = 1  # by which the file counts its frames, such as every fifth of a camera's
    first: int | None = None  # the first frame, as the file counts
    second: float | None = None  # the first frame's time
    told: str = ""  # how its times were understood, where they are no seconds


def read_table(path: str | Path) -> JointTable:
    """Read a table of joint positions: a row for each frame and person, three columns for each joint.

    Columns are named by a joint and an axis, perhaps with a unit (`left_hip_x_m`, `x_left_hip`), and by `frame`,
    `person` and `time_s`; others are passed over. Without `person` there is one, without `frame` rows are frames by
    their times, of several people those of one time are one frame; without `time_s`, too, they are frames in order, and
    the rate is not known. Times that go up by ones are numbers of frames. Cells may be empty, and a joint at 0, 0, 0 is
    missing, too. Where frames or times tell of frames without a row, all joints are missing in them. Joints of people
    may be side by side in a row, `A_left_hip_x` and `B_left_hip_x`.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: no text in UTF-8, no such columns, rows that are cut short, two rows of one frame and person, frames
            that nothing tells, too many frames, several scenes or recordings, or people of different rates.
    """
    path = Path(path)
    sign, at_line, rows = _rows(path)
    head = [name.strip() for name in rows[0]]
    columns, unit = _columns(path, head)
    words = [name.lower() for name in head]
    frame_at, time_at, person_at, scene_at = (
        next((words.index(name) for name in names if name in words), None)  # the surest name first
        for names in (FRAME, TIME, PERSON, ("scene",))
    )
    if any(place is not None for place in (frame_at, time_at, person_at, scene_at)):  # else it is a frame of nobody
        kept = [k for k, row in enumerate(rows) if any(map(str.strip, row))]
        at_line, rows = [at_line[k] for k in kept], [rows[k] for k in kept]
    numbered = zip(at_line[1:], rows[1:], strict=True)
    numbers = np.array([[_number(path, line, row, k, sign) for k in range(len(head))] for line, row in numbered])
    if scene_at is not None and len(scenes := {row[scene_at].strip() for row in rows[1:]}) > 1:
        raise ValueError(f"{path}: holds {len(scenes)} scenes; keep the rows of one, as magnet export --scene 0 writes")
    told = [""] * len(numbers) if person_at is None else [row[person_at].strip() for row in rows[1:]]
    people = tuple(dict.fromkeys(told))
    if len(people) > MOST_PEOPLE:
        raise ValueError(f"{path}: its column {head[person_at or 0]} names {len(people)} people; is it a row's number?")
    table = TableRows(path, told, at_line[1:])
    seconds, told_in = (None, "") if time_at is None else _seconds(table, numbers, time_at, frame_at, head)
    frame_at = time_at if seconds is None and frame_at is None else frame_at
    where = np.array(list(columns.values()))
    if frame_at is None and seconds is not None and len(people) == 1:
        table_times.require_told_apart(path, seconds, numbers[:, where.ravel()])
    frame, step = _frames(table, numbers, frame_at, seconds)
    at = np.full((int(frame.max()) + 1, len(people), len(columns), 3), np.nan)
    seen: set[tuple[int, str]] = set()
    for number, (t, person) in enumerate(zip(frame.tolist(), told, strict=True)):
        if (t, person) in seen:
            who = f" of {person}" if person else ""
            line = table.lines[number]
            raise ValueError(f"{path}, line {line}: a second row{who} for frame {t}; is a column person missing?")
        seen.add((t, person))
        at[t, people.index(person)] = numbers[number][where]
    at[~np.isfinite(at)] = np.nan
    at[(at == 0).all(axis=-1)] = np.nan  # as many trackers say that they did not find a joint
    if (at > MOST_AWAY).any() or (at < -MOST_AWAY).any():
        raise ValueError(f"{path}: a joint is {np.nanmax(np.abs(at)):.2g} away: numbers are damaged")
    fps = None if seconds is None else _rate(table, seconds, frame)
    first = None if frame_at is None else int(numbers[:, frame_at].min())
    second = None if seconds is None else _first_time(seconds, frame, fps)
    return _side_by_side(JointTable(tuple(columns), people, at, fps, unit, step, first, second, told_in))


def _rows(path: Path) -> tuple[str, list[int], list[list[str]]]:
    """The sign between cells, and the rows with their lines in the file, the names first; the last says something."""
    with regular(path).open(newline="", encoding="utf-8-sig", errors="replace") as file:
        first = file.readline()
        if "\0" in first:
            raise ValueError(f"{path}: is no text in UTF-8; save it again as CSV UTF-8")
        said = said_sign(first)
        above = int(said is not None)  # lines before the names
        if not above:
            file.seek(0)
        sign = said or max(",;\t", key=first.count)
        lines = csv.reader(file, delimiter=sign)
        try:
            numbered = [(lines.line_num + above, row) for row in lines]
        except csv.Error as error:
            raise ValueError(f"{path}, line {lines.line_num + above}: {error}; write it again as a table") from error
    says = [k for k, (_, row) in enumerate(numbered) if any(map(str.strip, row))]
    if len(says) < 2:
        raise ValueError(f"{path}: holds no rows under a line of names")
    names, *below = numbered[says[0] : says[-1] + 1]
    empty = [""] * len(names[1])
    below = [(line, row if any(map(str.strip, row)) else empty) for line, row in below if row]
    return sign, [names[0], *(line for line, _ in below)], [names[1], *(row for _, row in below)]


def _columns(path: Path, head: Sequence[str]) -> tuple[dict[str, list[int]], str | None]:
    """The three columns of each joint, and the unit that they say; the axis is behind the names, or before them all."""
    whole: dict[str, list[int]] = {}
    for pattern, joint, of in ((COLUMN, 1, 2), (AXIS_FIRST, 2, 1)):
        found: dict[str, dict[str, int]] = {}
        said: dict[str, set[str | None]] = {}
        for k, name in enumerate(head):
            if (match := pattern.match(name)) and name.lower() not in (*FRAME, *TIME, *PERSON):
                found.setdefault(match[joint], {})[match[of].lower()] = k
                said.setdefault(match[joint], set()).add(match[3].lower() if match[3] else None)
        whole = {name: [axes[axis] for axis in "xyz"] for name, axes in found.items() if len(axes) == 3}
        if whole:
            break
    units = set().union(*(said[name] for name in whole))  # a column `index`, which ends in x, is no joint's
    if not whole:
        raise ValueError(
            f"{path}: no columns of joints, such as left_hip_x_m, left_hip_y_m, left_hip_z_m; it has "
            f"{', '.join(head[:8])}{' ...' if len(head) > 8 else ''}{_instead(head)}"
        )
    if len(units) > 1:
        raise ValueError(f"{path}: its columns are in different units; bring them to one")
    return whole, units.pop()


def _instead(head: Sequence[str]) -> str:
    """What a table without three columns a joint seems to hold, and what to do, to end an error with."""
    words = [name.lower() for name in head]
    if set("xyz") <= set(words):
        return "; a row for each joint is not read: make columns of them, a row for each frame and person"
    axes = {
        match[2].lower() for name in words if (match := COLUMN.match(name)) and name not in (*FRAME, *TIME, *PERSON)
    }
    return "; x and y alone are places in a picture: positions in space are needed" if {"x", "y"} == axes else ""


def _side_by_side(table: JointTable) -> JointTable:
    """Of a table that names nobody, people whose joints are side by side in a row: A_left_hip ... B_left_hip ...

    Everybody has the same joints, whose names tell the sides by themselves, before or behind one word for each.
    """
    if table.people != ("",):
        return table
    for pattern in (r"(?P<who>.+?)[ _.:-]+(?P<joint>.+)", r"(?P<joint>.+)[ _.:-]+(?P<who>.+?)"):
        parts = [re.fullmatch(pattern, name) for name in table.names]
        if not all(parts):
            continue
        of: dict[str, dict[str, int]] = {}
        for k, part in enumerate(parts):
            assert part is not None
            of.setdefault(part["who"], {})[part["joint"]] = k
        (first, *others) = of.values()
        alike = all(set(each) == set(first) for each in others) and len(first) * len(of) == len(parts)
        if others and alike and not recognised(tuple(first)).missing:
            at = np.stack([table.at[:, 0, [each[joint] for joint in first]] for each in of.values()], axis=1)
            return replace(table, names=tuple(first), people=tuple(of), at=at)
    return table


def _number(path: Path, line: int, row: Sequence[str], k: int, sign: str) -> float:
    if k >= len(row):
        raise ValueError(f"{path}, line {line}: {len(row)} cells, fewer than names; the file may be cut short")
    try:
        return float(row[k] if sign == "," else row[k].replace(",", "."))
    except ValueError:
        return math.nan  # empty, or of a column of words


def _frames(
    table: TableRows, numbers: Floats, column: int | None, seconds: Floats | None
) -> tuple[NDArray[np.int64], int]:
    """The frame of each row, from 0, and by how many the file counts on from one to the next."""
    path = table.path
    if column is None:
        if seconds is not None and np.isfinite(seconds).all():
            frame = table_times.frames_by_time(table, seconds)
            if frame.max() >= LONGEST:
                long = f"{np.ptp(seconds):.6g} seconds"
                raise ValueError(f"{path}: times of {long}, more frames than are read ({LONGEST})")
            return frame, 1
        count: dict[str, int] = {}
        frames = []
        for person in table.told:
            frames.append(count.setdefault(person, 0))
            count[person] += 1
        if len(set(count.values())) > 1:
            few, many = min(count, key=count.__getitem__), max(count, key=count.__getitem__)
            raise ValueError(
                f"{path}: person {few} has fewer rows ({count[few]}) than {many} ({count[many]}), and nothing says "
                "at which frames; add a column frame or time_s"
            )
        return np.array(frames), 1
    said = numbers[:, column]
    if (wrong := said[~(np.isfinite(said) & (said == np.round(said)))]).size:
        raise ValueError(f"{path}: frame {wrong[0]:g}: expected whole numbers")
    if len(set(zip(table.told, said.tolist(), strict=True))) < len(said):
        table_times.require_one_recording(table, said, "frames")
    if seconds is not None:
        table_times.require_times_with_frames(table, seconds, said)
    frame = np.minimum(said - said.min(), 2.0**53).astype(np.int64)
    step = max(int(np.gcd.reduce(frame)), 1) if len(set(frame.tolist())) > 2 else 1
    if frame.max() // step >= LONGEST:
        raise ValueError(f"{path}: frames {said.min():.0f} to {said.max():.0f}, more than is read ({LONGEST})")
    return frame // step, step


def _steps(table: TableRows, values: Floats) -> Floats:
    """From each value of a person to the next. -> (N,), none below 0"""
    each = (values[rows] for rows in table.of_each)
    return np.concatenate([np.diff(np.sort(own[np.isfinite(own)])) for own in each])


def _seconds(
    table: TableRows, numbers: Floats, column: int, frames: int | None, head: Sequence[str]
) -> tuple[Floats | None, str]:
    """Times in seconds, and a word on what they were understood as, if not that; None: they are numbers of frames.

    Smaller parts of a second are told by the frames a second that they make, those that a column counts.
    """
    said = numbers[:, column]
    good, steps = said[np.isfinite(said)], _steps(table, said)
    counted = np.ones(1) if frames is None else _steps(table, numbers[:, frames])
    usual = max(float(np.median(counted[counted > 0])), 1.0) if (counted > 0).any() else 1.0
    step = 0.0
    if len(np.unique(good)) > 2:  # where many rows have one time, such as whole seconds, the mean tells
        step = float(np.median(steps[steps > 0]) if np.median(steps) > 0 else steps.mean()) / usual
    if step * usual == 1 and (steps > 0).all() and (good == np.round(good)).all():
        return (None, f"its column {head[column]} counts frames") if usual < SLOW else (said, "")
    likely = [parts for parts in PARTS if SLOW <= parts / step <= FAST] if step else []
    likely += [parts for parts in PARTS if step / parts <= SLOWEST]
    parts = [*likely, 1.0][0]
    return said / parts, "" if parts == 1 else f"its times are taken as {PARTS[parts]}"


def _first_time(seconds: Floats, frame: NDArray[np.int64], fps: float | None) -> float | None:
    """The time of the first frame, by the first row that says one."""
    good = np.nonzero(np.isfinite(seconds))[0]
    if not len(good):
        return None
    row = good[frame[good].argmin()]
    return float(seconds[row] - (frame[row] / fps if fps else 0.0))


def _rate(table: TableRows, seconds: Floats, frame: NDArray[np.int64]) -> float | None:
    """Frames a second, by the first and the last row that say a time, of who has them for longest."""
    found: list[tuple[float, float]] = []
    for rows in table.of_each:
        mine = rows[np.isfinite(seconds[rows])]
        mine = mine[np.argsort(frame[mine], kind="stable")]
        times, first = np.unique(seconds[mine], return_index=True)
        if len(mine) >= COARSE * len(times):  # a first time may have begun before its first row
            mine = mine[first[1:]]
        if len(mine) and np.ptp(seconds[mine]) > 0 and np.ptp(frame[mine]) > 0:
            found.append((float(np.ptp(seconds[mine])), float(np.ptp(frame[mine]))))
    if not found:
        return None
    long, count = max(found)
    return usual_rate(count / long)
