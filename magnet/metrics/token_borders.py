"""Whether the joints between tokens show: motion made in tokens must not jerk where one ends."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from magnet.metrics.base import MotionMetric
from magnet.metrics.columns import Column
from magnet.metrics.futures import Futures
from magnet.motion.tokens import TOKEN_FRAMES

ORDERS = {"border_acceleration": 2, "border_jerk": 3}


class TokenBorders(MotionMetric):
    """`border_acceleration` and `border_jerk`: those of the pelvis at token borders, divided by those inside tokens.

    The mean length of second (third) differences that span two tokens, over the mean of those within one token. The
    future begins with a token. Recorded motion, which has no tokens, is at about 1.

    Args:
        stride: frames in a token.

    >>> import torch
    >>> from magnet.testing import standing_people
    >>> truth = standing_people(frames=60, agents=2)
    >>> ahead = torch.linspace(0, 1, 60).square()[:, None, None, None] * torch.tensor([0.0, 0.0, 1.0])
    >>> metric = TokenBorders()
    >>> metric.update((truth + ahead)[None], truth)  # the same acceleration throughout
    >>> round(metric.compute()["border_acceleration"].item(), 2)
    1.0
    """

    columns: ClassVar[Mapping[str, Column]] = {
        "border_acceleration": Column(
            "border acc.", "", "real", "pelvis's acceleration at token borders against inside"
        ),
        "border_jerk": Column("border jerk", "", "real", "pelvis's jerk at token borders against inside"),
    }

    sums: Tensor  # (2, 2, 2) acceleration and jerk, inside and at borders, total and count

    def __init__(self, stride: int = TOKEN_FRAMES, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        if stride < 4:
            raise ValueError(
                f"stride: got {stride}, expected at least 4: a jerk spans 4 frames, so shorter tokens have none inside"
            )
        self.stride = stride
        self.add_sum("sums", 2, 2, 2)

    def add(self, futures: Futures) -> None:
        for n, order in enumerate(ORDERS.values()):
            if futures.frames <= order:
                continue
            length = futures.generated[..., 0, :].diff(n=order, dim=-3).norm(dim=-1)  # (S, B, T - order, P)
            counts = futures.spans(order + 1)
            first = torch.arange(futures.frames - order, device=counts.device)
            border = (first // self.stride != (first + order) // self.stride)[:, None]  # spans frames of two tokens
            for where, there in enumerate((counts & ~border, counts & border)):
                self.sums[n, where, 0] += torch.where(there, length, 0.0).sum()
                self.sums[n, where, 1] += there.sum() * futures.samples

    def compute(self) -> dict[str, Tensor]:
        result = {}
        for name, (inside, border) in zip(ORDERS, self.sums, strict=True):
            if bool((self.sums[..., 1] > 0).all()) and inside[0] > 0:
                result[name] = (border[0] / border[1]) / (inside[0] / inside[1])
        return result
