"""Metrics of other packages are measured beside ours, and a broken one is in nobody's way."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from typing import ClassVar

import pytest
import torch

from magnet import plugins
from magnet.evaluation.results import Results, own_columns
from magnet.metrics import ClipMeans, Column, MotionMetric, all_metrics, columns_of, ground_truth_metrics
from magnet.metrics.base import clip_sums
from magnet.metrics.registry import METRICS
from tests.metrics.batches import draw_batch


class Heads(ClipMeans):
    columns: ClassVar = {"head_height": Column("head", "m", "real", "how high heads are", main=True)}

    def measure(self, futures):
        return [clip_sums(futures.generated[..., 15, 1], futures.scored)]


class Calls(MotionMetric):
    columns: ClassVar = {"calls": Column("calls", "", "", "how often it was fed")}

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.add_sum("calls")

    def add(self, futures):
        self.calls += 1

    def compute(self):
        return {"calls": self.calls}


class Nameless(ClipMeans):
    pass


class Taken(Heads):
    columns: ClassVar = {"mpjpe": Column("mine", "m", "low", "another one")}


class Variant(Heads):
    columns: ClassVar = {"mpjpe_mean@0.5s": Column("mine", "m", "low", "a variant of ours")}


class Bound(Heads):
    columns: ClassVar = {"fs_low": Column("mine", "m", "low", "a bound of ours")}


class Nearest(Heads):
    columns: ClassVar = {"nearest_training": Column("mine", "m", "low", "a number that only a training set gives")}


class Unmade(Heads):
    columns: ClassVar = {"unmade": Column("unmade", "m", "low", "of a class that asks for more")}

    def __init__(self, needed, **kwargs):
        super().__init__(**kwargs)


class Higher(Heads):
    columns: ClassVar = {"higher": Column("higher", "m", "higher", "there is no such direction")}


class Strange(Heads):
    columns: ClassVar = {"strange": Column("strange", "m", "low", "beside what there is not", beside="truth")}


class Plain(Heads):
    columns: ClassVar = {"plain": "no Column"}


class Untitled(Heads):
    columns: ClassVar = {"untitled": Column(None, "m", "low", "without a title")}


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    points = {
        "heads": "Heads",
        "calls": "Calls",
        "nameless": "Nameless",
        "mine": "Taken",
        "variant": "Variant",
        "bound": "Bound",
        "gone": "Gone",
        "FS": "Heads",
        "nearest": "Nearest",
        "memorisation": "Heads",
        "unmade": "Unmade",
        "higher": "Higher",
        "strange": "Strange",
        "plain": "Plain",
        "untitled": "Untitled",
    }
    found = [EntryPoint(name, f"{__name__}:{kind}", "magnet.metrics") for name, kind in points.items()]
    monkeypatch.setattr(plugins, "entry_points", lambda group: found if group == "magnet.metrics" else [])
    for field, fresh in (("known", {}), ("failed", []), ("discovered", False)):
        monkeypatch.setattr(METRICS, field, fresh)
    yield
    own_columns.cache_clear()


def why_not() -> dict[str, str]:
    """What is said of each that is left out."""
    return {each.name: str(each.error) for each in METRICS.failed}


def test_they_are_measured_of_samples_and_of_recordings(installed: None) -> None:
    generated, truth, present = draw_batch()
    with pytest.warns(UserWarning, match="metric .* is left out, it failed to load") as warned:
        made = all_metrics(confidence=0.95)
    left_out = {"nameless", "mine", "variant", "bound", "gone", "FS", "nearest", "memorisation", "unmade"}
    left_out |= {"higher", "strange", "plain", "untitled"}
    assert {str(each.message).split()[1] for each in warned} == left_out == why_not().keys()
    recorded = ground_truth_metrics()
    for metrics in (made, recorded):
        metrics.update(generated, truth, present)
    everybody = present[None, :, None].expand(generated.shape[:4])
    assert torch.isclose(made.compute()["head_height"].float(), generated[..., 15, 1][everybody].mean(), atol=1e-5)
    assert torch.isclose(recorded.compute()["head_height"].float(), truth[..., 15, 1][everybody[0]].mean(), atol=1e-5)
    assert made.compute()["calls"] == 1
    assert columns_of(made)["head_height"].main
    assert "mine" not in made and "fs" in made.compute()


@pytest.mark.filterwarnings("ignore:metric .* is left out, it failed")
def test_one_that_cannot_be_made_is_named_once_and_in_nobodys_way(installed: None) -> None:
    own_columns.cache_clear()
    with pytest.warns(UserWarning, match="metric unmade is left out, it cannot be made: .*needed"):
        assert "| FD ↓ |" in Results({"a": {"fd": 1.0}, "b": {"fd": 2.0}}).to_markdown()
    own_columns.cache_clear()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert "heads" in all_metrics() and "unmade" not in ground_truth_metrics()


@pytest.mark.filterwarnings("ignore:metric .* is left out")
def test_what_no_metric_takes_is_not_blamed_on_a_plug_in(installed: None) -> None:
    all_metrics()
    for make in (all_metrics, ground_truth_metrics):
        with pytest.raises(ValueError, match="fps"):
            make(fps=0)
    assert "heads" in all_metrics()


@pytest.mark.filterwarnings("ignore:metric .* is left out")
def test_names_of_what_a_training_set_gives_are_taken(installed: None) -> None:
    all_metrics()
    assert "something called nearest_training is measured already" in why_not()["nearest"]
    assert "something called memorisation is measured already" in why_not()["memorisation"]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("higher", "better of column higher: got 'higher', expected low or high or real or \"\""),
        ("strange", "beside of column strange: got 'truth', expected recording or samples or \"\""),
        ("plain", "columns has 'plain': 'no Column', expected a Column by a name"),
        ("untitled", "title of column untitled is None, expected text"),
    ],
)
@pytest.mark.filterwarnings("ignore:metric .* is left out")
def test_what_tables_read_is_checked_before_anything_is_measured(installed: None, name: str, said: str) -> None:
    all_metrics()
    assert said in why_not()[name]


def test_nothing_is_added_where_nothing_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plugins, "entry_points", lambda group: [])
    for field, fresh in (("known", {}), ("failed", []), ("discovered", False)):
        monkeypatch.setattr(METRICS, field, fresh)
    assert "head_height" not in columns_of(all_metrics()) and METRICS.discovered
