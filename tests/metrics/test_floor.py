"""Feet and the floor, and how still toes stand, against plain loops."""

import itertools
import math

import numpy as np
import pytest
import torch

from magnet.metrics import Down, Floating, GroundPenetration, StandingToes

from .batches import WHO, Choose, draw_batch, result, scored


@WHO
def test_floating_and_ground_penetration_equal_a_plain_loop(choose: Choose) -> None:
    batch = draw_batch(scenes=6, frames=24)
    batch[0][..., 1] -= 0.15
    generated, counts = batch[0].double().numpy(), scored(batch, choose)
    floats, under, frames = [], [], 0
    for s, b, t, p in itertools.product(range(4), range(6), range(24), range(3)):
        if counts[b][t][p]:
            frames += 1
            lowest = min(generated[s, b, t, p, joint, 1] for joint in (7, 8, 10, 11))
            floats += [lowest] if lowest > 0.06 else []
            under += [-lowest] if lowest < -0.02 else []
    assert floats and under
    got = result(Floating(), *batch, agents=choose(batch))
    assert got == pytest.approx({"floating": len(floats) / frames, "floating_height": np.mean(floats)}, abs=1e-12)
    got = result(GroundPenetration(), *batch, agents=choose(batch))
    expected = {"ground_penetration": len(under) / frames, "ground_penetration_depth": np.mean(under)}
    assert got == pytest.approx(expected, abs=1e-12)


def test_feet_on_the_floor_are_neither_above_it_nor_in_it() -> None:
    joints = torch.ones(1, 1, 4, 1, 22, 3)
    joints[..., (7, 8), 1], joints[..., (10, 11), 1] = 0.09, 0.02
    batch = (joints, joints[0], torch.ones(1, 1, dtype=torch.bool))
    assert result(Floating(), *batch) == {"floating": 0.0}
    assert result(GroundPenetration(), *batch) == {"ground_penetration": 0.0}
    joints[0, 0, 0, ..., 1] += 0.5  # one frame of four in the air
    joints[0, 0, 1, 0, 11, 1] = -0.05  # one with one toe in the floor
    assert result(Floating(), *batch) == pytest.approx({"floating": 0.25, "floating_height": 0.52})
    expected = {"ground_penetration": 0.25, "ground_penetration_depth": 0.05}
    assert result(GroundPenetration(), *batch) == pytest.approx(expected)


@WHO
def test_who_is_down_equals_a_plain_loop(choose: Choose) -> None:
    batch = draw_batch(scenes=6, frames=24)
    generated, counts = batch[0].double().numpy(), scored(batch, choose)
    down, frames = 0, 0
    for s, b, t, p in itertools.product(range(4), range(6), range(24), range(3)):
        if counts[b][t][p]:
            frames += 1
            down += generated[s, b, t, p, 0, 1] < 0.6
    assert 0 < down < frames
    assert result(Down(), *batch, agents=choose(batch)) == pytest.approx({"down": down / frames}, abs=1e-12)


@WHO
def test_standing_toes_equal_a_plain_loop(choose: Choose) -> None:
    batch = draw_batch(scenes=8)
    batch[0][..., (10, 11), 1] -= 0.4
    generated, counts = batch[0].double().numpy(), scored(batch, choose)
    speeds = []
    for s, b, t, p, toe in itertools.product(range(4), range(8), range(19), range(3), (10, 11)):
        now, then = generated[s, b, t, p, toe], generated[s, b, t + 1, p, toe]
        if (counts[b][t][p] or counts[b][t + 1][p]) and now[1] < 0.05 and then[1] < 0.05:
            speeds.append(math.hypot(then[0] - now[0], then[2] - now[2]) * 30)
    got = result(StandingToes(still=0.8), *batch, agents=choose(batch))
    assert got["toe_still"] == pytest.approx(np.mean([speed < 0.8 for speed in speeds]), abs=1e-12)
    assert 0 < got["toe_still"] < 1
    middle = sorted(speeds)[math.ceil(len(speeds) / 2) - 1]
    assert got["toe_speed"] == pytest.approx(middle, abs=StandingToes.BIN)


def test_toes_in_the_air_say_nothing_of_standing() -> None:
    joints = torch.ones(1, 1, 8, 1, 22, 3)
    assert result(StandingToes(), joints, joints[0], torch.ones(1, 1, dtype=torch.bool)) == {}
