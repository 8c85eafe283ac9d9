"""Reader of Acclaim's AMC files: motion of a skeleton, as CMU's recordings come in.

World rotations take the rest pose (arms along x, y up, facing +z) to the pose; positions are the bones' *ends*.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from magnet.datamodules.reading.arrays import AGAIN
from magnet.datamodules.reading.recording import DataError
from magnet.export.bvh_read import about
from magnet.motion.resample import slerp

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

INCH = 0.0254
TRANSLATIONS, ROTATIONS = ("tx", "ty", "tz"), ("rx", "ry", "rz")


@dataclass(frozen=True)
class AsfSkeleton:
    """K bones, the root first and every parent before its children."""

    names: tuple[str, ...]
    parents: tuple[int, ...]  # the root's is -1
    offset: Floats  # (K, 3) metres, from a bone's start to its end in the rest pose
    axis: Floats  # (K, 3, 3) the frame C that a bone's angles are measured in
    axis_order: tuple[str, ...]  # "xyz": about x first
    dofs: tuple[tuple[str, ...], ...]  # tx ... rz, in the order in which an AMC line lists them
    metres: float  # a unit of length
    degrees: bool
    path: Path

    @property
    def moving(self) -> dict[str, int]:
        """Numbers that an AMC line of each bone holds, for bones that have any."""
        return {name: len(dofs) for name, dofs in zip(self.names, self.dofs, strict=True) if dofs}


def euler(radians: Floats, order: str) -> Floats:
    """Rotation about fixed axes in `order`, which "xyz" makes Rz Ry Rx. (..., 3) of x, y, z -> (..., 3, 3)"""
    axes = map("xyz".index, order)
    return functools.reduce(lambda turned, axis: about(axis, radians[..., axis]) @ turned, axes, np.eye(3))


# -- reading -----------------------------------------------------------------------------------


def said_lines(path: Path) -> Iterator[tuple[str, list[str]]]:
    """Place ("file:line") and words of each line that says something."""
    try:
        text = path.read_text(encoding="latin-1")
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{path}: no such file") from error
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split("#")[0].split()
        if words:
            yield f"{path}:{number}", words


def numbers(where: str, words: Sequence[str], count: int) -> list[float]:
    if len(words) != count:
        raise DataError(f"{where}: got {len(words)} numbers, expected {count}; {AGAIN}")
    try:
        numbers = [float(word) for word in words]
    except ValueError as error:
        raise DataError(f"{where}: {error}, expected {count} numbers; {AGAIN}") from error
    if not all(map(math.isfinite, numbers)):
        raise DataError(f"{where}: holds NaN or infinity; download the file again or leave it out")
    return numbers


@dataclass
class _Bone:
    name: str = ""
    direction: Sequence[float] = (0.0, 0.0, 0.0)
    length: float = 0.0
    angles: Sequence[float] = (0.0, 0.0, 0.0)
    order: str = "xyz"
    dofs: tuple[str, ...] = ()
    parent: str = ""


def _dofs(where: str, words: Sequence[str]) -> tuple[str, ...]:
    dofs = tuple(word.lower() for word in words)
    unknown = sorted(set(dofs) - {*TRANSLATIONS, *ROTATIONS})
    if unknown:
        raise DataError(f"{where}: unknown degree of freedom {unknown}, expected some of tx ty tz rx ry rz; {AGAIN}")
    return dofs


def _order(where: str, word: str) -> str:
    if sorted(word.lower()) != ["x", "y", "z"]:
        raise DataError(f"{where}: axis order {word!r}, expected XYZ in some order; {AGAIN}")
    return word.lower()


def read_asf(path: str | Path) -> AsfSkeleton:
    """A skeleton from an ASF file.

    Lengths: `:units length` u says that a number x is x / u inches (checked on CMU's files, where u is 0.45).

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: not an ASF file, or a line makes no sense; names the line.
    """
    path = Path(path)
    root, bone, section = _Bone(name="root"), _Bone(), ""
    bones, unit, degrees, children = {"root": root}, 1.0, True, 0
    for where, words in said_lines(path):
        key, rest = words[0].lower(), words[1:]
        if key.startswith(":"):
            section = key[1:]
        elif section == "units" and key == "length":
            unit = numbers(where, rest, 1)[0]
        elif section == "units" and key == "angle":
            degrees = rest[:1] == ["deg"]
        elif section == "root":
            _root_line(where, key, rest, root)
        elif section == "bonedata":
            if key == "begin":
                bone = _Bone()
            elif key == "end":
                bones[bone.name] = bone
            else:
                _bone_line(where, key, rest, bone)
        elif section == "hierarchy" and key not in ("begin", "end"):
            for name in words:
                if name not in bones:
                    raise DataError(f"{where}: unknown bone {name!r}; the skeleton has {', '.join(bones)}; {AGAIN}")
            for name in rest:
                bones[name].parent = words[0]
                children += 1
    if not children or not root.dofs:
        raise DataError(f"{path}: not an ASF skeleton: lacks :root order or :hierarchy, may be truncated; {AGAIN}")
    if not unit > 0:
        raise DataError(f"{path}: :units length is {unit}, expected a positive number; {AGAIN}")
    return _assembled(path, bones, unit, degrees)


def _root_line(where: str, key: str, rest: list[str], root: _Bone) -> None:
    if key == "order":
        root.dofs = _dofs(where, rest)
    elif key == "axis":
        root.order = _order(where, rest[0] if rest else "")
    elif key in ("position", "orientation") and any(numbers(where, rest, 3)):
        raise DataError(f"{where}: a root {key} other than 0 0 0 is not supported: leave the subject out")


def _bone_line(where: str, key: str, rest: list[str], bone: _Bone) -> None:
    if key == "name":
        bone.name = " ".join(rest)
    elif key == "direction":
        bone.direction = numbers(where, rest, 3)
    elif key == "length":
        bone.length = numbers(where, rest, 1)[0]
    elif key == "axis":
        bone.angles, bone.order = numbers(where, rest[:3], 3), _order(where, rest[3] if len(rest) > 3 else "")
    elif key == "dof":
        bone.dofs = _dofs(where, rest)
        if set(bone.dofs) & set(TRANSLATIONS):
            raise DataError(f"{where}: bone {bone.name!r} moves along its parent, which is not supported")


def _assembled(path: Path, bones: dict[str, _Bone], unit: float, degrees: bool) -> AsfSkeleton:
    """Bones with parents first."""
    order = ["root"]
    for name in order:
        order += [child for child, bone in bones.items() if bone.parent == name and child not in order]
    lost = sorted(set(bones) - set(order))
    if lost:
        raise DataError(f"{path}: bones {lost} hang on nothing; the :hierarchy is incomplete; {AGAIN}")
    chosen = [bones[name] for name in order]
    angles = np.array([bone.angles for bone in chosen], dtype=np.float64)
    angles = np.radians(angles) if degrees else angles
    metres = INCH / unit
    return AsfSkeleton(
        names=tuple(order),
        parents=tuple(-1 if name == "root" else order.index(bones[name].parent) for name in order),
        offset=np.array([np.multiply(bone.direction, bone.length * metres) for bone in chosen]),
        axis=np.stack([euler(a, bone.order) for a, bone in zip(angles, chosen, strict=True)]),
        axis_order=tuple(bone.order for bone in chosen),
        dofs=tuple(bone.dofs for bone in chosen),
        metres=metres,
        degrees=degrees,
        path=path,
    )


@dataclass(frozen=True)
class AmcRecording:
    """Motion of one skeleton: T frames of K bones."""

    skeleton: AsfSkeleton
    root: Floats  # (T, 3) metres
    local: Floats  # (T, K, 3, 3) rotation of each bone relative to its parent
    fps: float
    path: Path

    @property
    def frames(self) -> int:
        return len(self.root)

    def world(self) -> tuple[Floats, Floats]:
        """World rotations (T, K, 3, 3) and bone ends (T, K, 3) in metres."""
        rotation, end = np.empty_like(self.local), np.empty(self.local.shape[:-1])
        for k, parent in enumerate(self.skeleton.parents):
            rotation[:, k] = self.local[:, k] if parent < 0 else rotation[:, parent] @ self.local[:, k]
            start = self.root if parent < 0 else end[:, parent]
            end[:, k] = start + rotation[:, k] @ self.skeleton.offset[k]
        return rotation, end

    def resampled(self, fps: float) -> AmcRecording:
        """The same motion at exact times t = i / fps: slerp on rotations, straight lines between positions."""
        frames = math.floor((self.frames - 1) / self.fps * fps + 1e-6) + 1
        at = np.arange(frames) * (self.fps / fps)
        return replace(self.at(at), fps=fps)

    def at(self, at: NDArray[np.floating]) -> AmcRecording:
        """The motion at fractional frame numbers, as a recording of the same rate. at: (T,)"""
        low = np.clip(np.floor(at + 1e-9).astype(int), 0, self.frames - 1)
        high = np.minimum(low + 1, self.frames - 1)
        share = np.clip(at - low, 0.0, 1.0)
        root = self.root[low] + share[:, None] * (self.root[high] - self.root[low])
        local = self.local[low]
        between = share > 1e-9
        if between.any():
            first, second = (torch.from_numpy(self.local[index[between]]) for index in (low, high))
            local[between] = slerp(first, second, torch.from_numpy(share[between])[:, None]).numpy()
        return replace(self, root=root, local=local)


# -- motion ------------------------------------------------------------------------------------


def read_amc(path: str | Path, skeleton: AsfSkeleton, fps: float) -> AmcRecording:
    """Motion from an AMC file, which does not say its frame rate.

    Raises:
        FileNotFoundError: there is no such file.
        DataError: a bone that the skeleton lacks, a frame without a bone it has, a wrong number of values, something
            that is not a number, NaN, a truncated file or one without frames; names file and line.
    """
    path = Path(path)
    values = parse_amc(path, skeleton)
    column, T, K = 0, len(values), len(skeleton.names)
    root, angles = np.zeros((T, 3)), np.zeros((T, K, 3))
    for k, dofs in enumerate(skeleton.dofs):
        for dof in dofs:
            if dof in TRANSLATIONS:
                root[:, TRANSLATIONS.index(dof)] = values[:, column] * skeleton.metres
            else:
                angles[:, k, ROTATIONS.index(dof)] = values[:, column]
            column += 1
    if skeleton.degrees:
        angles = np.radians(angles)
    local = np.empty((T, K, 3, 3))
    for k, order in enumerate(skeleton.axis_order):
        C = skeleton.axis[k]
        local[:, k] = C @ euler(angles[:, k], order) @ C.T
    return AmcRecording(skeleton, root, local, float(fps), path)


def parse_amc(path: Path, skeleton: AsfSkeleton) -> Floats:
    """All values (T, D) of a file, whose frames may list the skeleton's bones in any order."""
    moving = skeleton.moving
    starts, width = {}, 0
    for name, count in moving.items():
        starts[name], width = width, width + count
    rows: list[list[float]] = []
    seen: set[str] = set()
    where = str(path)

    def close(where: str) -> None:
        missing = [name for name in moving if name not in seen]
        if rows and missing:
            raise DataError(f"{where}: frame {len(rows)} ends without {', '.join(missing)}, may be truncated; {AGAIN}")

    for where, words in said_lines(path):
        if words[0].startswith(":"):
            if words[0].upper() == ":RADIANS" and skeleton.degrees:
                raise DataError(f"{where}: angles in radians, but {skeleton.path.name} says degrees; {AGAIN}")
            continue
        if len(words) == 1 and words[0].isdigit():
            close(where)
            if int(words[0]) != len(rows) + 1:
                raise DataError(f"{where}: frame {words[0]} follows frame {len(rows)}: frames are missing; {AGAIN}")
            rows.append([math.nan] * width)
            seen.clear()
            continue
        if not rows:
            raise DataError(f"{where}: {words[0]!r} before the first frame number; not an AMC motion; {AGAIN}")
        if words[0] not in moving:
            raise DataError(
                f"{where}: unknown bone {words[0]!r}; {skeleton.path.name} has {', '.join(moving)}; {AGAIN}"
            )
        if words[0] in seen:
            raise DataError(f"{where}: bone {words[0]!r} twice in frame {len(rows)}; {AGAIN}")
        seen.add(words[0])
        start, count = starts[words[0]], moving[words[0]]
        rows[-1][start : start + count] = numbers(where, words[1:], count)
    close(where)
    if not rows:
        raise DataError(f"{path}: holds no frames, may be truncated; {AGAIN}")
    return np.array(rows)


def together(recordings: Sequence[AmcRecording], trim: bool = False) -> list[AmcRecording]:
    """Recordings of people captured together, which must be equally long; `trim` cuts them to the shortest."""
    first = recordings[0]
    for other in recordings[1:]:
        if other.fps != first.fps:
            raise DataError(f"{first.path.name} has {first.fps} fps, {other.path.name} {other.fps}; give one rate")
        if other.frames != first.frames and not trim:
            raise DataError(
                f"{first.path.name} has {first.frames} frames, {other.path.name} {other.frames}; "
                "cut them to the shortest with trim=True"
            )
    frames = min(recording.frames for recording in recordings)
    return [replace(r, root=r.root[:frames], local=r.local[:frames]) for r in recordings]
