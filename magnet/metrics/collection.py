"""`MotionMetrics`: metrics that give several numbers each, fed together."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torchmetrics import Metric, MetricCollection

from magnet.metrics.base import MotionMetric
from magnet.metrics.frechet import FrechetDistance
from magnet.metrics.registry import stems


class MotionMetrics(MetricCollection):
    """A torchmetrics collection that draws each metric with all its numbers, which its base looks for by the key alone.

    >>> from magnet.metrics import Jitter
    >>> from magnet.testing import standing_people
    >>> truth = standing_people(frames=60, agents=2)  # (1, 60, 2, 22, 3), a metre apart one behind the other
    >>> metrics = MotionMetrics({"jitter": Jitter()}, compute_groups=False)
    >>> metrics.update(truth[None], truth)
    >>> [abs(round(value.item(), 3)) for value in metrics.compute().values()]
    [0.0]
    """

    def plot(self, val: Any = None, ax: Any = None, together: bool = False) -> Any:
        """A figure and axis of each metric that has numbers, in order; one of all where `together`.

        Args:
            val: a result of `compute` or `forward`, or a list of them over time; None: what was measured.
            ax: axes to draw on, one for each metric; one where `together`.

        Raises:
            ValueError: there are not as many axes as metrics.
            ModuleNotFoundError: matplotlib is not installed, `pip install "magnet-motion[plot]"`.
        """
        if together:
            return super().plot(val, ax, together)
        metrics = list(self.items(keep_base=True))
        axes = [None] * len(metrics) if ax is None else list(ax)
        if len(axes) != len(metrics):
            raise ValueError(f"ax: got {len(axes)} axes, expected one for each of {len(metrics)} metrics")
        results = self.compute() if val is None else val
        drawn = []
        for (key, metric), axis in zip(metrics, axes, strict=True):
            some = [results] if isinstance(results, Mapping) else list(results)
            parts = [self._part(key, metric, each) for each in some]
            if all(parts):
                drawn.append(metric.plot(parts[0] if isinstance(results, Mapping) else parts, axis))
        return drawn

    def _part(self, key: str, metric: Metric, results: Mapping[str, Any]) -> Any:
        """What a metric gave, under its own names."""
        plain = {self._plain(name): value for name, value in results.items()}
        if not isinstance(metric, MotionMetric):
            return {key: plain[key]} if key in plain else {}
        return {name: value for name, value in plain.items() if _gives(metric, name)}

    def _plain(self, name: str) -> str:
        return name.removeprefix(self.prefix or "").removesuffix(self.postfix or "")


def _gives(metric: MotionMetric, number: str) -> bool:
    """Whether a number is one of a metric's, of which those of one class may share their columns."""
    names = {metric.name} if isinstance(metric, FrechetDistance) else set(metric.columns)
    return bool(stems(number) & names)
