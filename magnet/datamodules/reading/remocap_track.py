"""One person of ReMoCap: joint positions in a csv file, and the check of its joints and units against the BVH."""

from __future__ import annotations

import io
import itertools
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from magnet.datamodules.reading.arrays import AGAIN, Doubles, floats, one_length
from magnet.datamodules.reading.asf_amc import euler
from magnet.datamodules.reading.fields import pickled_mapping
from magnet.datamodules.reading.recording import DataError
from magnet.motion.bvh import bvh_header
from magnet.unpickle import contents

from magnet.body.joints import (  # isort: skip
    HEAD, L_ANKLE, L_ELBOW, L_FOOT, L_HIP, L_KNEE, L_SHOULDER, L_WRIST, NECK, PELVIS, R_ANKLE, R_ELBOW, R_FOOT, R_HIP,
    R_KNEE, R_SHOULDER, R_WRIST,
)  # fmt: skip

RATE = 50.0
MAP = {
    PELVIS: "Hips", L_HIP: "LeftUpLeg", R_HIP: "RightUpLeg", L_KNEE: "LeftLeg", R_KNEE: "RightLeg",
    L_ANKLE: "LeftFoot", R_ANKLE: "RightFoot", L_FOOT: "LeftToeBase", R_FOOT: "RightToeBase", NECK: "Neck",
    HEAD: "Head", L_SHOULDER: "LeftArm", R_SHOULDER: "RightArm", L_ELBOW: "LeftForeArm", R_ELBOW: "RightForeArm",
    L_WRIST: "LeftHand", R_WRIST: "RightHand",
}  # fmt: skip
"""Our joint: theirs. Their spine has six joints and ours three, so only its ends are used."""
CLOSE = 0.01
"""Metres within which the skeleton's own rotations must lead to its positions."""
CHECKED = 40
"""Frames, evenly spread, that this is tried on."""


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
    """Read a BVH file's hierarchy; of its motion, only that all frames are there."""
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


def file_like(folder: Path, pattern: str, usual: str) -> Path:
    """The file that matches, or where it was expected."""
    return next(iter(sorted(folder.glob(pattern))), folder / usual)


def track(folder: Path, scale: float) -> tuple[Doubles, float, list[str]]:
    """Positions of the mapped joints in metres (T, M, 3), frame rate, and what was found.

    folder: one person's, with motion.bvh, csv files of positions and rotations and motion_offsets.pkl
    scale: metres a unit
    """
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder: a partner's files are missing; {AGAIN}")
    header = read_bvh_header(file_like(folder, "*.bvh", "motion.bvh"))
    table, clock = _table(file_like(folder, "*worldpos*.csv", "motion_worldpos.csv"))
    one_length(folder, {"motion.bvh": header.frames, table.path.name: len(table.values)})
    rate = round(1.0 / header.seconds, 2)
    found = "headings" if table.names else "lengths of bones"
    table = min(table.named(header), key=lambda one: _misfit(header, one))
    notes = [f"positions from {table.path.name}, joints by its {found}"]
    if abs(rate - RATE) > 0.5:
        notes.append(f"{rate:g} fps by its BVH, not {RATE:g}")
    step = float(np.median(np.diff(clock))) if len(clock) > 1 else header.seconds
    if abs(step - 1.0) > 1e-6 and abs(step - header.seconds) > 0.02 * header.seconds:
        raise DataError(
            f"{table.path}: rows are {step:g} s apart, its BVH says {header.seconds:g} s: was one of them thinned? "
            f"{AGAIN}"
        )
    positions = np.stack([table.of(joint) for joint in MAP.values()], axis=1)
    notes.append(_proof(folder, header, table, scale))
    return positions * scale, rate, notes


@dataclass(frozen=True)
class _Table:
    """A csv file: one row a frame, three columns a joint."""

    path: Path
    values: Doubles  # (T, columns / 3, 3)
    names: tuple[str, ...]  # by the headings, where these are such as "Hips.X"; else none

    def of(self, joint: str) -> Doubles:
        """One joint's three columns. (T, 3)"""
        if joint not in self.names:
            raise DataError(f"{self.path}: no columns of {joint}; it has {', '.join(self.names[:8])}..; {AGAIN}")
        return self.values[:, self.names.index(joint)]

    def named(self, header: BvhSkeleton) -> list[_Table]:
        """With the names that its columns may stand for: its own, or those of the BVH in either direction."""
        if self.names:
            return [self]
        found = []
        for order in (header.reversed_order(), list(range(len(header.names)))):
            for joints in (order, [k for k in order if header.orders[k]]):
                if len(joints) == self.values.shape[1]:
                    found.append(replace(self, names=tuple(header.names[k] for k in joints)))
        if not found:
            raise DataError(
                f"{self.path}: columns of {self.values.shape[1]} joints without names, but the BVH has "
                f"{len(header.names)}; {AGAIN}"
            )
        return found


