"""Only what was generated is scored: frames that were given neither count nor dilute, in any metric."""

import math
from collections.abc import Callable
from itertools import pairwise

import pytest
import torch
from torch import Tensor
from torchmetrics import Metric

from magnet.metrics import Diversity, Futures, Jitter, PositionError, VelocityError, all_metrics
from magnet.sampling.schedule import Grid
from magnet.tasks.inbetweening import Inbetweening

from .batches import EVERY, draw_batch, result

REACH = 4
"""Frames in the longest difference that a metric takes (jitter's third, and one more)."""


def near(scored: Tensor) -> Tensor:
    """Frames of anybody within reach of a scored frame of anybody. (B, T, P) bool -> same"""
    some = scored.any(dim=-1, keepdim=True).double().transpose(1, 2)
    return (torch.nn.functional.max_pool1d(some, 2 * REACH + 1, 1, REACH) > 0).transpose(1, 2).expand_as(scored)


@EVERY
def test_what_was_given_makes_no_difference_but_to_its_neighbours(make: Callable[[], Metric]) -> None:
    """Frames further from anything generated than any difference reaches may hold whatever is finite."""
    generated, truth, present = draw_batch(frames=32)
    agents = torch.zeros(3, 32, 3, dtype=torch.bool)
    agents[0, 12:16] = True
    agents[1, :8, 0] = True
    agents[2, 20:, 1] = True
    filler = 50 * torch.randn(generated.shape, generator=torch.Generator().manual_seed(3))
    there = present[:, None, :, None, None]
    garbage = torch.where(near(agents)[None, ..., None, None], generated, filler)
    assert float(torch.where(there, garbage - generated, 0.0).abs().max()) > 10
    expected = result(make(), generated, truth, present, agents=agents)
    got = result(make(), garbage, truth, present, agents=agents)
    # How long hands hold may depend on frames before and after: test_hand_contact.py.
    assert {k: v for k, v in got.items() if "hold" not in k} == {k: v for k, v in expected.items() if "hold" not in k}
    assert any(value != 0 for value in expected.values())


@EVERY
def test_a_scene_of_which_nothing_was_generated_makes_no_difference(make: Callable[[], Metric]) -> None:
    generated, truth, present = draw_batch(scenes=4)
    agents = torch.ones(4, 1, 3, dtype=torch.bool)
    agents[2] = False
    kept = torch.tensor([0, 1, 3])
    got = result(make(), generated, truth, present, agents=agents)
    assert got == pytest.approx(result(make(), generated[:, kept], truth[kept], present[kept]), abs=1e-9)


@EVERY
def test_who_is_scored_may_be_said_by_agent_frame_or_both(make: Callable[[], Metric]) -> None:
    generated, truth, present = batch = draw_batch()
    B, T, P = truth.shape[:3]
    one = torch.tensor([True, False, False])
    expected = result(make(), *batch, agents=one)
    for agents in (one.expand(B, P), one.expand(T, P), one.expand(B, T, P), one.expand(B, 1, P), one.expand(1, T, P)):
        assert result(make(), *batch, agents=agents) == expected
    short = result(make(), generated[:, :, :12], truth[:, :12], present, agents=one.expand(12, P))
    assert result(make(), generated, truth[:, :12], present, agents=one.expand(T, P)) == short


@pytest.mark.parametrize("every", [8, 4, 2])
def test_keyframes_of_inbetweening_are_not_scored(every: int) -> None:
    """A method that is 1 m off wherever it has to say something is 1 m off, however many keyframes it copies."""
    context, frames = 32, 152
    schedule = Inbetweening(every).schedule(Grid(tokens=(context + frames) // 4, agents=2, context=context // 4))
    made = ~schedule.known.repeat_interleave(4, dim=0)[context:]
    assert 0.1 < float((~made).double().mean()) < 0.6
    _, truth, present = draw_batch(people=2, frames=frames)
    off = made[:, :, None, None] * torch.tensor([1.0, 0.0, 0.0])
    generated = torch.stack([truth + off, truth - off])
    metrics = all_metrics(scored=made)
    metrics.update(generated, truth, present)
    got = {name: float(value) for name, value in metrics.compute().items()}
    for name in ("mpjpe", "mpjpe_best", "mpjpe@0.5s", "mpjpe@1s", "mpjpe@2s", "mpjpe@5s"):
        assert got[name] == pytest.approx(1.0, abs=1e-6), name
    assert got["div"] == pytest.approx(21 * 2.0, abs=1e-5), "two samples 2 m apart have a variance of 2 m^2 a joint"
    steps = [(bool(a), bool(b)) for one in made.T.tolist() for a, b in pairwise(one) if a or b]
    seams = sum(a != b for a, b in steps)
    assert got["mpjve"] == pytest.approx(seams / len(steps), abs=1e-6), "each seam is a jump of 1 m, and all are seen"


def test_a_seam_is_seen_and_given_motion_does_not_dilute_it() -> None:
    """Ten still frames given, then one that jumps: the jump is in every difference that reaches it, and only there."""
    truth = torch.zeros(1, 20, 1, 22, 3, dtype=torch.float64)
    generated = truth[None].clone()
    generated[:, :, 10] = 1.0
    agents = torch.zeros(20, 1, dtype=torch.bool)
    agents[10] = True
    batch = (generated, truth, torch.ones(1, 1, dtype=torch.bool))
    jump = math.sqrt(3)
    assert result(VelocityError(), *batch, agents=agents)["mpjve"] == pytest.approx(jump)
    third = jump * (1 + 3 + 3 + 1) / 4 * 30**3 / 10
    assert result(Jitter(), *batch, agents=agents)["jitter"] == pytest.approx(third)
    assert result(PositionError(), *batch, agents=agents)["mpjpe"] == pytest.approx(jump)
    assert "div" not in result(Diversity(), *batch, agents=agents), "one sample"


def test_two_axes_that_may_mean_either_are_refused() -> None:
    generated, truth, present = draw_batch(scenes=5, frames=5)
    with pytest.raises(ValueError, match=r"5 scenes of 5 frames.*\(5, 1, 3\) or \(1, 5, 3\)"):
        Futures.of(generated, truth, present, torch.ones(5, 3, dtype=torch.bool))
    by_frame = torch.ones(5, 3, dtype=torch.bool)
    by_frame[2:] = False
    assert int(Futures.of(generated, truth, present, by_frame[None]).scored[1, 2:].sum()) == 0
    metric = PositionError(agents=by_frame)  # there is no batch yet that its first axis might mean
    expected = result(PositionError(), generated[:, :, :2], truth[:, :2], present)["mpjpe"]
    assert result(metric, generated, truth, present)["mpjpe"] == pytest.approx(expected)
