"""What the header of a BVH file says: joints with their end sites, channel orders, frames and their duration."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from magnet.datamodules.reading.arrays import AGAIN, Doubles
from magnet.datamodules.reading.recording import DataError
from magnet.motion.bvh import bvh_header
from magnet.unpickle import contents


@dataclass(frozen=True)
class BvhSkeleton:
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


def read_bvh_header(path: Path) -> BvhSkeleton:
    """Read a BVH file's hierarchy; of its motion, only that all frames are there.

    Raises:
        DataError: no such file, no BVH, or cut short; names the line.
    """
    lines = contents(path).decode("latin-1").removeprefix("\xef\xbb\xbf").splitlines()
    try:
        said = bvh_header(lines, path)
    except ValueError as error:
        raise DataError(f"{error}; {AGAIN}") from error
    rows = [line for line in lines[said.first :] if line.strip()]
    if len(rows) != said.frames:
        raise DataError(f"{path}: says {said.frames} frames, has {len(rows)}: cut short; {AGAIN}")
    if len(rows[-1].split()) != said.width:
        has = f"{len(rows[-1].split())} of {said.width} numbers"
        raise DataError(f"{path}: its last frame has {has}: cut short; {AGAIN}")
    names = [joint.name for joint in said.joints]
    names = [f"{names[joint.parent]}End" if joint.end else joint.name for joint in said.joints]
    if twice := {name for name in names if names.count(name) > 1}:
        raise DataError(f"{path}: several joints are called {', '.join(sorted(twice)[:5])}; {AGAIN}")
    if lacking := [name for name, joint in zip(names, said.joints, strict=True) if joint.offset is None]:
        raise DataError(f"{path}: {lacking[0]} has no OFFSET; {AGAIN}")
    turns = [[channel[0].lower() for channel in j.channels if channel.endswith("rotation")] for j in said.joints]
    return BvhSkeleton(
        names=tuple(names),
        parents=tuple(joint.parent for joint in said.joints),
        offsets=np.array([joint.offset for joint in said.joints], dtype=np.float64),
        orders=tuple(map("".join, turns)),
        frames=said.frames,
        seconds=said.seconds,
    )
