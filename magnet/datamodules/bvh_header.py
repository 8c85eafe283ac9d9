"""What the header of a BVH file says: joints with their end sites, channel orders, frames and their duration."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from magnet.datamodules.arrays import AGAIN, Doubles
from magnet.datamodules.recording import DataError
from magnet.datamodules.unpickle import contents


@dataclass(frozen=True)
class BvhHeader:
    """K joints in the file's order, parents first; an end site is a joint called after its parent, such as HeadEnd."""

    names: tuple[str, ...]
    parents: tuple[int, ...]  # the root's is -1
    offsets: Doubles  # (K, 3) in the file's unit
    orders: tuple[str, ...]  # such as "zxy", rotation channels as listed, which turns about z first; "" at end sites
    frames: int
    seconds: float  # a frame lasts

    def reversed_order(self) -> list[int]:
        """Joints depth first, the last child before the first: how bvh-converter's csv files list them."""
        order, stack = [], [0]
        while stack:
            joint = stack.pop()
            order.append(joint)
            stack += [k for k, parent in enumerate(self.parents) if parent == joint]
        return order


def read_bvh_header(path: Path) -> BvhHeader:
    """Read a BVH file's hierarchy; of its motion, only that all frames are there.

    Raises:
        DataError: no such file, no BVH, or cut short; names the line.
    """
    lines = contents(path).decode("latin-1").splitlines()
    begin = next((k for k, line in enumerate(lines) if line.split()[:1] == ["MOTION"]), None)
    if begin is None:
        raise DataError(f"{path}: {len(lines)} lines without MOTION: no BVH file, or cut short; {AGAIN}")
    names, parents, offsets, orders, width = _hierarchy(path, lines[:begin])
    heading = dict(_pair(line) for line in lines[begin + 1 : begin + 3])
    try:
        frames, seconds = int(heading["frames"]), float(heading["frame time"])
    except (KeyError, ValueError) as error:
        raise DataError(f"{path}:{begin + 2}: no Frames and Frame Time after MOTION; {AGAIN}") from error
    rows = [line for line in lines[begin + 3 :] if line.strip()]
    if len(rows) != frames or frames < 1:
        raise DataError(f"{path}: says {frames} frames, has {len(rows)}: cut short; {AGAIN}")
    if len(rows[-1].split()) != width:
        raise DataError(f"{path}: its last frame has {len(rows[-1].split())} of {width} numbers: cut short; {AGAIN}")
    if not (math.isfinite(seconds) and seconds > 0):
        raise DataError(f"{path}: Frame Time is {seconds}, expected seconds; {AGAIN}")
    return BvhHeader(tuple(names), tuple(parents), np.array(offsets), tuple(orders), frames, seconds)


def _pair(line: str) -> tuple[str, str]:
    key, _, value = line.partition(":")
    return key.strip().lower(), value.strip()


def _hierarchy(path: Path, lines: list[str]) -> tuple[list[str], list[int], list[list[float]], list[str], int]:
    names: list[str] = []
    parents: list[int] = []
    offsets: list[list[float]] = []
    orders: list[str] = []
    open_joints: list[int] = []
    width = 0
    for where, words in _words(path, lines):
        key = words[0].upper()
        if key in ("ROOT", "JOINT", "END"):
            if (key == "ROOT") != (not names) or (names and not open_joints):
                raise DataError(f"{where}: {' '.join(words)} in the wrong place; {AGAIN}")
            parents.append(open_joints[-1] if open_joints else -1)
            names.append(f"{names[parents[-1]]}End" if key == "END" else " ".join(words[1:]))
            offsets.append([math.nan] * 3)
            orders.append("")
        elif key == "{" and names:
            open_joints.append(len(names) - 1)
        elif key == "}" and open_joints:
            open_joints.pop()
        elif key == "OFFSET" and open_joints:
            offsets[open_joints[-1]] = _three(where, words[1:])
        elif key == "CHANNELS" and open_joints:
            width += len(words) - 2
            orders[open_joints[-1]] = "".join(
                word[0].lower() for word in words[2:] if word.lower().endswith("rotation")
            )
        elif not key.endswith("HIERARCHY"):  # a byte-order mark may come first
            raise DataError(f"{where}: {' '.join(words)[:60]!r} is not understood; {AGAIN}")
    if open_joints or not names or not np.isfinite(offsets).all() or len(set(names)) < len(names):
        raise DataError(
            f"{path}: its hierarchy is not whole: a brace, an OFFSET or a name of its own is missing; {AGAIN}"
        )
    return names, parents, offsets, orders, width


def _words(path: Path, lines: list[str]) -> Iterator[tuple[str, list[str]]]:
    for number, line in enumerate(lines, start=1):
        if words := line.split():
            yield f"{path}:{number}", words


def _three(where: str, words: list[str]) -> list[float]:
    try:
        x, y, z = map(float, words)
    except ValueError as error:
        raise DataError(f"{where}: OFFSET {' '.join(words)[:60]}, expected three numbers; {AGAIN}") from error
    return [x, y, z]
