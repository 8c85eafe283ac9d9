"""How far apart people stand."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from torch import Tensor

from magnet.body.joints import PELVIS
from magnet.metrics.base import MotionMetric
from magnet.metrics.columns import Column
from magnet.metrics.futures import Futures
from magnet.metrics.histogram import histogram_of, quantile


def partner_distance(joints: Tensor, partner: Tensor) -> Tensor:
    """Between two pelvises over the ground. (..., 22, 3) x 2 -> (...) metres"""
    return (joints - partner)[..., PELVIS, [0, 2]].norm(dim=-1)


class PartnerDistance(MotionMetric):
    """`partner_distance` in metres: median over samples, frames and pairs of people.

    It is read off a histogram: within `BIN` metres, and `FARTHEST` for people farther apart than that.

    >>> from magnet.testing import standing_people
    >>> truth = standing_people(frames=60, agents=2)  # (1, 60, 2, 22, 3), a metre apart one behind the other
    >>> metric = PartnerDistance()
    >>> metric.update(truth[None], truth)
    >>> round(metric.compute()["partner_distance"].item(), 3)
    0.998
    """

    columns: ClassVar[Mapping[str, Column]] = {
        "partner_distance": Column("distance", "m", "real", "median between two pelvises over the ground")
    }

    BIN = 0.005
    FARTHEST = 20.0

    histogram: Tensor

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.add_sum("histogram", round(self.FARTHEST / self.BIN) + 1)

    def add(self, futures: Futures) -> None:
        first, second, counts = futures.pairs()
        apart = partner_distance(futures.generated[..., first, :, :], futures.generated[..., second, :, :])
        self.histogram += histogram_of(apart[counts.expand_as(apart)], self.BIN, len(self.histogram))

    def compute(self) -> dict[str, Tensor]:
        if float(self.histogram.sum()) == 0:
            return {}
        return {"partner_distance": quantile(self.histogram, 0.5, self.BIN)}
