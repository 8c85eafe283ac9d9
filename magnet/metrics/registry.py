"""Metrics of other packages, measured beside ours: found through the entry-point group `magnet.metrics`."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor
from torchmetrics import Metric

from magnet.metrics.base import ClipMeans, MotionMetric, Of
from magnet.metrics.columns import columns_of
from magnet.metrics.memorisation import NearestTraining
from magnet.plugins import Registry, attempted, told

MEMORISATION = "memorisation"
"""Name of the metric NearestTraining, which needs a training set and so is measured apart from the others."""
TAKEN: set[str] = set()
"""Names of our metrics and of their numbers."""


def _check(name: str, kind: type) -> None:
    if not (isinstance(kind, type) and issubclass(kind, MotionMetric)):
        raise TypeError(f"metric {name}: {kind!r} is no MotionMetric; see docs/metrics.md")
    if not kind.columns:
        raise TypeError(f"metric {name}: {kind.__name__} has no columns, which say how its numbers are shown")
    others = [other.kind for other in METRICS.known.values() if other.kind is not kind]
    taken = TAKEN.union(*(other.columns for other in others if issubclass(other, MotionMetric)))
    # A number has variants, such as mpjpe@2s, and bounds of its interval, such as fs_low: none of them is free.
    twice = sorted(each for each in (name, *kind.columns) if {each, *_stems(each)} & taken)
    if twice:
        raise ValueError(f"metric {name}: something called {twice[0]} is measured already")


def _stems(number: str) -> set[str]:
    """Names that a number's name may be a variant of: turn_rate of turn_rate@agent0_low."""
    bare = number.partition("@")[0]
    return {bare, bare.removesuffix("_mean"), *(bare.removesuffix(bound) for bound in ("_low", "_high"))}


METRICS = Registry("metric", "magnet.metrics", (), _check)


def other_metrics(
    ours: Callable[[], Mapping[str, Metric]], of: Of, agents: Tensor | None, fps: float, confidence: float | None
) -> dict[str, Metric]:
    """Metrics of installed packages, by name; those that fail to load or to be made are left out, with a warning.

    Args:
        ours: makes our metrics, whose names nothing else may have.
        of, agents, fps: as for MotionMetric.
        confidence: as for ClipMeans.
    """
    if not METRICS.discovered:
        known = ours()
        TAKEN.update(known, columns_of(*known.values()), [MEMORISATION], NearestTraining.columns)
        METRICS.discover()
        for name, error in METRICS.failed.items():
            _warn(name, METRICS.failed_of[name], "failed to load", error)
    made: dict[str, Metric] = {}
    for name, each in sorted(METRICS.known.items()):
        words: dict[str, Any] = {"of": of, "agents": agents, "fps": fps}
        if issubclass(each.kind, ClipMeans):
            words["confidence"] = confidence

        def make(name: str = name, kind: type = each.kind, words: dict[str, Any] = words) -> None:
            made[name] = kind(**words)

        if (failed := attempted(make)) is not None:
            METRICS.fail(name, failed, each.origin)
            del METRICS.known[name]
            _warn(name, each.origin, "cannot be made", failed)
    return made


def _warn(name: str, origin: str, what: str, error: BaseException) -> None:
    warnings.warn(f"metric {name} is left out, it {what}: {told(error)} (of {origin})", stacklevel=3)
