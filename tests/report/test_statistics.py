"""Intervals, orderings and numbers without a scene (`magnet report`)."""

from __future__ import annotations

import math

import pytest
import torch

from magnet.body import load_body
from magnet.metrics import FootSkating, FrechetDistance, MotionInteraction, PositionError
from magnet.report.folds import Folds
from magnet.report.statistics import difference, estimate, verdict
from magnet.testing import random_scene
from tests.report.toys import run_of


def test_of_a_mean_the_interval_is_students() -> None:
    """Of 1, 2, 4, 7, 11: mean 5, deviation 4.062, error 1.817; t of four degrees of freedom 2.776 (any table)."""
    found = estimate([run_of([1.0, 2.0, 4.0, 7.0, 11.0])], "fd")
    assert found is not None
    assert found.interval == pytest.approx((5 - 2.776 * 1.8166, 5 + 2.776 * 1.8166), abs=1e-3)


def test_seeds_that_differ_widen_the_interval() -> None:
    same, apart = ([run_of([1.0 + s, 2.0 + s, 4.0 + s]) for s in (0.0, step, 2 * step)] for step in (0.0, 0.5))
    narrow, wide = estimate(same, "fd"), estimate(apart, "fd")
    assert narrow is not None and wide is not None
    assert wide.error == pytest.approx(math.hypot(narrow.error, 0.5 / math.sqrt(3)))


@pytest.mark.parametrize(
    ("b", "said"),
    [
        ([1.1, 2.1, 4.2, 7.1], "holds"),
        ([0.9, 1.9, 3.8, 6.9], "does not hold"),
        ([3.0, 0.5, 6.0, 5.0], "cannot be told"),
    ],
)
def test_an_ordering_is_judged_scene_by_scene(b: list[float], said: str) -> None:
    """The numbers of scenes differ far more than the methods do: pairs tell what two intervals would hide."""
    a = [run_of([1.0, 2.0, 4.0, 7.0])]
    assert verdict(difference(a, [run_of(b)], "fd"), claimed_lower=True) == said
    other = {"holds": "does not hold", "does not hold": "holds"}.get(said, said)
    assert verdict(difference(a, [run_of(b)], "fd"), claimed_lower=False) == other


def test_a_single_scene_tells_nothing() -> None:
    one = [{"value": {"fd": 1.0}, "without": {}}]
    found = estimate(one, "fd")
    assert found is not None and found.interval is None
    assert verdict(difference(one, one, "fd"), True) == "cannot be told"
    assert estimate(one, "mi") is None


def test_numbers_without_a_scene_are_those_of_the_other_scenes() -> None:
    generator = torch.Generator().manual_seed(0)
    future = load_body().joints(random_scene(3, 40, 2, generator))
    joints = future + 0.1 * torch.randn(2, *future.shape, generator=generator)
    present, agents = torch.ones(3, 2, dtype=torch.bool), torch.ones(1, 40, 2, dtype=torch.bool)
    folds = Folds(30.0)
    folds.update(joints[:, :2], future[:2], present[:2], agents=agents, units=torch.tensor([0, 1]))
    folds.update(joints[:, 2:], future[2:], present[2:], agents=agents, units=torch.tensor([0]))
    value, without = folds.rows()
    for left, row in (([0, 1, 2], value), ([1], without[0]), ([0, 2], without[1])):
        for metric in (FrechetDistance(), MotionInteraction(), FootSkating(), PositionError()):
            metric.update(joints[:, left], future[left], present[left], agents=agents)
            for name, number in metric.compute().items():
                if name in row:
                    assert row[name] == pytest.approx(float(number), rel=1e-9), (left, name)
    assert {"fd", "mi", "fs", "mpjpe", "div", "ip_ratio", "fd_pair"} <= value.keys()
