"""Reader of Acclaim's AMC files: motion of a skeleton, as CMU's recordings come in.

World rotations take the rest pose (arms along x, y up, facing +z) to the pose; positions are the bones' *ends*.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from magnet.datamodules.reading.arrays import AGAIN
from magnet.datamodules.reading.asf import ROTATIONS, TRANSLATIONS, AsfSkeleton, Floats, euler, numbers, said_lines
from magnet.datamodules.reading.recording import DataError
from magnet.motion.resample import slerp

Bools = NDArray[np.bool_]


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
    """Recordings of people captured together, which must be equally long; `trim` cuts them to the shortest.

    Raises:
        DataError: lengths or frame rates differ.
    """
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
