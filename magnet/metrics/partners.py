"""Whether partners keep together: hands that meet, and how far apart people stand."""

from __future__ import annotations

import torch
from torch import Tensor

from magnet.metrics.base import ClipMeans, MotionMetric, Of, clip_sums
from magnet.metrics.futures import Futures

WRISTS = (20, 21)


def hand_distance(joints: Tensor, partner: Tensor) -> Tensor:
    """Between the nearest wrists of two people. (..., 22, 3) x 2 -> (...) metres"""
    between = joints[..., WRISTS, None, :] - partner[..., None, WRISTS, :]
    return between.norm(dim=-1).amin(dim=(-1, -2))


def partner_distance(joints: Tensor, partner: Tensor) -> Tensor:
    """Between two pelvises over the ground. (..., 22, 3) x 2 -> (...) metres"""
    return (joints - partner)[..., 0, [0, 2]].norm(dim=-1)


class HandsHeld(ClipMeans):
    """`hands_held`: share of frames in which any two people have wrists closer than `within` metres."""

    def __init__(
        self,
        within: float = 0.2,
        of: Of = "generated",
        agents: Tensor | None = None,
        confidence: float | None = None,
    ) -> None:
        super().__init__(["hands_held"], of, agents, confidence)
        self.within = within

    def measure(self, futures: Futures) -> list[tuple[Tensor, Tensor]]:
        first, second, counts = futures.pairs()
        apart = hand_distance(futures.generated[..., first, :, :], futures.generated[..., second, :, :])
        held = ((apart < self.within) & counts).any(dim=-1)  # (S, B, T)
        return [clip_sums(held.double(), counts.any(dim=-1))]


class PartnerDistance(MotionMetric):
    """`partner_distance` in metres: median over samples, frames and pairs of people, read off a histogram.

    A histogram adds up exactly over processes where a median does not; the answer is within `BIN` metres,
    and `FARTHEST` for people farther apart than that.
    """

    BIN = 0.005
    FARTHEST = 20.0

    histogram: Tensor

    def __init__(self, of: Of = "generated", agents: Tensor | None = None) -> None:
        super().__init__(of, agents)
        self.add_sum("histogram", round(self.FARTHEST / self.BIN) + 1)

    def add(self, futures: Futures) -> None:
        first, second, counts = futures.pairs()
        apart = partner_distance(futures.generated[..., first, :, :], futures.generated[..., second, :, :])
        kept = apart[counts.expand_as(apart)]
        bins = (kept / self.BIN).long().clamp(max=len(self.histogram) - 1)
        self.histogram += torch.bincount(bins, minlength=len(self.histogram))

    def compute(self) -> dict[str, Tensor]:
        upto = self.histogram.cumsum(dim=0)
        if upto[-1] == 0:
            return {}
        half = upto[-1] / 2
        bin = torch.searchsorted(upto, half)
        inside = (half - upto[bin] + self.histogram[bin]) / self.histogram[bin]
        return {"partner_distance": ((bin + inside) * self.BIN).clamp(max=self.FARTHEST)}
