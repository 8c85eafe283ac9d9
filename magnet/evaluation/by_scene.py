"""`SceneValues`: each test scene's numbers, of metrics that are means over scenes; and two methods compared by them."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.distributed as dist
from numpy.typing import NDArray
from torchmetrics import MetricCollection
from torchmetrics.utilities import dim_zero_cat

from magnet.files import write_text
from magnet.metrics import Better, ClipMeans
from magnet.metrics.interval import widening

Floats = NDArray[np.float64]
Measured = dict[str, dict[str, tuple[float, float]]]
"""Of one scene, by method and metric: the sum of what was measured, and the number of what it is over."""

BY_SCENE_FORMAT = 1
DIGITS = 7
"""Significant digits that files keep."""
LEVEL, RESAMPLES = 0.95, 2000
ROUGHLY = 0.01
"""Share by which a recording's number may differ: of a frame of 150 that is over a threshold on one machine alone."""


@dataclass(frozen=True)
class SceneValues:
    """What a test run measured in each scene.

    Args:
        scenes: their names, in the order of the test set.
        units: (B,) which of them are not independent; see `independent_units`.
        rows: method -> metric -> (B, 2): the scene's mean, NaN where there is none, and how many it is over. The
            table's value is the mean over scenes with these weights.
        facts: about the run, JSON-ready, such as its task and its samples.
    """

    scenes: tuple[str, ...]
    units: tuple[int, ...]
    rows: dict[str, dict[str, Floats]]
    facts: dict[str, Any] = field(default_factory=dict)

    def save(self, path: str | Path) -> Path:
        """Write as JSON; a weight that all scenes share is written once."""
        rows = {
            method: {metric: _written(values) for metric, values in row.items()} for method, row in self.rows.items()
        }
        content = {"format": BY_SCENE_FORMAT, "facts": self.facts, "scenes": self.scenes, "units": self.units}
        text = json.dumps(content | {"rows": rows}, ensure_ascii=False, allow_nan=False, default=str)
        return write_text(path, text + "\n")

    @staticmethod
    def load(path: str | Path) -> SceneValues:
        """Read what `save` wrote.

        Raises:
            ValueError: the file holds something else, or a later format.
        """
        try:
            content = json.loads(Path(path).read_text(encoding="utf-8"))
            version, scenes, facts = content["format"], tuple(map(str, content["scenes"])), content["facts"]
            units = tuple(map(int, content["units"]))
            rows = {m: {k: _read(v, len(scenes)) for k, v in row.items()} for m, row in content["rows"].items()}
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(
                f"{path}: not the values of scenes ({error!r}); magnet test and score write them"
            ) from error
        if version > BY_SCENE_FORMAT:
            raise ValueError(f"{path}: format {version}, this version reads up to {BY_SCENE_FORMAT}")
        return SceneValues(scenes, units, rows, facts)

    def sums(self, method: str, metric: str, scenes: Iterable[str]) -> Floats:
        """Sums and counts of some scenes; 0 of those where the metric has no number. -> (B, 2)"""
        place = {name: number for number, name in enumerate(self.scenes)}
        value, weight = self.rows[method][metric][[place[name] for name in scenes]].T
        return np.stack([np.nan_to_num(value) * weight, np.where(np.isnan(value), 0.0, weight)], axis=1)


def _written(values: Floats) -> dict[str, Any]:
    value = [float(f"{v:.{DIGITS}g}") if math.isfinite(v) else None for v in values[:, 0]]
    weight = values[:, 1].tolist()
    return {"value": value, "weight": weight[0] if len(set(weight)) == 1 else weight}


def _read(written: Mapping[str, Any], scenes: int) -> Floats:
    value = np.array([math.nan if v is None else float(v) for v in written["value"]]).reshape(scenes)
    weight = np.broadcast_to(np.asarray(written["weight"], dtype=np.float64), (scenes,))
    return np.stack([value, weight], axis=1)


# -- what a run measures -------------------------------------------------------------------


def in_each_scene(metrics: Mapping[str, MetricCollection], scenes: int) -> list[Measured]:
    """What was measured in each of so many scenes of this process, by method, in the order they were measured."""
    found: list[Measured] = [{method: {} for method in metrics} for _ in range(scenes)]
    for method, collection in metrics.items():
        for metric in collection.values():
            if not isinstance(metric, ClipMeans) or not metric.clips:  # none of a stranger's that failed
                continue
            for scene, sums in zip(found, dim_zero_cat(metric.clips).tolist(), strict=True):
                scene[method] |= dict(zip(metric.names, map(tuple, sums), strict=True))
    return found


def of_all_processes(found: dict[int, tuple[str, int, Measured]]) -> dict[int, tuple[str, int, Measured]]:
    """What all processes of a run found, by the number of the scene, in order."""
    parts: list[Any] = [found]
    if dist.is_available() and dist.is_initialized():
        parts = [None] * dist.get_world_size()
        dist.all_gather_object(parts, found)
    return dict(sorted(item for part in parts for item in part.items()))


