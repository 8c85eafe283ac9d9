"""Windows of clips as indices: which clips and frames, and who stands in which slot; where windows may start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnet.checks import require_whole
from magnet.datamodules.clip import Ints


@dataclass(frozen=True)
class WindowIndex:
    """What a batch of B windows shows: up to two clips each and who stands in which of the P slots."""

    clips: Ints  # (B, 2) index of the clip; the second is -1 unless the scene is composed
    starts: Ints  # (B, 2) first frame
    members: Ints  # (B, P) which person of the clip a slot shows, -1: nobody
    groups: Ints  # (B, P) which of the two clips the person comes from
    mirrored: NDArray[np.bool_]  # (B,)
    relative_pose: NDArray[np.float64]  # (B, 3) of the second group: yaw, direction in radians, distance in metres

    def __len__(self) -> int:
        return len(self.clips)

    def __getitem__(self, part: slice) -> WindowIndex:
        return WindowIndex(*(getattr(self, f)[part] for f in self.__dataclass_fields__))

    @staticmethod
    def concatenate(draws: Sequence[WindowIndex]) -> WindowIndex:
        return WindowIndex(*(np.concatenate([getattr(d, f) for d in draws]) for f in WindowIndex.__dataclass_fields__))


def all_starts(good: NDArray[np.bool_], frames: int) -> Ints:
    """First frames of every window of a clip to train on. good: (T,) bool

    Windows that hold an invalid frame are left out, unless the clip has no other: then the best ones stay.
    A clip shorter than the window has one, which starts at 0.
    """
    if len(good) <= frames:
        return np.zeros(1 if good.any() else 0, dtype=np.int64)
    total = np.concatenate([[0], np.cumsum(good)])
    count = total[frames:] - total[:-frames]
    best = count.max()
    return np.flatnonzero(count == best) if best else np.zeros(0, dtype=np.int64)


def spaced_starts(good: NDArray[np.bool_], frames: int, stride: int) -> Ints:
    """First frames of clean whole windows, `stride` apart; an invalid frame is stepped over. good: (T,) bool

    Raises:
        ValueError: the stride is less than a frame.
    """
    require_whole("stride", stride, 1)
    starts, start = [], 0
    while start + frames <= len(good):
        bad = np.flatnonzero(~good[start : start + frames])
        if len(bad):
            start += int(bad[-1]) + 1
        else:
            starts.append(start)
            start += stride
    return np.array(starts, dtype=np.int64)
