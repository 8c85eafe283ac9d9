"""Numbers of single scenes: the table's are their means, and methods are compared over the same scenes."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch.distributed as dist
import torch.multiprocessing as mp

from magnet.evaluation.by_scene import SceneValues, compared, of_all_processes, other_recordings
from magnet.evaluation.results import Results
from magnet.metrics import ClipMeans, all_metrics
from tests.evaluation.test_evaluator import data, run

SCENES = 40
MEANS = {name for metric in all_metrics().values() if isinstance(metric, ClipMeans) for name in metric.names}


@pytest.fixture(scope="module")
def measured() -> Results:
    return run(data()).results


def values(units: list[int] | None = None, **rows: np.ndarray) -> SceneValues:
    """Scenes with one metric, each of weight 1."""
    scenes = tuple(f"scene {n}" for n in range(len(next(iter(rows.values())))))
    stacked = {name: {"m": np.stack([row, np.ones(len(row))], axis=1)} for name, row in rows.items()}
    return SceneValues(scenes, tuple(units or range(len(scenes))), stacked)


def drawn(number: int = 0) -> np.ndarray:
    return np.random.default_rng(number).normal(size=SCENES)


def test_every_mean_of_the_table_is_that_of_its_scenes(measured: Results) -> None:
    scenes = measured.scenes
    assert len(scenes.scenes) == len(set(scenes.scenes)) == measured.meta["test scenes"]
    assert scenes.rows.keys() == measured.rows.keys()
    for method, row in measured.rows.items():
        assert {name for name in row if name in MEANS} <= scenes.rows[method].keys() <= row.keys()
        for metric in scenes.rows[method]:
            total, count = scenes.sums(method, metric, scenes.scenes).sum(axis=0)
            mean = total / count if count else 0.0  # nobody's feet slide
            assert mean == pytest.approx(row[metric], rel=1e-6, abs=1e-9), (method, metric)


def test_values_of_scenes_do_not_depend_on_the_batch() -> None:
    one, other = (run(data(batch_size=size)).results.scenes for size in (2, 9))
    assert one.scenes == other.scenes
    for metric, expected in one.rows["magnet"].items():
        np.testing.assert_allclose(other.rows["magnet"][metric], expected, rtol=1e-3, atol=1e-4, err_msg=metric)


def test_a_file_holds_seven_digits_of_all(measured: Results, tmp_path: Path) -> None:
    path = measured.scenes.save(tmp_path / "deep" / "scenes.json")
    back = SceneValues.load(path)
    assert (back.scenes, back.units, back.facts) == (measured.scenes.scenes, measured.scenes.units, {})
    for method, row in measured.scenes.rows.items():
        assert list(back.rows[method]) == list(row)
        for metric, expected in row.items():
            np.testing.assert_allclose(back.rows[method][metric], expected, rtol=1e-6)


@pytest.mark.parametrize(
    "text", ["no", "[]", "{}", '{"format": 2, "facts": {}, "scenes": [], "units": [], "rows": {}}']
)
def test_another_file_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(ValueError, match=r"magnet test and score write them|format 2, this version reads up to 1"):
        SceneValues.load(tmp_path / "a.json")


@pytest.mark.parametrize(("better", "winner"), [("low", 0), ("high", 1), ("", None)])
def test_a_difference_in_every_scene_is_sure_however_much_scenes_differ(better: str, winner: int | None) -> None:
    """Each alone has an interval of 0.6; of scenes that are not paired the difference would not be told from none."""
    both = values(a=drawn(), b=drawn() + 0.1)
    found = compared(both, both, ("a", "b"), "m", better, "truth")
    assert found.difference == pytest.approx(0.1)
    assert (found.low, found.high) == pytest.approx((0.1, 0.1))
    assert found.better == winner


def test_what_is_to_be_near_recordings_is_compared_by_its_distance_from_them() -> None:
    both = values(a=drawn() + 0.5, b=drawn() - 0.1, truth=drawn())
    found = compared(both, both, ("a", "b"), "m", "real", "truth")
    assert found.difference == pytest.approx(-0.6)
    assert found.better == 1
    assert compared(both, both, ("a", "b"), "m", "real", "none").better is None


def test_a_scene_counts_where_one_of_both_has_something_in_it() -> None:
    """Feet that slide in half of the scenes alone, twice as fast as the other's."""
    some = np.stack([np.full(SCENES, 2.0), np.arange(SCENES) % 2], axis=1)
    both = values(a=np.full(SCENES, 1.0), b=np.zeros(SCENES))
    both.rows["b"]["m"] = some
    found = compared(both, both, ("a", "b"), "m", "low", "truth")
    assert (found.first, found.second, found.low, found.high, found.better) == (1, 2, 1, 1, 0)
    some[:, 1] = 0
    found = compared(both, both, ("a", "b"), "m", "low", "truth")
    assert math.isnan(found.second) and math.isnan(found.low) and found.better is None


