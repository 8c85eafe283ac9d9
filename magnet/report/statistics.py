"""Estimates over seeds and scenes, and whether an ordering holds by them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from magnet.metrics.interval import student

Verdict = Literal["holds", "does not hold", "cannot be told"]


@dataclass(frozen=True)
class Estimate:
    """A number with its 95 % interval.

    Args:
        value: mean over seeds.
        error: standard error: scenes by the jackknife, seeds by their spread.
        free: degrees of freedom.
    """

    value: float
    error: float
    free: int

    @property
    def interval(self) -> tuple[float, float] | None:
        """None where nothing is known of how sure it is."""
        if self.free < 1 or not math.isfinite(self.error):
            return None
        reach = self.error * student(self.free)
        return self.value - reach, self.value + reach


def estimate(runs: Sequence[Mapping[str, Any]], metric: str) -> Estimate | None:
    """Of one row's runs, one a seed, each `value` and `without` each unit; None where it was not measured."""
    runs = [run for run in runs if metric in run["value"]]
    return _combined([run["value"][metric] for run in runs], _folds(runs, metric)) if runs else None


def difference(a: Sequence[Mapping[str, Any]], b: Sequence[Mapping[str, Any]], metric: str) -> Estimate | None:
    """Of two rows on the same scenes, a - b: paired by unit, and by seed where both have as many."""
    a, b = ([run for run in runs if metric in run["value"]] for runs in (a, b))
    if not a or not b:
        return None
    left, right = _folds(a, metric), _folds(b, metric)
    folds = {unit: left[unit] - right[unit] for unit in sorted(left.keys() & right.keys())}
    ones, others = [run["value"][metric] for run in a], [run["value"][metric] for run in b]
    if len(ones) == len(others):
        return _combined([x - y for x, y in zip(ones, others, strict=True)], folds)
    mean = sum(others) / len(others)
    return _combined([x - mean for x in ones], folds)


def verdict(difference: Estimate | None, claimed_lower: bool) -> Verdict:
    """Whether a - b is on the side that is claimed, by the interval."""
    if difference is None or difference.interval is None:
        return "cannot be told"
    low, high = difference.interval
    if low <= 0 <= high:
        return "cannot be told"
    return "holds" if (high < 0) == claimed_lower else "does not hold"


def _folds(runs: Sequence[Mapping[str, Any]], metric: str) -> dict[str, float]:
    """Without each unit, the mean over seeds."""
    shared = set.intersection(*({unit for unit, row in run["without"].items() if metric in row} for run in runs))
    return {unit: sum(run["without"][unit][metric] for run in runs) / len(runs) for unit in sorted(shared)}


def _combined(values: Sequence[float], folds: Mapping[str, float]) -> Estimate:
    """Mean over seeds, with the jackknife's variance over units and that of the mean over seeds."""
    mean, units = sum(values) / len(values), len(folds)
    if units < 2:
        return Estimate(mean, math.nan, 0)
    middle = sum(folds.values()) / units
    variance = (units - 1) / units * sum((each - middle) ** 2 for each in folds.values())
    if len(values) > 1:
        variance += sum((value - mean) ** 2 for value in values) / (len(values) - 1) / len(values)
    return Estimate(mean, math.sqrt(variance), units - 1)
