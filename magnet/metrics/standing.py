"""How still toes stand."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from torch import Tensor

from magnet.metrics.base import ClipMeans, clip_sums
from magnet.metrics.columns import Column
from magnet.metrics.futures import Futures
from magnet.metrics.histogram import histogram_of, quantile
from magnet.metrics.skating import toe_steps


class StandingToes(ClipMeans):
    """`toe_still`: share of standing toe frames slower than `still` m/s; `toe_speed`: median speed of all, m/s.

    A toe stands in a frame where it is under `height` metres in both frames, as for FS, which measures the speed of
    the others. The median is read off a histogram and within `BIN` m/s.

    >>> from magnet.testing import standing_people
    >>> truth = standing_people(frames=60, agents=2)  # (1, 60, 2, 22, 3), a metre apart one behind the other
    >>> metric = StandingToes()
    >>> metric.update(truth[None], truth)
    >>> round(metric.compute()["toe_still"].item(), 3)
    1.0
    """

    columns: ClassVar[Mapping[str, Column]] = {
        "toe_still": Column("toes still", "", "real", "share of standing toe frames under 5 cm/s"),
        "toe_speed": Column("toe speed", "m/s", "real", "median speed of standing toes"),
    }

    BIN = 0.002
    FASTEST = 10.0

    histogram: Tensor

    def __init__(self, height: float = 0.05, still: float = 0.05, **kwargs: Any) -> None:
        super().__init__(["toe_still"], **kwargs)
        self.height = height
        self.still = still
        self.add_sum("histogram", round(self.FASTEST / self.BIN) + 1)

    def measure(self, futures: Futures) -> list[tuple[Tensor, Tensor]]:
        speed, stands = toe_steps(futures.generated, self.fps, self.height)
        counts = stands & futures.spans(2)[..., None]
        self.histogram += histogram_of(speed[counts], self.BIN, len(self.histogram))
        return [clip_sums((speed < self.still).double(), counts)]

    def compute(self) -> dict[str, Tensor]:
        result = super().compute()
        if float(self.histogram.sum()) > 0:
            result["toe_speed"] = quantile(self.histogram, 0.5, self.BIN)
        return result
