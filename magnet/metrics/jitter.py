"""Jitter, the change of acceleration from frame to frame, and jolts, which its mean hides (docs/metrics.md)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from torch import Tensor

from magnet.body.joints import PELVIS
from magnet.metrics.base import ClipMeans, clip_sums
from magnet.metrics.columns import Column
from magnet.metrics.futures import Futures, without_pelvis
from magnet.motion.scene import FPS


def jitter(joints: Tensor, fps: float = FPS) -> Tensor:
    """Mean length of the third difference over 21 joints. (..., T, P, 22, 3) -> (..., T - 3, P) in 10 m/s^3

    >>> import torch
    >>> time = torch.arange(30) / 30
    >>> joints = time.square()[:, None, None, None].expand(30, 1, 22, 3)  # the same acceleration throughout
    >>> bool(jitter(joints).max() < 0.1)
    True
    """
    return without_pelvis(joints).diff(n=3, dim=-4).norm(dim=-1).mean(dim=-1) * fps**3 / 10


class Jitter(ClipMeans):
    """`jitter` in 10 m/s^3; to be read beside the ground truth's, which is not 0.

    >>> from magnet.testing import standing_people
    >>> truth = standing_people(frames=60, agents=2)  # (1, 60, 2, 22, 3), a metre apart one behind the other
    >>> metric = Jitter()
    >>> metric.update(truth[None], truth)
    >>> round(metric.compute()["jitter"].item(), 3)
    0.0
    """

    columns: ClassVar[Mapping[str, Column]] = {"jitter": Column("jitter", "10 m/s³", "real", "mean third difference")}

    def measure(self, futures: Futures) -> list[tuple[Tensor, Tensor]]:
        return [clip_sums(jitter(futures.generated, self.fps), futures.spans(4))]


class Jolts(ClipMeans):
    """`jolts`: share of a person's frames in which the pelvis accelerates by over `above` m/s^2.

    Recorded dancers come to 31 at 30 frames a second, so whoever is over it has been thrown.

    >>> import torch
    >>> from magnet.testing import standing_people
    >>> truth = standing_people(frames=62, agents=2)  # (1, 62, 2, 22, 3), a metre apart one behind the other
    >>> there_and_back = torch.arange(62) % 2 * 0.02  # 2 cm to the side in every other frame
    >>> metric = Jolts()
    >>> metric.update((truth + there_and_back[:, None, None, None] * torch.tensor([1.0, 0.0, 0.0]))[None], truth)
    >>> round(metric.compute()["jolts"].item(), 3)
    1.0
    """

    higher_is_better = False
    columns: ClassVar[Mapping[str, Column]] = {
        "jolts": Column("jolts", "", "low", "share of frames with a pelvis that accelerates by over 32 m/s²"),
    }

    def __init__(self, above: float = 32.0, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.above = above

    def measure(self, futures: Futures) -> list[tuple[Tensor, Tensor]]:
        pelvis = futures.generated[..., PELVIS, :]  # (S, B, T, P, 3)
        acceleration = pelvis.diff(n=2, dim=-3).norm(dim=-1) * self.fps**2
        return [clip_sums((acceleration > self.above).double(), futures.spans(3))]
