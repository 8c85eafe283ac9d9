"""Token borders against a plain loop, and a jerk put on one."""

import itertools
import math

import numpy as np
import pytest
import torch

from magnet.metrics import TokenBorders

from .batches import WHO, Choose, draw_batch, result, scored

WEIGHTS = {"border_acceleration": (1, -2, 1), "border_jerk": (-1, 3, -3, 1)}


@WHO
@pytest.mark.parametrize("name", WEIGHTS)
def test_borders_equal_a_plain_loop(name: str, choose: Choose) -> None:
    batch = draw_batch(frames=27)
    pelvis, counts, weights = batch[0].double().numpy()[..., 0, :], scored(batch, choose), WEIGHTS[name]
    lengths: dict[bool, list[float]] = {True: [], False: []}
    for s, b, t, p in itertools.product(range(4), range(3), range(28 - len(weights)), range(3)):
        frames = range(t, t + len(weights))
        if any(counts[b][frame][p] for frame in frames):
            difference = sum(w * pelvis[s, b, frame, p] for w, frame in zip(weights, frames, strict=True))
            lengths[len({frame // 4 for frame in frames}) > 1].append(math.hypot(*difference))
    got = result(TokenBorders(), *batch, agents=choose(batch))[name]
    assert got == pytest.approx(np.mean(lengths[True]) / np.mean(lengths[False]), rel=1e-10)


def test_a_jump_at_each_border_shows_and_one_inside_tokens_shows_the_other_way() -> None:
    draw = torch.Generator().manual_seed(0)
    smooth = torch.randn(1, 1, 4000, 1, 22, 3, generator=draw, dtype=torch.float64) * 0.01
    frame = torch.arange(4000)
    there = torch.ones(1, 1, dtype=torch.bool)
    for first, high in ((0, True), (2, False)):
        jumps = ((frame % 4 == first).cumsum(0) * 0.1)[:, None, None, None] * torch.tensor([1.0, 0.0, 0.0])
        got = result(TokenBorders(), smooth + jumps, smooth[0], there)
        assert all((value > 1) == high for value in got.values()), got
    got = result(TokenBorders(), smooth, smooth[0], there)
    assert got == pytest.approx({"border_acceleration": 1.0, "border_jerk": 1.0}, abs=0.05)


def test_tokens_too_short_to_have_an_inside_are_refused() -> None:
    with pytest.raises(ValueError, match="stride: got 3"):
        TokenBorders(stride=3)
