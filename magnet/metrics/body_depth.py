"""How deep bodies run into each other, contact of arm on arm told apart from the rest."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from magnet.body.contact import DEEP, TOUCH, deepest
from magnet.metrics.base import ClipMeans, clip_sums
from magnet.metrics.columns import Column
from magnet.metrics.futures import Futures
from magnet.metrics.interval import histogram_of, quantile
from magnet.metrics.penetration import CHUNK

KINDS = ("depth", "depth_body", "depth_arms")


class BodyDepth(ClipMeans):
    """`depth_p99` in metres: how deep two bodies are in each other, 99th percentile over samples, frames and pairs.

    A frame's depth is that of the two capsules that are deepest in each other. `depth_over_5cm` and `depth_over_10cm`
    are the shares of frames that are deeper; `depth_p99_in_contact` is the percentile over frames of at least 5 cm
    alone, those that IP counts. `depth_body_...` leave out arm on arm, which is contact more often than collision;
    `depth_arms_...` are of arm on arm alone: upper arms and forearms of one against those of the other, forearm on
    forearm included, which the others leave out as IP does. Two arms are never over 10 cm deep. Percentiles are read
    off a histogram and within `BIN` metres.

    >>> from magnet.testing import standing_people
    >>> truth = standing_people(frames=60, agents=2)  # (1, 60, 2, 22, 3), a metre apart one behind the other
    >>> metric = BodyDepth()
    >>> metric.update(truth[None], truth)
    >>> round(metric.compute()["depth_over_5cm"].item(), 3)
    0.0
    """

    higher_is_better = False
    columns: ClassVar[Mapping[str, Column]] = {
        "depth_p99": Column("depth 99 %", "m", "low", "99th percentile of how deep two bodies are in each other"),
        "depth_p99_in_contact": Column("depth in contact", "m", "low", "the same over frames of at least 5 cm"),
        "depth_over_5cm": Column("over 5 cm", "", "low", "share of frames with two bodies over 5 cm in each other"),
        "depth_over_10cm": Column("over 10 cm", "", "low", "share of frames with two bodies over 10 cm in each other"),
        "depth_body_p99": Column("body depth 99 %", "m", "low", "99th percentile of depth without arm on arm"),
        "depth_body_over_5cm": Column(
            "body over 5 cm", "", "low", "share of frames over 5 cm in each other, arm on arm apart", main=True
        ),
        "depth_body_over_10cm": Column("body over 10 cm", "", "low", "share of frames over 10 cm without arm on arm"),
        "depth_arms_p99": Column("arms depth 99 %", "m", "real", "99th percentile of depth of arm on arm"),
        "depth_arms_over_5cm": Column("arms over 5 cm", "", "real", "share of frames with arm on arm over 5 cm"),
    }

    BIN = 0.001
    DEEPEST = 0.25  # two lower torsos in one place are 0.24 m deep

    histogram: Tensor  # (3, bins): all, without arm on arm, arm on arm

    def __init__(self, **kwargs: Any) -> None:
        names = [f"{kind}_over_{share}cm" for kind in KINDS for share in (5, 10)]
        super().__init__(names[:-1], **kwargs)
        self.add_sum("histogram", 3, round(self.DEEPEST / self.BIN) + 1)

    def measure(self, futures: Futures) -> list[tuple[Tensor, Tensor]]:
        first, second, counts = futures.pairs()
        S, (b, t, q) = futures.samples, counts.nonzero(as_tuple=True)
        one, other = (futures.generated[:, b, t, who[q]].flatten(0, 1) for who in (first, second))
        found = [deepest(*part) for part in zip(one.split(CHUNK), other.split(CHUNK), strict=True)]
        depth = torch.cat(found).unflatten(0, (S, len(b))) if len(b) else one.new_zeros(S, 0, 3)
        for kind in range(3):
            self.histogram[kind] += histogram_of(depth[..., kind], self.BIN, self.histogram.shape[1])
        every = depth.new_zeros(S, *counts.shape, 3)
        every[:, b, t, q] = depth
        over = [(every[..., kind] > limit).double() for kind in range(3) for limit in (TOUCH, DEEP)]
        return [clip_sums(share, counts) for share in over[:-1]]

    def compute(self) -> dict[str, Tensor]:
        result = super().compute()
        if float(self.histogram.sum()) == 0:
            return result
        for kind, histogram in zip(KINDS, self.histogram, strict=True):
            result[f"{kind}_p99"] = quantile(histogram, 0.99, self.BIN)
        touching = self.histogram[0].clone()
        touching[: round(TOUCH / self.BIN) + 1] = 0.0
        if float(touching.sum()) > 0:
            result["depth_p99_in_contact"] = quantile(touching, 0.99, self.BIN)
        return result
