"""Reader of BVH files, anybody's: hierarchy and motion as written, and joints in the world."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

AXES = "XYZ"
RATES = (23.976, 24.0, 25.0, 29.97, 30.0, 48.0, 50.0, 59.94, 60.0, 90.0, 100.0, 119.88, 120.0, 240.0)
"""Rates that a rounded Frame Time such as 0.033333 stands for."""


@dataclass(frozen=True)
class Bvh:
    """One skeleton of K joints, parents first, and T frames; lengths in the file's unknown unit."""

    names: tuple[str, ...]
    parents: tuple[int, ...]  # the root's is -1
    offsets: Floats  # (K, 3) from the parent, in the rest pose
    place: Floats  # (T, K, 3) from the parent in each frame; differs from `offsets` only where a joint slides
    local: Floats  # (T, K, 3, 3) rotation relative to the parent; all are the identity in the rest pose
    fps: float
    path: Path

    @property
    def frames(self) -> int:
        return len(self.local)

    def rest(self) -> Floats:
        """Joints in the rest pose, the root at the origin. (K, 3)"""
        rest = np.zeros_like(self.offsets)
        for k, parent in enumerate(self.parents):
            rest[k] = 0.0 if parent < 0 else rest[parent] + self.offsets[k]
        return rest

    def world(self) -> tuple[Floats, Floats]:
        """Rotations from the rest pose (T, K, 3, 3) and positions (T, K, 3) in the file's world."""
        turned, at = np.empty_like(self.local), np.empty_like(self.place)
        for k, parent in enumerate(self.parents):
            if parent < 0:
                turned[:, k], at[:, k] = self.local[:, k], self.place[:, k]
            else:
                turned[:, k] = turned[:, parent] @ self.local[:, k]
                at[:, k] = at[:, parent] + (turned[:, parent] @ self.place[:, k, :, None])[..., 0]
        return turned, at


@dataclass
class _Joint:
    name: str
    parent: int
    offset: Sequence[float] | None = None
    channels: list[str] = field(default_factory=list)


