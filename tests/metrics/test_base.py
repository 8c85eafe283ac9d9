"""What must hold for every metric: who counts, how parts merge, what is refused."""

import math
from collections.abc import Callable

import pytest
import torch
from torchmetrics import Metric, MetricCollection

from magnet.metrics import (
    Futures,
    Interpenetration,
    PositionError,
    all_metrics,
    bootstrap_interval,
    ground_truth_metrics,
)

from .batches import EVERY, ONLY_SECOND, draw_batch, result


@EVERY
def test_absent_agents_make_no_difference(make: Callable[[], Metric]) -> None:
    generated, truth, present = draw_batch()
    for filler in (math.nan, 1e6):
        here = present[:, None, :, None, None]
        filled = [torch.where(here, x, filler) for x in (generated, truth)]
        assert result(make(), *filled, present) == result(make(), generated, truth, present)


@EVERY
def test_split_updates_merge_to_one_pass(make: Callable[[], Metric]) -> None:
    batches = [draw_batch(seed=seed, scenes=scenes) for seed, scenes in ((1, 3), (2, 1), (3, 4))]
    whole = make()
    generated, truth, present = zip(*batches, strict=True)
    whole.update(torch.cat(generated, dim=1), torch.cat(truth), torch.cat(present))
    total = make()
    total.update(*batches[0])
    for batch in batches[1:]:
        part = make()
        part.update(*batch)
        total.merge_state(part)
    torch.testing.assert_close(whole.compute(), total.compute(), atol=1e-10, rtol=1e-12)


@EVERY
def test_a_longer_sample_is_cut_to_the_truth_and_the_other_way_round(make: Callable[[], Metric]) -> None:
    generated, truth, present = draw_batch(frames=24)
    expected = result(make(), generated[:, :, :20], truth[:, :20], present)
    assert result(make(), generated, truth[:, :20], present) == expected
    assert result(make(), generated[:, :, :20], truth, present) == expected


@EVERY
def test_numbers_are_finite_or_absent(make: Callable[[], Metric]) -> None:
    for scenes, group, samples, frames in ((1, 1, 1, 1), (1, 1, 1, 5), (2, 2, 1, 3), (1, 3, 2, 2)):
        got = result(make(), *draw_batch(scenes, group, samples, frames))
        assert all(math.isfinite(value) for value in got.values()), got


@EVERY
def test_a_nan_joint_of_somebody_present_is_named(make: Callable[[], Metric]) -> None:
    generated, truth, present = draw_batch()
    generated[1, 1, 7, 0, 3, 2] = math.nan
    with pytest.raises(ValueError, match="generated: joint 3 of agent 0, frame 7, scene 1"):
        result(make(), generated, truth, present)


@EVERY
def test_a_metric_without_a_batch_says_nothing_but_zero_counts(make: Callable[[], Metric]) -> None:
    with pytest.warns(UserWarning, match="before the ``update``"):
        got = make().compute()
    assert all(float(value) == 0 for value in got.values())


def test_pair_metrics_of_solo_scenes_are_absent_not_flattering() -> None:
    metrics = all_metrics()
    metrics.update(*draw_batch(people=1))
    got = metrics.compute()
    assert not {"mi", "ip_ratio", "hand_contact", "facing", "depth_p99", "partner_distance", "fd_pair"} & set(got)
    assert {"fd", "div", "fs", "mpjpe", "mpjve"} <= set(got)


def test_ground_truths_row_does_not_read_what_was_generated() -> None:
    generated, truth, present = draw_batch()
    own, other = ground_truth_metrics(), ground_truth_metrics()
    own.update(generated, truth, present)
    other.update(truth[None], truth, present)
    assert own.compute() == other.compute()
    as_generated = all_metrics()
    as_generated.update(truth[None], truth, present)
    got = as_generated.compute()
    left = {name for name in got if name not in own.compute()}
    assert {name.partition("_")[0].partition("@")[0] for name in left} <= {"fd", "div", "mpjpe", "mpjve", "hand"}
    for name, value in own.compute().items():
        assert float(got[name]) == pytest.approx(float(value), abs=1e-12)


def test_all_metrics_have_names_of_their_own_and_may_score_one_agent() -> None:
    batch = draw_batch()
    collection = all_metrics(scored=ONLY_SECOND)
    assert isinstance(collection, MetricCollection)
    collection.update(*batch)
    got = collection.compute()
    assert len(got) == sum(len(metric.compute()) for metric in collection.values())
    assert float(got["mpjpe"]) == result(PositionError(), *batch, agents=ONLY_SECOND)["mpjpe"]
    assert float(got["ip_ratio"]) == result(Interpenetration(), *batch, agents=ONLY_SECOND)["ip_ratio"]


def test_a_mean_lies_inside_its_interval_and_clips_order_makes_no_difference() -> None:
    generated, truth, present = draw_batch(scenes=10)
    got = result(PositionError(confidence=0.95), generated, truth, present)
    assert got["mpjpe_low"] < got["mpjpe"] < got["mpjpe_high"]
    back = result(PositionError(confidence=0.95), generated.flip(1), truth.flip(0), present.flip(0))
    assert back == pytest.approx(got, abs=1e-12)


def test_the_interval_of_a_mean_is_as_wide_as_statistics_say() -> None:
    values = torch.randn(400, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 3 + 1
    low, high = bootstrap_interval(values)
    half = 1.96 * float(values.std()) / 20
    assert float(low) == pytest.approx(float(values.mean()) - half, abs=0.15 * half)
    assert float(high) == pytest.approx(float(values.mean()) + half, abs=0.15 * half)


def test_shapes_that_do_not_fit_are_named() -> None:
    generated, truth, present = draw_batch()
    with pytest.raises(ValueError, match=r"expected \(S, B, T, P, 22, 3\)"):
        Futures.of(generated[0], truth, present)
    with pytest.raises(ValueError, match="3 scenes of 3 agents"):
        Futures.of(generated[:, :2], truth, present)
    with pytest.raises(ValueError, match="present"):
        Futures.of(generated, truth, present.float())
    with pytest.raises(ValueError, match="agents"):
        Futures.of(generated, truth, present, torch.ones(2, dtype=torch.bool))
