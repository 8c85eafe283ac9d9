"""MI: whether agents move with each other as recorded ones do (docs/metrics.md)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from magnet.metrics.base import MotionMetric
from magnet.metrics.columns import Column
from magnet.metrics.futures import Futures, without_pelvis

STILL = 1e-5
"""A coordinate whose deviation is under this share of its root mean square is constant."""


class Correlation(NamedTuple):
    """Pearson correlation where both coordinates move, 0 elsewhere."""

    value: Tensor
    moves: Tensor  # bool


def correlation_sums(x: Tensor, y: Tensor, counts: Tensor, dim: int) -> Tensor:
    """n, x, y, xx, yy, xy summed over `dim` where it counts, which add up over batches. (...) x 3 -> (..., 6)"""
    x, y = (torch.where(counts, z, 0.0) for z in (x, y))
    n = counts.to(x).expand_as(x).sum(dim=dim)
    products = [(a * b).sum(dim=dim) for a, b in ((x, x), (y, y), (x, y))]
    return torch.stack([n, x.sum(dim=dim), y.sum(dim=dim), *products], dim=-1)


def pearson(sums: Tensor) -> Correlation:
    """Correlation from `correlation_sums`. (..., 6) -> (...)"""
    n, x, y, xx, yy, xy = sums.unbind(-1)
    n = n.clamp(min=1)
    var_x, var_y = xx / n - (x / n) ** 2, yy / n - (y / n) ** 2
    moves = (var_x > STILL**2 * xx / n) & (var_y > STILL**2 * yy / n)
    scale = torch.where(moves, var_x * var_y, 1.0).sqrt()
    value = torch.where(moves, (xy / n - x * y / n**2) / scale, 0.0)
    return Correlation(value.clamp(-1, 1), moves)


class MotionInteraction(MotionMetric):
    """`mi`: difference between the agents' correlation as generated and as recorded; 0 is best.

    For each two slots and each of 63 world coordinates the correlation of the two people, over all
    samples, frames and clips pooled; mean over coordinates, then over pairs of slots. Beside it
    `mi_generated` and `mi_truth`, and `mi_left_out`: how many coordinates were constant in either and
    left out of both. Pooled world coordinates mostly tell where people stand, and depend on the yaw of
    the world; that is the paper's measure all the same.

    Args:
        per_clip: (ours) correlation inside each sample of each clip, averaged over coordinates and clips:
            tells how people move with each other, wherever they are. Here `mi_left_out` counts the
            coordinates of every clip and sample.

    >>> import torch
    >>> from magnet.testing import standing_people
    >>> truth = standing_people(frames=60, agents=2)  # (1, 60, 2, 22, 3), a metre apart one behind the other
    >>> walking = truth + torch.linspace(0, 1, 60)[:, None, None, None] * torch.tensor([0.0, 0.0, 1.0])
    >>> metric = MotionInteraction()
    >>> metric.update(walking[None], walking)
    >>> [abs(round(metric.compute()[name].item(), 3)) for name in ("mi", "mi_truth")]
    [0.0, 1.0]
    """

    higher_is_better = False

    columns: ClassVar[Mapping[str, Column]] = {
        "mi": Column("MI", "", "low", "error of the correlation between people"),
        "mi_generated": Column("MI made", "", "real", "correlation between people"),
        "mi_truth": Column("MI real", "", "", "correlation between people in the recording"),
        "mi_left_out": Column("MI still", "", "", "how many coordinates were constant and are not in MI"),
    }

    sums: list[Tensor]  # of (Q, 2, 63, 6) by pair of slots: generated and truth
    clip_totals: list[Tensor]  # of (Q, 2, 2) by pair of slots: sum of correlations inside clips, and how many
    still: Tensor

    def __init__(self, per_clip: bool = False, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.per_clip = per_clip
        if per_clip:
            self.add_keyed("clip_totals", 2, 2)
            self.add_sum("still", 1)
        else:
            self.add_keyed("sums", 2, 63, 6)

    def add(self, futures: Futures) -> None:
        first, second, counts = futures.pairs()
        # Numbered so that two slots keep their number whatever the number of slots of a batch.
        pair = second * (second - 1) // 2 + first
        taken = futures.truth.new_zeros(len(pair), 2, *((2,) if self.per_clip else (63, 6)))
        for which, joints in [(1, futures.truth), *((0, sample) for sample in futures.generated)]:
            flat = without_pelvis(joints).flatten(-2)  # (B, T, P, 63)
            sums = correlation_sums(
                flat[..., first, :], flat[..., second, :], counts[..., None], dim=1
            )  # (B, Q, 63, 6)
            if self.per_clip:
                correlation = pearson(sums)  # (B, Q, 63)
                some = counts.any(dim=1)[:, :, None]
                moves = correlation.moves & some
                value = torch.where(moves, correlation.value, 0.0)
                totals = torch.stack([value.sum(dim=(0, 2)), moves.sum(dim=(0, 2)).double()], dim=-1)
                taken[:, which] += totals
                self.still += (~correlation.moves & some).sum()
            else:
                taken[:, which] += sums.sum(dim=0)
        self.take("clip_totals" if self.per_clip else "sums", pair, taken)

    def compute(self) -> dict[str, Tensor]:
        if self.per_clip:
            total, count = self.keyed("clip_totals")[1].unbind(-1)  # (Q, 2)
            both = (count > 0).all(dim=1)
            values = (total / count.clamp(min=1))[both]
            left_out = self.still[0].clone()
        else:
            sums = self.keyed("sums")[1]
            correlation = pearson(sums)  # (Q, 2, 63)
            seen = sums[:, 0, 0, 0] > 0
            moves = correlation.moves.all(dim=1)  # (Q, 63)
            both = moves.any(dim=-1)
            value = torch.where(moves[:, None], correlation.value, 0.0).sum(dim=-1)
            values = value[both] / moves[both].sum(dim=-1, keepdim=True)
            left_out = (~moves[seen]).sum().double()
        if not bool(both.any()):
            return {"mi_left_out": left_out}
        generated, truth = values.mean(dim=0)
        return {"mi": (truth - generated).abs(), "mi_generated": generated, "mi_truth": truth, "mi_left_out": left_out}