def read_bvh(path: str | Path) -> Bvh:
    """Read one BVH file.

    Positions of joints replace their OFFSET, as most programs write them, unless they stay nearer to zero than to it,
    in which case they are added.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: no BVH, truncated, or a line makes no sense; names file and line.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig", errors="replace")
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{path}: no such file") from error
    lines = text.splitlines()
    begin = next((i for i, line in enumerate(lines) if line.strip().upper() == "MOTION"), None)
    if not lines or lines[0].strip().upper() != "HIERARCHY":
        raise ValueError(f"{path}: not a BVH file: it does not begin with HIERARCHY")
    if begin is None:
        raise ValueError(f"{path}: has no MOTION part; the file may be truncated: export it again")
    joints = _hierarchy(path, lines[1:begin])
    values, fps = _motion(path, lines, begin, sum(len(joint.channels) for joint in joints))
    offsets = np.array([joint.offset for joint in joints], dtype=np.float64)
    T, K = len(values), len(joints)
    place = np.broadcast_to(offsets, (T, K, 3)).copy()
    local = np.broadcast_to(np.eye(3), (T, K, 3, 3)).copy()
    column = 0
    for k, joint in enumerate(joints):
        moved = {}
        for channel in joint.channels:
            axis = AXES.index(channel[0])
            if channel.endswith("position"):
                moved[axis] = values[:, column]
            else:
                local[:, k] = local[:, k] @ _about(axis, np.radians(values[:, column]))
            column += 1
        if moved:
            place[:, k] = _placed(offsets[k], moved, T)
    parents = tuple(joint.parent for joint in joints)
    return Bvh(tuple(joint.name for joint in joints), parents, offsets, place, local, fps, path)


def _placed(offset: Floats, moved: dict[int, Floats], frames: int) -> Floats:
    channels = np.zeros((frames, 3))
    for axis, values in moved.items():
        channels[:, axis] = values
    middle = np.median(channels, axis=0)
    added = np.linalg.norm(middle) < np.linalg.norm(middle - offset)
    return channels + offset if added else channels


def _about(axis: int, radians: Floats) -> Floats:
    """Rotation about x, y or z. (T,) -> (T, 3, 3)"""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.zeros((len(radians), 3, 3))
    matrix[:, axis, axis] = 1.0
    matrix[:, i, i] = matrix[:, j, j] = np.cos(radians)
    matrix[:, j, i] = np.sin(radians)
    matrix[:, i, j] = -matrix[:, j, i]
    return matrix


# -- hierarchy ---------------------------------------------------------------------------------


def _hierarchy(path: Path, lines: Sequence[str]) -> list[_Joint]:
    joints: list[_Joint] = []
    open_blocks: list[int | None] = []  # joint numbers; None: an End Site, whose offset moves nothing
    pending: int | None = None
    for number, line in enumerate(lines, start=2):
        where = f"{path}:{number}"
        for words in _statements(line):
            key = words[0].upper()
            if key in ("ROOT", "JOINT"):
                if key == "ROOT" and joints:
                    raise ValueError(f"{where}: a second ROOT; write each person to a BVH file of their own")
                if key == "JOINT" and not open_blocks:
                    raise ValueError(f"{where}: a JOINT outside the ROOT")
                parent = open_blocks[-1] if open_blocks else -1
                joints.append(_Joint(" ".join(words[1:]) or f"joint{len(joints)}", -1 if parent is None else parent))
                pending = len(joints) - 1
            elif key == "END":
                pending = None
            elif key == "{":
                open_blocks.append(pending)
            elif key == "}":
                if not open_blocks:
                    raise ValueError(f"{where}: a closing brace too many")
                open_blocks.pop()
            elif key in ("OFFSET", "CHANNELS"):
                if not open_blocks:
                    raise ValueError(f"{where}: {key} outside a joint")
                here = open_blocks[-1]
                if here is not None:
                    _fill(where, joints[here], key, words[1:])
            else:
                raise ValueError(f"{where}: {words[0]!r}: expected ROOT, JOINT, End Site, OFFSET, CHANNELS or a brace")
    lacking = [joint.name for joint in joints if joint.offset is None]
    if not joints or lacking or open_blocks:
        raise ValueError(f"{path}: the HIERARCHY is incomplete; the file may be truncated: export it again")
    return joints


def _statements(line: str) -> list[list[str]]:
    """Words of a line, with braces as statements of their own."""
    return [words for part in line.replace("{", "\n{\n").replace("}", "\n}\n").split("\n") if (words := part.split())]


def _fill(where: str, joint: _Joint, key: str, words: Sequence[str]) -> None:
    if key == "OFFSET":
        joint.offset = _floats(where, words, 3)
        return
    try:
        count = int(words[0])
    except (IndexError, ValueError) as error:
        raise ValueError(f"{where}: CHANNELS without a number of them") from error
    channels = [word[:1].upper() + word[1:].lower() for word in words[1:]]
    known = {f"{axis}{kind}" for axis in AXES for kind in ("position", "rotation")}
    if len(channels) != count or not set(channels) <= known:
        raise ValueError(f"{where}: CHANNELS {' '.join(words)}: expected {count} of Xposition ... Zrotation")
    joint.channels = channels


def _floats(where: str, words: Sequence[str], count: int) -> list[float]:
    try:
        numbers = [float(word) for word in words]
    except ValueError as error:
        raise ValueError(f"{where}: {error}; expected {count} numbers") from error
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise ValueError(f"{where}: got {' '.join(words) or 'nothing'}, expected {count} finite numbers")
    return numbers


# -- motion ------------------------------------------------------------------------------------


def _motion(path: Path, lines: Sequence[str], begin: int, width: int) -> tuple[Floats, float]:
    """All numbers (T, D), and frames a second."""
    head: dict[str, str] = {}
    at = begin + 1
    while at < len(lines) and len(head) < 2:
        key, colon, value = lines[at].partition(":")
        if lines[at].strip() and not colon:
            break
        if colon:
            head[" ".join(key.lower().split())] = value.strip()
        at += 1
    try:
        frames, step = int(head["frames"]), float(head["frame time"])
    except (KeyError, ValueError) as error:
        raise ValueError(f"{path}:{begin + 2}: expected the lines 'Frames: N' and 'Frame Time: SECONDS'") from error
    if not 0 < step < 10 or frames < 1:
        raise ValueError(f"{path}:{begin + 2}: {frames} frames of {step:g} s; expected at least one of 0 to 10 s")
    words = " ".join(lines[at:]).split()
    if len(words) != frames * width:
        has = f"{len(words) / max(width, 1):.4g} frames of {width} numbers"
        advice = "the file is truncated: export it again" if len(words) < frames * width else "its header is wrong"
        raise ValueError(f"{path}: Frames: {frames}, but {has} follow; {advice}")
    try:
        values = np.array(words, dtype=np.float64).reshape(frames, width)
    except ValueError as error:
        raise ValueError(f"{path}: the MOTION part holds something that is no number ({error})") from error
    if not np.isfinite(values).all():
        frame = int((~np.isfinite(values).all(axis=1)).argmax())
        raise ValueError(f"{path}:{at + 1 + frame}: frame {frame + 1} holds NaN or infinity; leave such frames out")
    return values, _rate(step)


def _rate(step: float) -> float:
    """Frames a second of a Frame Time that may have been rounded to few digits."""
    fps = 1 / step
    nearest = min(RATES, key=lambda rate: abs(rate - fps))
    if abs(nearest - fps) < 5e-4 * fps:
        return nearest
    return float(round(fps)) if abs(round(fps) - fps) < 1e-3 * fps else fps
