"""DIV: how far samples of one scene lie apart (docs/metrics.md)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from magnet.metrics.base import ClipMeans
from magnet.metrics.columns import Column
from magnet.metrics.futures import Futures, without_pelvis


def diversity(generated: Tensor) -> Tensor:
    """Unbiased variance over samples, summed over the 63 coordinates. (S, ..., 22, 3) -> (...) m^2, S at least 2

    >>> samples = torch.zeros(2, 22, 3)  # two samples of one pose
    >>> samples[1, 5, 0] = 0.2  # that differ by 20 cm in one coordinate
    >>> diversity(samples)
    tensor(0.0200)
    """
    return without_pelvis(generated).var(dim=0).sum(dim=(-1, -2))


class Diversity(ClipMeans):
    """`div` in m^2: mean over frames and agents of a clip, then over clips.

    One sample has no variance: such clips are left out. Equal samples (a deterministic method) have 0.

    >>> import torch
    >>> from magnet.testing import standing_people
    >>> truth = standing_people(frames=60, agents=2)  # (1, 60, 2, 22, 3), a metre apart one behind the other
    >>> metric = Diversity()
    >>> metric.update(torch.stack([truth, truth + 0.2]), truth)
    >>> round(metric.compute()["div"].item(), 3)
    1.26
    """

    higher_is_better = True
    columns: ClassVar[Mapping[str, Column]] = {
        "div": Column("DIV", "m²", "high", "variance over the samples of a scene", main=True, beside="samples")
    }

    def measure(self, futures: Futures) -> list[tuple[Tensor, Tensor]]:
        places = futures.scored.sum(dim=(1, 2))
        if futures.samples < 2:
            return [(torch.zeros_like(places), torch.zeros_like(places))]
        variance = diversity(futures.generated)  # (B, T, P)
        total = torch.where(futures.scored, variance, 0.0).sum(dim=(1, 2))
        return [(total / places.clamp(min=1), places > 0)]