def test_what_one_scene_alone_has_is_not_sure() -> None:
    """Every resample with that scene in it has the same value, as if it were known exactly."""
    both = values(a=drawn(), b=drawn() + 9, truth=drawn())
    both.rows["b"]["m"][1:, 1] = 0
    both.rows["c"] = {"m": np.stack([drawn() + 9, np.arange(SCENES) < 2], axis=1)}
    alone = compared(both, both, ("a", "b"), "m", "low", "truth")
    assert alone.second == pytest.approx(drawn()[0] + 9)
    assert math.isnan(alone.low) and alone.better is None
    assert compared(both, both, ("b", "a"), "m", "low", "truth").better is None
    assert compared(both, both, ("a", "c"), "m", "real", "b").better is None
    assert compared(both, both, ("a", "c"), "m", "low", "truth").better == 0


def test_a_scene_in_which_a_metric_has_no_number_does_not_count() -> None:
    some = np.array([np.nan, 1.0, 2.0])
    scenes = values(a=some, b=some + 1)
    difference = compared(scenes, scenes, ("a", "b"), "m", "low", "truth")
    assert (difference.first, difference.second, difference.difference) == (1.5, 2.5, 1.0)
    none = values(a=np.full(3, np.nan), b=some)
    assert math.isnan(compared(none, none, ("a", "b"), "m", "low", "truth").first)


def test_noise_is_not_told_from_no_difference() -> None:
    both = values(a=drawn(1), b=drawn(2))
    found = compared(both, both, ("a", "b"), "m", "low", "truth")
    assert found.low < found.difference < found.high
    assert found.better is None
    assert compared(both, both, ("a", "a"), "m", "low", "truth")[2:6] == (0, 0, 0, None)


@pytest.mark.parametrize("units", [3, 5, 9])
def test_of_few_scenes_as_seldom_one_is_wrongly_sure_as_of_many(units: int) -> None:
    """In one of twenty; resamples alone would be sure of 30, 16 and 10 % with 3, 5 and 9 scenes."""
    draws = np.random.default_rng(0).normal(size=(200, 2, units))
    sure = 0
    for a, b in draws:
        both = values(a=a, b=b)
        sure += compared(both, both, ("a", "b"), "m", "low", "truth").better is not None
    assert sure / len(draws) < 0.075


def test_scenes_that_are_not_independent_are_drawn_together() -> None:
    ten = [n // 4 for n in range(SCENES)]
    shift = np.repeat(np.random.default_rng(0).normal(size=10), 4)
    spans = []
    for units in (None, ten):
        both = values(units, a=drawn(), b=drawn() + shift)
        found = compared(both, both, ("a", "b"), "m", "low", "truth")
        spans.append(found.high - found.low)
    assert spans[1] > 1.5 * spans[0]
    alone = values([0] * SCENES, a=drawn(), b=drawn() + 1)
    found = compared(alone, alone, ("a", "b"), "m", "low", "truth")
    assert found.difference == pytest.approx(1)
    assert math.isnan(found.low) and found.better is None


def test_scenes_are_paired_by_name_and_only_those_of_both_count() -> None:
    one, other = values(a=drawn()), values(a=drawn() + 0.1)
    turned = SceneValues(
        other.scenes[:0:-1], other.units[:0:-1], {"a": {"m": other.rows["a"]["m"][:0:-1]}}
    )  # without the first
    found = compared(one, turned, ("a", "a"), "m", "low", "truth")
    assert found.first == pytest.approx(drawn()[1:].mean())
    assert (found.low, found.high) == pytest.approx((0.1, 0.1))


def gather(rank: int, folder: str) -> None:
    dist.init_process_group("gloo", init_method=f"file://{folder}/meet", rank=rank, world_size=2)
    found = of_all_processes({number: (f"scene {number}", number, {}) for number in (rank, rank + 2)})
    dist.destroy_process_group()
    assert list(found) == [0, 1, 2, 3]


@pytest.mark.slow
def test_scenes_of_all_processes_are_put_in_order(tmp_path: Path) -> None:
    mp.spawn(gather, args=(str(tmp_path),), nprocs=2)


def test_scenes_of_one_name_with_other_recordings_are_found() -> None:
    real = values(truth=drawn(1), a=drawn())
    other = drawn(1)
    other[3:5] += 0.5
    rounded = values(truth=drawn(1) * 1.0001)
    names = real.scenes
    assert other_recordings(real, values(truth=other), "truth") == [names[3], names[4]]
    assert other_recordings(real, rounded, "truth") == []
    still = values(truth=np.where(np.arange(SCENES) < 2, np.nan, 0.0))  # nothing there that says anything
    assert other_recordings(still, still, "truth") == []
    assert other_recordings(real, values(a=drawn(2)), "truth") == [], "a table without recordings"
    turned = SceneValues(names[::-1], real.units, {"truth": {"m": values(truth=other).rows["truth"]["m"][::-1]}})
    assert other_recordings(real, turned, "truth") == [names[3], names[4]]