def scene_values(found: Mapping[int, tuple[str, int, Measured]], shown: Mapping[str, Iterable[str]]) -> SceneValues:
    """The values of all scenes.

    Args:
        found: name, unit and numbers of each scene.
        shown: metrics of each method that its row of the table has.
    """
    names, units, measured = zip(*found.values(), strict=True) if found else ((), (), ())
    rows: dict[str, dict[str, Floats]] = {}
    for method, metrics in shown.items():
        there = set(metrics) & {metric for scene in measured for metric in scene.get(method, {})}
        rows[method] = {}
        for metric in (each for each in metrics if each in there):
            sums = np.array([scene.get(method, {}).get(metric, (0.0, 0.0)) for scene in measured])
            rows[method][metric] = np.stack([_means(sums), sums[:, 1]], axis=1)
    return SceneValues(names, units, rows)


# -- two methods compared ------------------------------------------------------------------


class Difference(NamedTuple):
    """How two methods differ in one metric, over the scenes that both have."""

    first: float
    second: float
    difference: float
    """second - first"""
    low: float
    high: float
    """Its interval; NaN where one of both, or of recordings that decide, has numbers of fewer than two units."""
    better: int | None
    """0 or 1: the first or the second is better, in almost all resamples; None: cannot be told."""
    truth: float = math.nan
    """The recordings' value, where it decides what is better; else NaN."""


def compared(
    first: SceneValues, second: SceneValues, methods: tuple[str, str], metric: str, better: Better, truth: str
) -> Difference:
    """Two methods over the scenes that both have, which are resampled together, by the first's units.

    Args:
        first, second: may be the same.
        methods: one of each, both of which have the metric.
        metric: one of these.
        better: what is good of it; where it is to be near the recordings, the distances from these are compared.
        truth: the recordings' row, of the first.
    """
    common = [name for name in first.scenes if name in set(second.scenes)]
    parts = [first.sums(methods[0], metric, common), second.sums(methods[1], metric, common)]
    real = better == "real" and metric in first.rows.get(truth, {})
    if real:
        parts.append(first.sums(truth, metric, common))
    unit_of = dict(zip(first.scenes, first.units, strict=True))
    # A scene without a unit is one of its own.
    keys = [unit_of[name] if unit_of[name] >= 0 else -1 - number for number, name in enumerate(common)]
    units, place = np.unique(keys, return_inverse=True)
    sums = np.zeros((len(units), len(parts), 2))
    np.add.at(sums, place, np.stack(parts, axis=1))
    sums = sums[(sums[..., 1] > 0).any(axis=1)]
    means = _means(sums.sum(axis=0))
    recorded = means[2] if real else math.nan
    counted = int((sums[..., 1] > 0).sum(axis=0).min())
    if counted < 2:  # what one unit alone has is the same in every resample
        return Difference(means[0], means[1], means[1] - means[0], math.nan, math.nan, None, recorded)
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randint(len(sums), (RESAMPLES, len(sums)), generator=generator).numpy()
    times = np.stack([np.bincount(each, minlength=len(sums)) for each in drawn])  # (R, U)
    values = _means(np.tensordot(times, sums, axes=1))  # (R, methods)
    values = values[~np.isnan(values).any(axis=1)]
    values = np.concatenate([means[None], values])  # what was measured, then the resamples
    low, high = _ends(values[:, 1] - values[:, 0], counted)
    worse = {"low": values, "high": -values}.get(better)
    if real:
        worse = np.abs(values - values[:, 2:])
    sure = None
    if worse is not None:
        least, most = _ends(worse[:, 1] - worse[:, 0], counted)
        sure = 1 if most < 0 else 0 if least > 0 else None
    return Difference(means[0], means[1], means[1] - means[0], low, high, sure, recorded)


def other_recordings(first: SceneValues, second: SceneValues, truth: str) -> list[str]:
    """Scenes of one name in which recordings have other numbers in one than in the other: they are not the same motion.

    truth: the recordings' row; without it nothing is known of them.
    """
    if truth not in first.rows or truth not in second.rows:
        return []
    common = [name for name in first.scenes if name in set(second.scenes)]
    shared = [metric for metric in first.rows[truth] if metric in second.rows[truth]]
    both = [[_means(each.sums(truth, metric, common)) for metric in shared] for each in (first, second)]
    one, other = (np.array(each).reshape(len(shared), len(common)) for each in both)
    says = (np.abs(one) > 0) | (np.abs(other) > 0)  # NaN and 0, which most scenes have, say nothing
    apart = np.abs(one - other) > ROUGHLY * np.maximum(np.abs(one), np.abs(other))
    return [name for name, much, of in zip(common, (apart & says).sum(0), says.sum(0), strict=True) if 2 * much > of]


def _means(sums: Floats) -> Floats:
    """(..., 2) -> (...), NaN of nothing"""
    return np.divide(sums[..., 0], sums[..., 1], out=np.full(sums.shape[:-1], np.nan), where=sums[..., 1] > 0)


def _ends(values: Floats, units: int) -> tuple[float, float]:
    """What was measured, then resamples of so many units. -> the ends of an interval that holds with few of them too"""
    tail = 50 * (1 - LEVEL)
    low, high = values[0] + widening(units) * (np.percentile(values[1:], [tail, 100 - tail]) - values[0])
    return float(low), float(high)
