"""Metrics of other packages, measured beside ours: found through the entry-point group `magnet.metrics`."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor
from torchmetrics import Metric

from magnet.checks import require_choice
from magnet.metrics.base import ClipMeans, MotionMetric, Of
from magnet.metrics.columns import Beside, Better, Column, columns_of
from magnet.metrics.guarded import guarded
from magnet.metrics.memorisation import NearestTraining
from magnet.plugins import Registered, Registry, attempted, told

MEMORISATION = "memorisation"
"""Name of the metric NearestTraining, which needs a training set and so is measured apart from the others."""
TAKEN: set[str] = set()
"""Names of our metrics and of their numbers."""


def _check(name: str, kind: type) -> None:
    if not (isinstance(kind, type) and issubclass(kind, MotionMetric)):
        raise TypeError(f"metric {name}: {kind!r} is no MotionMetric; see docs/metrics.md")
    if not kind.columns:
        raise TypeError(f"metric {name}: {kind.__name__} has no columns, which say how its numbers are shown")
    _check_columns(name, kind.columns)
    others = [other.kind for other in METRICS.known.values() if other.kind is not kind]
    taken = TAKEN.union(*(other.columns for other in others if issubclass(other, MotionMetric)))
    # A number has variants, such as mpjpe@2s, and bounds of its interval, such as fs_low: none of them is free.
    twice = sorted(each for each in (name, *kind.columns) if {each, *stems(each)} & taken)
    if twice:
        raise ValueError(f"metric {name}: something called {twice[0]} is measured already")


def _check_columns(name: str, columns: Any) -> None:
    """Tables, footnotes and results files read them, when all has been measured."""
    if not isinstance(columns, Mapping):
        raise TypeError(f"metric {name}: columns is {type(columns).__name__}, expected a dict of a Column by name")
    for number, shown in columns.items():
        if not (isinstance(number, str) and isinstance(shown, Column)):
            raise TypeError(f"metric {name}: columns has {number!r}: {shown!r}, expected a Column by a name")
        for part in ("title", "unit", "meaning"):
            if not isinstance(text := getattr(shown, part), str):
                raise TypeError(f"metric {name}: {part} of column {number} is {text!r}, expected text")
        require_choice(f"metric {name}: better of column {number}", shown.better, Better)
        require_choice(f"metric {name}: beside of column {number}", shown.beside, Beside)


def stems(number: str) -> set[str]:
    """Names that a number's name may be a variant of: turn_rate of turn_rate@agent0_low."""
    bare = number.partition("@")[0]
    return {bare, bare.removesuffix("_mean"), *(bare.removesuffix(bound) for bound in ("_low", "_high"))}


METRICS = Registry("metric", "magnet.metrics", (), _check)


def other_metrics(
    ours: Callable[[], Mapping[str, Metric]], of: Of, agents: Tensor | None, fps: float, confidence: float | None
) -> dict[str, Metric]:
    """Metrics of installed packages, by name; those that fail to load or to be made are left out, with a warning.

    So is one that fails while it measures: it has no numbers then, see `lost_numbers`.

    Args:
        ours: makes our metrics, whose names nothing else may have.
        of, agents, fps: as for MotionMetric.
        confidence: as for ClipMeans.
    """
    if not METRICS.discovered:
        known = ours()
        TAKEN.update(known, columns_of(*known.values()), [MEMORISATION], NearestTraining.columns)
        METRICS.discover()
        for lost in METRICS.failed:
            if lost.name not in METRICS.known:  # else the registry has warned
                _warn(lost.name, lost.origin, "failed to load", lost.error)
    made: dict[str, Metric] = {}
    for name, each in sorted(METRICS.known.items()):
        words: dict[str, Any] = {"of": of, "agents": agents, "fps": fps}
        if issubclass(each.kind, ClipMeans):
            words["confidence"] = confidence

        def make(name: str = name, each: Registered = each, words: dict[str, Any] = words) -> None:
            metric = guarded(each.kind)(**words)
            metric.start_guard(name, each.origin, TAKEN)
            made[name] = metric

        if (failed := attempted(make)) is not None:
            METRICS.fail(name, failed, each.origin)
            del METRICS.known[name]
            _warn(name, each.origin, "cannot be made", failed)
    return made


def _warn(name: str, origin: str, what: str, error: BaseException) -> None:
    warnings.warn(f"metric {name} is left out, it {what}: {told(error)} (of {origin})", stacklevel=3)
