"""Intervals: only independent units narrow them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from magnet.metrics import PositionError, bootstrap_interval, independent_units
from tests.metrics.batches import draw_batch

FRAMES = 100


def numbered(count: int, stride: int) -> tuple[np.ndarray, np.ndarray]:
    """Two recordings with so many scenes each, out of order."""
    recordings, starts = np.repeat([4, 7], count), np.tile(np.arange(count) * stride, 2)
    order = np.random.default_rng(0).permutation(len(starts))
    return recordings[order], starts[order]


@pytest.mark.parametrize("stride", [100, 50, 33, 7])
def test_first_scenes_of_runs_do_not_overlap_and_no_scene_lies_beyond_its_run(stride: int) -> None:
    recordings, starts = numbered(700 // stride, stride)
    units = independent_units(recordings, starts, FRAMES, "scene")
    firsts = []
    for unit in np.unique(units):
        members = units == unit
        assert len(set(recordings[members])) == 1
        assert starts[members].max() < starts[members].min() + FRAMES
        firsts.append((recordings[members][0], starts[members].min()))
    for recording in (4, 7):
        begun = sorted(start for r, start in firsts if r == recording)
        assert (np.diff(begun) >= FRAMES).all()


def test_by_take_a_recording_is_one_unit() -> None:
    recordings, starts = numbered(7, 100)
    units = independent_units(recordings, starts, FRAMES, "take")
    assert len(set(zip(recordings.tolist(), units.tolist(), strict=True))) == 2
    many = np.arange(20) % 5
    assert len(set(independent_units(many, 100 * np.arange(20), FRAMES).tolist())) == 5, "enough recordings"
    few = np.arange(20) % 4
    assert len(set(independent_units(few, 100 * np.arange(20), FRAMES).tolist())) == 20, "too few recordings"
    with pytest.raises(ValueError, match="interval: got 'clip'"):
        independent_units(many, many, FRAMES, "clip")  # type: ignore[arg-type]


@pytest.mark.parametrize("by", ["scene", "take"])
def test_a_second_scene_that_overlaps_each_does_not_narrow_the_interval(by: str) -> None:
    """Each scene once more, a quarter of its length later, with nearly the same value."""
    draw = torch.Generator().manual_seed(0)
    recordings, starts = np.repeat(np.arange(6), 5), np.tile(np.arange(5) * FRAMES, 6)
    values = torch.randn(30, generator=draw, dtype=torch.float64) + torch.from_numpy(recordings)
    again = torch.cat([values, values + 1e-6])
    doubled = np.tile(recordings, 2), np.concatenate([starts, starts + FRAMES // 4])
    once, twice = (
        bootstrap_interval(what, units=torch.from_numpy(independent_units(*where, FRAMES, by)))
        for what, where in ((values, (recordings, starts)), (again, doubled))
    )
    assert float(twice[1] - twice[0]) == pytest.approx(float(once[1] - once[0]), rel=1e-3)
    naive = bootstrap_interval(again)
    assert float(naive[1] - naive[0]) < 0.8 * float(once[1] - once[0])


def test_units_of_one_clip_each_change_nothing() -> None:
    values, counts = torch.rand(20, dtype=torch.float64), torch.rand(20, dtype=torch.float64)
    plain = bootstrap_interval(values, counts)
    for units in (torch.arange(20), torch.full((20,), -1), torch.arange(20).where(torch.arange(20) % 2 > 0, -1)):
        assert bootstrap_interval(values, counts, units=units) == plain


def test_an_interval_over_units_is_as_wide_as_statistics_say() -> None:
    """Forty units of ten equal clips say as much as forty clips."""
    values = torch.randn(400, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    low, high = bootstrap_interval(values.repeat_interleave(10), units=torch.arange(400).repeat_interleave(10))
    half = 1.96 * float(values.std()) / 20
    assert float(high - low) == pytest.approx(2 * half, rel=0.15)


def test_one_unit_has_no_interval() -> None:
    values = torch.rand(5)
    assert bootstrap_interval(values, units=torch.zeros(5, dtype=torch.long)) is None
    assert bootstrap_interval(values[:1]) is None
    assert bootstrap_interval(values[:0]) is None
    metric = PositionError(confidence=0.95)
    metric.update(*draw_batch(people=2), units=torch.tensor([3, 3, 3]))
    assert "mpjpe" in metric.compute() and "mpjpe_low" not in metric.compute()


def test_units_reach_the_interval_whatever_batches_they_come_in() -> None:
    generated, truth, present = draw_batch(scenes=8, people=2)
    units = torch.tensor([0, 0, 1, 1, 2, 2, 3, 3])
    whole, parts, apart = (PositionError(confidence=0.95) for _ in range(3))
    whole.update(generated, truth, present, units=units)
    apart.update(generated, truth, present)
    for b in range(8):
        parts.update(generated[:, [b]], truth[[b]], present[[b]], units=units[[b]])
    assert float(whole.compute()["mpjpe_low"]) == pytest.approx(float(parts.compute()["mpjpe_low"]))
    assert float(whole.compute()["mpjpe_low"]) != pytest.approx(float(apart.compute()["mpjpe_low"]), rel=1e-6)
    with pytest.raises(ValueError, match=r"units: got \(3,\)"):
        PositionError().update(generated, truth, present, units=units[:3])
