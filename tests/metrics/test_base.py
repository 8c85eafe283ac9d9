"""What must hold for every metric: who counts, how parts merge, what is refused."""

import math
from collections.abc import Callable

import pytest
import torch
from torchmetrics import Metric, MetricCollection

from magnet.metrics import (
    FootSkating,
    FrechetDistance,
    Futures,
    Interpenetration,
    MotionInteraction,
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


def test_everybody_is_present_where_nothing_is_said() -> None:
    generated, truth, present = draw_batch(people=2)
    assert result(PositionError(), generated, truth) == result(PositionError(), generated, truth, present)


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


def test_ground_truths_row_is_over_the_frames_that_were_sampled() -> None:
    generated, truth, present = draw_batch()
    short, cut = ground_truth_metrics(), ground_truth_metrics()
    agents = torch.ones(16, 3, dtype=torch.bool)
    short.update(generated[:, :, :16], truth, present, agents=agents)
    cut.update(truth[None, :, :16], truth[:, :16], present, agents=agents)
    assert short.compute() == cut.compute()


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


@pytest.mark.parametrize(
    ("message", "make"),
    [
        ("of: got 'recorded', expected generated or truth", lambda: PositionError(of="recorded")),
        ("of: got 'recorded'", lambda: MotionInteraction(of="recorded")),
        ("fps: got 0, expected over 0", lambda: all_metrics(fps=0)),
        ("fps: got -30", lambda: ground_truth_metrics(fps=-30)),
        ("confidence: got 95, expected a share under 1", lambda: all_metrics(confidence=95)),
        ("features: got 'joints', expected world_joints or", lambda: FrechetDistance("joints")),
        ("preset: got 'paper', expected default or reference", lambda: FootSkating("paper")),
        ("seconds: got 0, expected over 0", lambda: PositionError(seconds=(1.0, 0))),
    ],
)
def test_an_option_that_means_nothing_is_refused_at_once(message: str, make: Callable[[], object]) -> None:
    """`of="recorded"` measured what was generated, and 95 was found out when all was measured."""
    with pytest.raises(ValueError, match=message):
        make()


def test_arrays_and_no_samples_are_refused_by_name() -> None:
    generated, truth, present = draw_batch()
    with pytest.raises(ValueError, match=r"generated: got ndarray, expected a tensor; torch.as_tensor makes one"):
        PositionError().update(generated.numpy(), truth.numpy(), present)
    with pytest.raises(ValueError, match="present: got ndarray"):
        PositionError().update(generated, truth, present.numpy())
    with pytest.raises(ValueError, match="agents: got list"):
        PositionError().update(generated, truth, present, agents=[True, False])
    with pytest.raises(ValueError, match="got 0 samples, expected at least one"):
        PositionError().update(generated[:0], truth, present)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_joint_that_is_not_finite_is_refused_by_its_place(value: float) -> None:
    batch = draw_batch()
    for which, name in ((0, "generated"), (1, "truth")):
        spoilt = [each.clone() for each in batch]
        spoilt[which][..., 1, 7, 1, 4, 2] = value
        with pytest.raises(ValueError, match=rf"^{name}: joint 4 of agent 1, frame 7, scene 1 of the batch"):
            PositionError().update(*spoilt)
    batch[0][2, 1, 7, 1, 4, 2] = value  # one of the samples is enough
    with pytest.raises(ValueError, match=r"^generated: joint 4 of agent 1, frame 7, scene 1 of the batch"):
        PositionError().update(*batch)
