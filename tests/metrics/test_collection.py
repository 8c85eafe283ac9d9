"""Metrics of several numbers are drawn from a collection as torchmetrics' own are, each with all that it gave."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
from torchmetrics import Metric

from magnet.metrics import MotionMetrics, all_metrics, ground_truth_metrics
from tests.metrics.batches import draw_batch

pyplot = pytest.importorskip("matplotlib.pyplot")


class Frames(Metric):
    """A metric of somebody else's, of one number."""

    full_state_update = False

    def __init__(self) -> None:
        super().__init__()
        self.add_state("total", torch.zeros(()), dist_reduce_fx="sum")

    def update(self, generated: torch.Tensor, *_: torch.Tensor) -> None:
        self.total = self.total + generated.shape[2]

    def compute(self) -> torch.Tensor:
        return self.total

    def plot(self, val: object = None, ax: object = None) -> object:
        return self._plot(val, ax)


@pytest.fixture(autouse=True)
def closed():
    pyplot.switch_backend("Agg")
    yield
    pyplot.close("all")


def labels(drawn: list) -> list[str]:
    return [label for _, axis in drawn for label in axis.get_legend_handles_labels()[1]]


@pytest.mark.parametrize("make", [all_metrics, ground_truth_metrics])
def test_every_number_is_drawn_once_beside_the_others_of_its_metric(make) -> None:
    metrics = make(confidence=0.95)
    metrics.update(*draw_batch(frames=40))
    found = metrics.compute()
    drawn = metrics.plot()
    assert len(drawn) == len(metrics)
    assert sorted(labels(drawn)) == sorted(found)
    assert sorted(labels(metrics.plot(found))) == sorted(found)
    metrics.reset()  # as after each epoch of a training
    assert sorted(labels(metrics.plot([found, found]))) == sorted(found)
    figure, _ = metrics.plot(found, together=True)
    assert figure is not None


def test_prefixes_own_axes_and_metrics_of_others_are_drawn() -> None:
    metrics = MotionMetrics({**all_metrics(), "frames": Frames()}, prefix="val_", postfix="_x", compute_groups=False)
    batch = draw_batch(frames=40)
    found = metrics(*batch)
    assert all(name.startswith("val_") and name.endswith("_x") for name in found)
    _, axes = pyplot.subplots(len(metrics))
    drawn = metrics.plot(found, axes)
    assert [axis for _, axis in drawn] == list(axes)
    assert sorted(labels(drawn)) == sorted(name[4:-2] for name in found)
    with pytest.raises(ValueError, match=rf"ax: got 2 axes, expected one for each of {len(metrics)} metrics"):
        metrics.plot(found, axes[:2])


def test_a_metric_without_numbers_has_no_picture() -> None:
    metrics = all_metrics()
    metrics.update(*draw_batch(people=1, frames=40))
    found = metrics.compute()
    drawn = metrics.plot()
    assert len(drawn) < len(metrics) and sorted(labels(drawn)) == sorted(found)


def test_copies_measure_on_by_themselves() -> None:
    metrics = all_metrics(confidence=0.95)
    metrics.update(*draw_batch(frames=40))
    expected = metrics.compute()
    for again in (metrics.clone(), copy.deepcopy(metrics), pickle.loads(pickle.dumps(metrics))):
        assert isinstance(again, MotionMetrics) and again.compute() == expected
        again.update(*draw_batch(frames=40, seed=1))
        assert again.compute() != expected
    assert metrics.compute() == expected
