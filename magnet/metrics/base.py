"""What metrics share: the update signature, and means over clips that merge exactly across processes."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from magnet.metrics.futures import Futures
from magnet.metrics.interval import bootstrap_interval

Of = Literal["generated", "truth"]


class MotionMetric(Metric):
    """Measures future joints: `update(generated, truth, present)`, `compute()` -> one number a name.

    A quantity that the data does not have (a correlation of agents in solo scenes, say) has no name in
    the result, rather than a NaN or a flattering 0.

    Args:
        of: `"truth"` measures the recording in place of the samples, under the same names: the ground
            truth's own row of a table.
        agents: (P,) or (T, P) bool, what is scored where `update` is not told: the agents, or the frames of each,
            that were generated; None: everything of everybody present.
    """

    full_state_update = False
    is_differentiable = False

    def __init__(self, of: Of = "generated", agents: Tensor | None = None) -> None:
        super().__init__()
        self.of = of
        self.agents = agents[None] if agents is not None and agents.ndim == 2 else agents

    def update(self, generated: Tensor, truth: Tensor, present: Tensor, agents: Tensor | None = None) -> None:
        """(S, B, T, P, 22, 3), (B, T, P, 22, 3), (B, P) bool, and bool: what was generated; see `Futures.of`."""
        if self.of == "truth":
            generated = truth[None]
        self.add(Futures.of(generated, truth, present, self.agents if agents is None else agents))

    @abstractmethod
    def add(self, futures: Futures) -> None:
        """Take one batch into the sums."""

    @abstractmethod
    def compute(self) -> dict[str, Tensor]:
        """What was measured, float64 scalars by name."""

    def add_sum(self, name: str, *shape: int) -> None:
        self.add_state(name, default=torch.zeros(*shape, dtype=torch.float64), dist_reduce_fx="sum")


class ClipMeans(MotionMetric):
    """Means of totals over counts, with each clip's share kept for confidence intervals.

    Args:
        names: what is measured.
        confidence: such as 0.95: adds `<name>_low` and `<name>_high`, by resampling clips.
    """

    total: Tensor  # (K,)
    count: Tensor  # (K,)
    clips: list[Tensor]  # of (B, K, 2): total and count of each clip

    def __init__(
        self,
        names: Sequence[str],
        of: Of = "generated",
        agents: Tensor | None = None,
        confidence: float | None = None,
    ) -> None:
        super().__init__(of, agents)
        self.names = tuple(names)
        self.confidence = confidence
        self.add_sum("total", len(self.names))
        self.add_sum("count", len(self.names))
        self.add_state("clips", default=[], dist_reduce_fx="cat")

    @abstractmethod
    def measure(self, futures: Futures) -> Sequence[tuple[Tensor, Tensor]]:
        """For each name, every clip's total and count. -> K x ((B,), (B,))"""

    def add(self, futures: Futures) -> None:
        shares = [torch.stack(torch.broadcast_tensors(*pair), dim=-1) for pair in self.measure(futures)]
        clips = torch.stack(shares, dim=1).double()
        self.clips.append(clips)
        self.total += clips[..., 0].sum(dim=0)
        self.count += clips[..., 1].sum(dim=0)

    def sync(self, *args: object, **kwargs: object) -> None:
        # torchmetrics would send a float32 vector for a process that saw no clip, which does not fit the others'.
        if isinstance(self.clips, list) and not self.clips:
            self.clips.append(self.total.new_zeros(0, len(self.names), 2))
        super().sync(*args, **kwargs)  # type: ignore[arg-type]

    def compute(self) -> dict[str, Tensor]:
        result = {}
        for k, name in enumerate(self.names):
            if self.count[k] == 0:
                continue
            result[name] = self.total[k] / self.count[k]
            if self.confidence is not None:
                clips = dim_zero_cat(self.clips)[:, k]
                low, high = bootstrap_interval(clips[:, 0], clips[:, 1], self.confidence)
                result |= {f"{name}_low": low, f"{name}_high": high}
        return result


def clip_sums(values: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Totals and counts a clip. values (S, B, ...), counts of the same shape or broadcast to it -> (B,), (B,)"""
    counts = counts.expand_as(values)
    kept = torch.where(counts, values, 0.0)
    return kept.transpose(0, 1).flatten(1).sum(dim=1), counts.transpose(0, 1).flatten(1).sum(dim=1)
