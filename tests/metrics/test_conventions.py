"""What users of torchmetrics expect of any metric holds for each of ours."""

from __future__ import annotations

import inspect

import pytest
import torch
from torchmetrics import Metric, MetricCollection

from magnet import metrics
from magnet.testing import standing_people

CLASSES = [
    kind
    for name in metrics.__all__
    if inspect.isclass(kind := getattr(metrics, name)) and issubclass(kind, Metric) and not inspect.isabstract(kind)
]
MADE = [kind for kind in CLASSES if kind is not metrics.NearestTraining]  # which asks for windows of the training set


@pytest.mark.parametrize("kind", CLASSES)
def test_the_class_shows_how_it_is_used(kind: type[Metric]) -> None:
    assert ">>> metric.update(" in (kind.__doc__ or "")
    assert any(p.kind is p.VAR_KEYWORD for p in inspect.signature(kind).parameters.values())


@pytest.mark.parametrize("kind", MADE)
def test_options_of_torchmetrics_are_taken_and_others_refused(kind: type[Metric]) -> None:
    assert kind(compute_on_cpu=True).compute_on_cpu
    with pytest.raises(ValueError, match="no_such_option"):
        kind(no_such_option=True)


@pytest.mark.parametrize("kind", MADE)
def test_everybody_is_present_where_nothing_is_said(kind: type[Metric]) -> None:
    truth = standing_people(40, 2) + torch.linspace(0, 1, 40).square()[:, None, None, None]
    results = []
    for present in ((), (torch.ones(1, 2, dtype=torch.bool),)):
        metric = kind()
        metric.update(truth[None] + 0.01, truth, *present)
        results.append(metric.compute())
    assert results[0].keys() == results[1].keys()
    assert all(torch.equal(value, results[1][name]) for name, value in results[0].items())


def test_a_collection_measures_what_each_metric_does_whatever_its_first_batch_was() -> None:
    """In the first batch nobody moves, and what is generated is the recording."""
    still = standing_people(40, 2)
    moving = still + torch.linspace(0, 1, 40).square()[:, None, None, None]
    batches = [(still[None], still), (moving[None] + 0.1, still - 0.1)]
    kinds = {f"{kind.__name__} of {of}": kind(of=of) for kind in MADE for of in ("generated", "truth")}
    together, expected = MetricCollection(kinds), {name: metric.clone() for name, metric in kinds.items()}
    for batch in batches:
        together.update(*batch)
        for metric in expected.values():
            metric.update(*batch)
    for name, metric in expected.items():
        torch.testing.assert_close(together[name].compute(), metric.compute(), msg=name)


@pytest.mark.parametrize("kind", MADE)
def test_a_batch_may_be_measured_in_inference_mode_and_the_next_outside(kind: type[Metric]) -> None:
    truth = standing_people(40, 2) + torch.linspace(0, 1, 40).square()[:, None, None, None]
    metric, expected = kind(), kind()
    with torch.inference_mode():
        metric.update(truth[None], truth)
        metric.reset()
        metric.update(truth[None] + 0.1, truth)
    metric.update(truth[None] - 0.1, truth)
    for by in (0.1, -0.1):
        expected.update(truth[None] + by, truth)
    torch.testing.assert_close(metric.compute(), expected.compute())


@pytest.mark.parametrize("kind", MADE)
def test_sums_have_the_same_digits_whatever_precision_a_program_asks_for(kind: type[Metric]) -> None:
    truth = standing_people(40, 2) + torch.linspace(0, 1, 40).square()[:, None, None, None] + 30
    expected, metric = kind(), kind().half().set_dtype(torch.float16)
    for each in (expected, metric):
        each.update(truth[None] + 0.1, truth)
    found = metric.compute()
    assert all(value.dtype == torch.float64 for value in found.values())
    torch.testing.assert_close(found, expected.compute(), rtol=0, atol=0)


@pytest.mark.parametrize("kind", MADE)
def test_sums_are_not_written_into_memory_that_processes_share(kind: type[Metric]) -> None:
    """What is sent to a spawned process lies in such memory, the same for all of them."""
    truth = standing_people(40, 2) + torch.linspace(0, 1, 40).square()[:, None, None, None]
    metric = kind()
    sent = {name: state for name, state in metric.metric_state.items() if isinstance(state, torch.Tensor)}
    before = {name: state.clone() for name, state in sent.items()}
    metric.update(truth[None] + 0.1, truth)
    assert all(torch.equal(state, before[name]) for name, state in sent.items())


@pytest.mark.parametrize("kind", MADE)
def test_what_was_measured_can_be_plotted(kind: type[Metric]) -> None:
    pytest.importorskip("matplotlib").use("Agg")
    from matplotlib import pyplot

    truth = standing_people(40, 2) + torch.linspace(0, 1, 40).square()[:, None, None, None]
    metric = kind()
    metric.update(truth[None] + 0.1, truth)
    found = metric.compute()
    figure, axis = metric.plot()
    assert figure is not None and set(found) <= set(axis.get_legend_handles_labels()[1])
    later = {name: value / 2 for name, value in found.items()}
    assert metric.plot([found, later])[0] is not None
    pyplot.close("all")
