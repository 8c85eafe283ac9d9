"""What numbers say of themselves: which of them compare a sample with something of its own scene."""

from __future__ import annotations

from magnet.metrics import Column, all_metrics, beside, columns_of, ground_truth_metrics

from .batches import draw_batch


def test_a_recording_has_no_number_that_compares_a_sample_with_something_of_its_scene() -> None:
    metrics, recorded = all_metrics(confidence=0.95), ground_truth_metrics(confidence=0.95)
    batch = draw_batch(frames=64, people=2)
    for each in (metrics, recorded):
        each.update(*batch)
    known, measured = columns_of(metrics), metrics.compute()
    assert not {name for name in recorded.compute() if beside(name, known)}
    compared = {name for name in measured if beside(name, known) == "recording"}
    whole = {"mpjpe", "mpjpe_best", "mpjpe_mean", "mpjve", "hand_contact_precision", "hand_contact_recall"}
    ends = {f"{name}{end}" for name in ("mpjpe", "mpjpe@1s", "mpjpe_best@0.5s") for end in ("_low", "_high")}
    assert whole | ends | {"mpjpe@1s", "mpjpe_mean@2s"} <= compared
    assert {name.partition("@")[0].removesuffix("_low").removesuffix("_high") for name in compared} == whole
    assert {name for name in measured if beside(name, known) == "samples"} == {"div", "div_low", "div_high"}
    assert {"hand_contact", "hand_contact_low", "hand_contact_high"} <= measured.keys() - compared


def test_a_part_and_an_end_compare_as_the_number_itself_does() -> None:
    known = {
        "off": Column("off", "m", "low", "an error", beside="recording"),
        "level_low": Column("low", "m", "low", "a number called so"),
        "level": Column("level", "m", "low", "another", beside="samples"),
    }
    for name in ("off", "off_low", "off_high", "off@2s", "off@agent1_low"):
        assert beside(name, known) == "recording"
    assert beside("level_high", known) == "samples" and beside("level_low", known) == ""
    assert beside("offset", known) == beside("unknown_low", known) == ""


def test_torchmetrics_is_told_the_same_direction_as_a_table() -> None:
    """Its `MetricTracker` takes the best value by `higher_is_better`."""
    told = {"low": False, "high": True, "real": None}
    for metric in all_metrics().values():
        assert metric.higher_is_better is told[next(iter(metric.columns.values())).better], type(metric).__name__
