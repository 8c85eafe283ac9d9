"""Memorisation: the nearest training window is the nearest of a plain loop, wherever and in whatever slots it is."""

import itertools
import math

import pytest
import torch
from torch import Tensor

from magnet.baselines import Windows
from magnet.body import load_body
from magnet.evaluation.evaluator import aligned
from magnet.metrics import memorisation
from magnet.metrics.memorisation import NearestTraining
from magnet.motion.scene import Scene, concatenate
from tests.baselines.test_retrieval import CONTEXT, HORIZON, somewhere_else, wander

BODY = load_body()


@pytest.fixture(scope="module")
def train() -> Scene:
    return concatenate([wander(5, people, seed=people) for people in (1, 2, 3)])


def measured(train: Scene, scenes: Scene, made: Tensor | None = None, agents: Tensor | None = None) -> float:
    """Of futures that are given as scenes, or as joints (S, B, T, P, 22, 3) in the world that all share."""
    metric = NearestTraining(Windows.of([train], BODY, CONTEXT))
    truth = BODY.joints(aligned(scenes, CONTEXT - 1).slice(CONTEXT))
    metric.update(truth[None] if made is None else made, truth, scenes.present, agents)
    return float(metric.compute().get("nearest_training", math.nan))


@pytest.mark.parametrize("people", [1, 2, 3])
def test_a_training_window_is_found_again_moved_and_in_other_slots(train: Scene, people: int) -> None:
    known = train.select([5 * people - 4, 5 * people - 1])
    again = known.permute_agents(torch.tensor([2, 0, 1])).transformed(somewhere_else(2))
    assert measured(train, again) < 1e-5
    assert measured(train.select([k for k in range(15) if k not in (5 * people - 4, 5 * people - 1)]), again) > 0.05


def slow(train: Scene, made: Tensor, scored: Tensor) -> float:
    """The least mean distance over windows and orders, frame by frame. (T, P, 22, 3), (T, P) bool"""
    people, found = made.shape[1], []
    for window in range(train.scenes):
        if int(train.present[window].sum()) != people:
            continue
        for order in itertools.permutations(range(people)):
            rest = [slot for slot in range(train.agents) if slot >= people]
            seen = aligned(train.select([window]).permute_agents(torch.tensor([*order, *rest])), CONTEXT - 1)
            joints = BODY.joints(seen.slice(CONTEXT))[0]
            parts = [
                float((joints[t, p, j] - made[t, p, j]).square().sum().sqrt())
                for t in range(0, HORIZON, 3)
                for p in range(people)
                if scored[t, p]
                for j in range(1, 22)
            ]
            found.append(sum(parts) / len(parts))
    return min(found)


def test_distance_equals_a_plain_loop_over_windows_orders_frames_and_joints(
    train: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memorisation, "CHUNK", 3)
    scene = wander(1, 2, seed=11)
    truth = BODY.joints(aligned(scene, CONTEXT - 1).slice(CONTEXT))
    made = truth + 0.3 * torch.randn(2, *truth.shape, generator=torch.Generator().manual_seed(0))
    scored = torch.ones(HORIZON, 2, dtype=torch.bool)
    scored[4:11, 0] = False
    expected = sum(slow(train, made[s, 0], scored) for s in range(2)) / 2
    assert measured(train, scene, made, scored) == pytest.approx(expected, rel=1e-5)


def test_scenes_of_a_size_that_training_has_not_are_not_measured(train: Scene) -> None:
    assert math.isnan(measured(train, wander(1, 4, seed=1)))
    both = concatenate([wander(1, 4, seed=1), wander(1, 2, seed=1)])
    assert measured(train, both) == pytest.approx(measured(train, wander(1, 2, seed=1)))


def test_what_is_not_scored_does_not_count(train: Scene) -> None:
    """A sample that repeats training where it was generated is that near, whatever was given beside it."""
    known = train.select([7])
    truth = BODY.joints(aligned(known, CONTEXT - 1).slice(CONTEXT))
    made = truth[None].clone()
    made[:, :, 6:12] += 5.0
    scored = torch.ones(1, HORIZON, 3, dtype=torch.bool)
    scored[:, 6:12] = False
    assert measured(train, known, made, scored) < 1e-5 < 1.0 < measured(train, known, made)
    assert math.isnan(measured(train, known, made, torch.zeros_like(scored)))


def test_the_nearest_is_over_the_frames_that_windows_have() -> None:
    """Two windows of three frames, futures of five: one window is 0.5 m off in all of them, the other in one alone."""
    futures, scored = torch.zeros(2, 5, 1, 21, 3), torch.ones(5, 1, dtype=torch.bool)
    futures[1, 3:] = 7.0
    windows = torch.zeros(2, 3, 1, 21, 3)
    windows[0, ..., 0] = 0.5
    windows[1, 2, ..., 2] = 0.5
    assert memorisation.nearest_distance(futures, windows, scored).tolist() == pytest.approx([0.5 / 3] * 2)
    scored[:3] = False
    assert memorisation.nearest_distance(futures, windows, scored).tolist() == [math.inf] * 2
