"""Metrics of other packages that fail while they measure: left out with a warning, and nothing else is lost."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Container, Iterable, Mapping
from functools import cache
from types import new_class
from typing import Any

import torch
from torch import Tensor
from torchmetrics import MetricCollection
from torchmetrics.utilities import rank_zero_warn

from magnet.metrics.base import MotionMetric
from magnet.plugins import attempted, told

_warned: set[tuple[str, str]] = set()  # metrics and their packages; a test run makes each metric once for every row


class Guarded(MotionMetric):
    """Put before a stranger's class by `guarded`: what that raises ends its own numbers alone.

    Attributes:
        name, origin: of the metric and its package, for the warning.
        taken: names that no number of it may have.
        lost: after `compute`, whether it failed in this or another process.
        unreal: after `compute`, those of its numbers that are NaN or infinite.
    """

    failures: Tensor  # summed over processes, so that all of them leave out the same
    name = origin = ""
    taken: frozenset[str] = frozenset()
    lost = False
    unreal: Mapping[str, float] = {}

    def start_guard(self, name: str, origin: str, taken: Iterable[str]) -> None:
        """Count failures from now on, once the metric has been made."""
        self.name, self.origin, self.taken = name, origin, frozenset(taken)
        self.add_sum("failures")

    def update(self, *args: Any, **kwargs: Any) -> None:
        if self.failures or self._well(lambda: super(Guarded, self).update(*args, **kwargs)):
            return
        count = self._update_count  # which `reset` forgets, and then `compute` would warn that it comes too early
        attempted(self.reset)  # what a half-done update left may not add up with other processes' sums
        self._update_count = count
        self.failures = self.failures + 1

    def compute(self) -> dict[str, Tensor]:
        compute: Callable[[], Any] = super().compute  # type: ignore[safe-super]  # the stranger's
        numbers: dict[str, Tensor] = {}
        self.lost = bool(self.failures) or not self._well(lambda: numbers.update(_scalars(compute(), self.taken)))
        self.unreal = {name: float(value) for name, value in numbers.items() if not bool(value.isfinite())}
        return {} if self.lost else numbers

    def _well(self, call: Callable[[], object]) -> bool:
        """Whether a call went well; warns of the first that did not."""
        error = attempted(call)
        if error is not None and (self.name, self.origin) not in _warned:
            _warned.add((self.name, self.origin))
            warnings.warn(f"metric {self.name} is left out, it fails: {told(error)} (of {self.origin})", stacklevel=2)
        return error is None

    def __reduce__(self) -> tuple[Any, ...]:
        return _blank, (type(self).__bases__[1],), self.__getstate__()


@cache
def guarded(kind: type[MotionMetric]) -> type[Guarded]:
    """The class with a guard before it, under its own name."""
    return new_class(kind.__name__, (Guarded, kind), {}, lambda names: names.update(__module__=kind.__module__))


def _blank(kind: type[MotionMetric]) -> Guarded:
    made = guarded(kind)
    return made.__new__(made)


def _scalars(result: Any, taken: frozenset[str]) -> dict[str, Tensor]:
    """What was computed, as float64 scalars by name.

    Raises:
        TypeError: it is no dict.
        ValueError: a name is taken.
        RuntimeError: a value is not one number.
    """
    if not isinstance(result, dict):
        raise TypeError(f"compute() gave {type(result).__name__}, expected a dict of one number a name")
    if twice := sorted(taken & result.keys()):
        raise ValueError(f"compute() gave {twice[0]}, which is measured already")
    return {name: torch.as_tensor(value).double().reshape(()) for name, value in result.items()}


def lost_numbers(collections: Iterable[MetricCollection]) -> set[str]:
    """Columns whose metric failed in one of the collections, after `compute` of all; no row is to show them."""
    every = [metric for each in collections for metric in each.values()]
    return {name for metric in every if isinstance(metric, Guarded) and metric.lost for name in metric.columns}


def warn_of_unreal(metrics: Mapping[str, MetricCollection], rows: Mapping[str, Container[str]]) -> None:
    """Warn of each metric that gave NaN or an infinity over all scenes, after `compute` of all.

    Args:
        metrics: by the name of their row.
        rows: the numbers that each row shows.
    """
    found: dict[tuple[str, str], list[tuple[str, str, str]]] = {}
    for row, collection in metrics.items():
        for metric in collection.values():
            if isinstance(metric, Guarded):
                shown = {name: value for name, value in metric.unreal.items() if name in rows.get(row, ())}
                ends = {name + end for name in shown for end in ("_low", "_high")}  # of its interval
                numbers = [(str(value), name, row) for name, value in shown.items() if name not in ends]
                found.setdefault((metric.name, metric.origin), []).extend(numbers)
    for (name, origin), numbers in found.items():
        if numbers:
            gave, of, where = (", ".join(dict.fromkeys(part)) for part in zip(*numbers, strict=True))
            rank_zero_warn(
                f"metric {name} gave {gave} over all scenes: {of} in {where}; results.json holds null there "
                f"(of {origin})"
            )