def _table(path: Path) -> tuple[_Table, Doubles]:
    """A csv file without its first column, and that column: times or frame numbers."""
    text = contents(path).decode("latin-1")
    first, _, rest = text.partition("\n")
    if not rest.strip():
        raise DataError(f"{path}: has no rows after its first line; {AGAIN}")
    heading = [word.strip() for word in first.split(",")]
    try:
        values = np.loadtxt(io.StringIO(rest), delimiter=",", ndmin=2, comments=None)
    except Exception as error:  # on damaged text numpy raises more than ValueError
        said = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
        raise DataError(f"{path}: not a table of numbers after its first line ({said}); {AGAIN}") from error
    if not len(values) or values.shape[1] < 4 or (values.shape[1] - 1) % 3:
        raise DataError(
            f"{path}: {values.shape[0]} rows of {values.shape[1]} columns, expected time and x, y, z a joint; "
            "download it again"
        )
    if len(heading) != values.shape[1]:
        raise DataError(f"{path}: {len(heading)} headings over {values.shape[1]} columns; {AGAIN}")
    values = floats(path, values, ("T", "columns"))
    stems = [word.rpartition(".") for word in heading[1:]]
    named = all(dot and stem for stem, dot, _ in stems)
    ordered = all([axis.upper() for *_, axis in stems[k : k + 3]] == list("XYZ") for k in range(0, len(stems), 3))
    if named and not ordered:
        raise DataError(
            f"{path}: columns are {', '.join(heading[1:7])}.., expected X, Y and Z of a joint in turn; {AGAIN}"
        )
    names = tuple(stem for stem, *_ in stems[::3]) if named else ()
    return _Table(path, values[:, 1:].reshape(len(values), -1, 3), names), values[:, 0]


def _misfit(header: BvhSkeleton, table: _Table) -> float:
    """How far bones are from their lengths in the BVH, in the files' unit, were the columns these joints."""
    off = []
    for name, parent, offset in zip(header.names, header.parents, header.offsets, strict=True):
        if parent >= 0 and name in table.names and header.names[parent] in table.names:
            bone = table.of(name)[0] - table.of(header.names[parent])[0]
            off.append(abs(np.linalg.norm(bone) - np.linalg.norm(offset)))
    return float(np.mean(off)) if off else 0.0


def _proof(folder: Path, header: BvhSkeleton, table: _Table, scale: float) -> str:
    """Find the Euler order with which rotations and offsets give the positions."""
    paths = sorted(folder.glob("*rotation*.csv"))
    if not paths:
        return "no csv of rotations: joints and units are not proven"
    listed, _ = _table(paths[0])
    one_length(folder, {table.path.name: len(table.values), paths[0].name: len(listed.values)})
    offsets, source = _offsets(folder, header)
    some = np.unique(np.linspace(0, len(table.values) - 1, CHECKED).astype(int))
    positions = {k: table.of(name)[some] for k, name in enumerate(header.names) if name in table.names}
    if 0 not in positions:
        raise DataError(f"{table.path}: no columns of the root, {header.names[0]}; {AGAIN}")
    namings = listed.named(header)
    degrees = [{k: one.of(header.names[k])[some] for k, order in enumerate(header.orders) if order} for one in namings]
    radians = [{k: np.radians(turns) for k, turns in one.items()} for one in degrees]
    order, error = _order(header, offsets, radians, positions, CLOSE / scale)
    if not scale * error < CLOSE:
        unit = f"lengths are millimetres (scale={scale:g} metres a unit)"
        advice = f"check that the files belong together and that {unit}"
        if scale * _order(header, offsets, degrees, positions, CLOSE / scale)[1] < CLOSE:
            advice = f"{paths[0].name} looks like radians, expected degrees: convert it, or take the published file"
        raise DataError(
            f"{folder}: no Euler order leads from {source} and {paths[0].name} to {table.path.name}: "
            f"{100 * scale * error:.3g} cm apart at best, expected less than 1 cm; {advice}"
        )
    mm = max(1, math.ceil(1000 * scale * error))  # so that takes alike share a note
    return f"rotations and {source}, Euler order {order}, lead to the positions within {mm} mm"


def _order(
    header: BvhSkeleton,
    offsets: Doubles,
    namings: list[dict[int, Doubles]],
    positions: dict[int, Doubles],
    close: float,
) -> tuple[str, float]:
    """The Euler order that leads closest, and how far off in the files' unit.

    Args:
        header: the joints.
        offsets: (K, 3) in the parent's frame.
        namings: angles (T, 3) by joint, for each way of naming the columns.
        positions: (T, 3) by joint.
        close: how far off is near enough for the order of the BVH.
    """
    best, error = "", np.inf
    for turns in namings:
        for order in ("", *map("".join, itertools.permutations("xyz"))):
            # Channels are turned about in their order and each in the frame of those before: fixed axes backwards.
            local = {k: euler(turn, (order or header.orders[k])[::-1]) for k, turn in turns.items()}
            off = _far(header, offsets, local, positions)
            if off < error:
                best, error = order or f"{header.orders[0]} as in the BVH", off
            if error < close and not order:
                break
    return best, error


def _offsets(folder: Path, header: BvhSkeleton) -> tuple[Doubles, str]:
    """Each joint's place in its parent's frame. (K, 3), and the file they are from"""
    paths = sorted(folder.glob("*offsets.pkl"))
    if not paths:
        return header.offsets, "the BVH"
    held = pickled_mapping(paths[0])
    offsets = header.offsets.copy()
    for k, name in enumerate(header.names):
        if name in held:
            offset = held[name]
            offsets[k] = floats(
                f"{paths[0]}: {name}", offset.ravel() if isinstance(offset, np.ndarray) else offset, (3,)
            )
        elif header.orders[k]:
            raise DataError(f"{paths[0]}: has no offset of {name}; {AGAIN}")
    return offsets, paths[0].name


def _far(header: BvhSkeleton, offsets: Doubles, local: dict[int, Doubles], positions: dict[int, Doubles]) -> float:
    """Largest distance of a joint from where the chain leads, over frames and joints, in the files' unit."""
    turned: list[Doubles] = []
    reached: list[Doubles] = []
    for k, parent in enumerate(header.parents):
        own = local.get(k, np.eye(3))
        turned.append(own if parent < 0 else turned[parent] @ own)
        reached.append(positions[0] if parent < 0 else reached[parent] + turned[parent] @ offsets[k])
    return float(max(np.linalg.norm(reached[k] - there, axis=-1).max() for k, there in positions.items()))
