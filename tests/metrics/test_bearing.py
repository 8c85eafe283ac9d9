"""Bearings and turns, against trigonometry by hand."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from magnet.metrics import PartnerBearing, TurnRate, bearing, turn_rate
from magnet.metrics.frechet import joint_features
from magnet.motion.frames import from_planar

from .batches import WHO, Choose, draw_batch, pair_places, result, scored

LEFT_HIP, RIGHT_HIP = 1, 2


def heading(body: np.ndarray) -> float:
    """Where the hips face, by the angle of the line from the right hip to the left, turned a quarter. (22, 3) -> rad"""
    across = body[LEFT_HIP] - body[RIGHT_HIP]
    return math.atan2(-across[2], across[0])


def in_own_frame(body: np.ndarray, point: np.ndarray) -> tuple[float, float, float]:
    """A point as one sees it: metres to the left, up and ahead."""
    yaw = heading(body)
    x, z = point[0] - body[0, 0], point[2] - body[0, 2]
    return x * math.cos(yaw) - z * math.sin(yaw), point[1], x * math.sin(yaw) + z * math.cos(yaw)


def degrees_off(body: np.ndarray, partner: np.ndarray) -> float:
    left, _, ahead = in_own_frame(body, partner[0])
    return abs(math.degrees(math.atan2(left, ahead)))


@WHO
def test_bearings_equal_a_plain_loop(choose: Choose) -> None:
    batch = draw_batch(scenes=5, frames=24)
    generated = batch[0].double().numpy()
    facing, behind = [], []
    for b, t, p, q in pair_places(batch, choose):
        for s in range(4):
            one, other = generated[s, b, t, p], generated[s, b, t, q]
            off = (degrees_off(one, other), degrees_off(other, one))
            facing.append(off[0] < 60 and off[1] < 60)
            behind += [off[0] > 90, off[1] > 90]
    assert 0 < np.mean(facing) < 1 and 0 < np.mean(behind) < 1
    got = result(PartnerBearing(within=60), *batch, agents=choose(batch))
    assert (got["facing"], got["behind"]) == pytest.approx((np.mean(facing), np.mean(behind)), abs=1e-12)


@WHO
def test_turn_rates_equal_a_plain_loop(choose: Choose) -> None:
    batch = draw_batch(scenes=4)
    generated, counts = batch[0].double().numpy(), scored(batch, choose)
    by_agent: dict[int, list[float]] = {}
    for b, t, p, s in np.ndindex(4, 19, 3, 4):
        if counts[b][t][p] or counts[b][t + 1][p]:
            step = math.degrees(heading(generated[s, b, t + 1, p]) - heading(generated[s, b, t, p]))
            step = min(abs(step + turn) for turn in (-360, 0, 360))
            by_agent.setdefault(p, []).append(step * 30)
    got = result(TurnRate(), *batch, agents=choose(batch))
    expected = {f"turn_rate@agent{p}": np.mean(found) for p, found in by_agent.items()}
    assert got == pytest.approx(
        {"turn_rate": np.mean([x for found in by_agent.values() for x in found]), **expected}, rel=1e-9
    )


def person(yaw: float, x: float, z: float) -> Tensor:
    """Hips 20 cm wide, facing +z at yaw 0. -> (22, 3)"""
    body = torch.zeros(22, 3, dtype=torch.float64)
    body[LEFT_HIP, 0], body[RIGHT_HIP, 0] = 0.1, -0.1
    T = from_planar(torch.tensor(yaw).double(), torch.tensor([x, z]).double())
    return body @ T[:3, :3].T + T[:3, 3]


def test_a_partner_ahead_is_at_zero_one_to_the_left_at_a_quarter() -> None:
    me = person(0.0, 1.0, 1.0)
    for (x, z), expected in {(1.0, 3.0): 0.0, (2.0, 1.0): math.pi / 2, (0.0, 1.0): -math.pi / 2}.items():
        assert float(bearing(me, person(2.0, x, z))) == pytest.approx(expected, abs=1e-12)
    assert abs(float(bearing(me, person(0.3, 1.0, 0.0)))) == pytest.approx(math.pi)


@pytest.mark.parametrize(
    ("yaws", "facing", "behind"),
    [
        ((0, math.pi), 1, 0),
        ((0, math.pi - 0.5), 1, 0),
        ((0, math.pi - 0.6), 0, 0),
        ((0, 0), 0, 0.5),
        ((math.pi, 0), 0, 1),
    ],
    ids=["face to face", "nearly", "not quite", "one follows", "back to back"],
)
def test_two_people_stand_as_one_says(yaws: tuple[float, float], facing: float, behind: float) -> None:
    scene = torch.stack([person(yaws[0], 0, 0), person(yaws[1], 0, 1)])[None, None]
    got = result(PartnerBearing(), scene[None], scene, torch.ones(1, 2, dtype=torch.bool))
    assert got == {"facing": facing, "behind": behind}


def test_a_turn_on_the_spot_past_half_a_circle_has_the_speed_that_it_has() -> None:
    frames = torch.stack([person(0.2 * t, 0, 0) for t in range(40)])[:, None]
    assert torch.allclose(turn_rate(frames), torch.full((39, 1), math.degrees(0.2) * 30, dtype=torch.float64))


def test_features_in_ones_own_frame_are_what_trigonometry_says() -> None:
    truth = draw_batch(scenes=1, people=2, frames=6)[1][0].double()
    body = truth.numpy()
    features = {name: joint_features(truth, name) for name in ("canonical_joints", "pair", "own_velocity")}  # type: ignore[arg-type]
    for t, p in np.ndindex(6, 2):
        own = [in_own_frame(body[t, p], body[t, p, j]) for j in range(1, 22)]
        np.testing.assert_allclose(features["canonical_joints"][t, p].view(21, 3), own, atol=1e-12)
        seen = [in_own_frame(body[t, p], body[t, 1 - p, j]) for j in range(1, 22)]
        np.testing.assert_allclose(features["pair"][t, p, 0].view(21, 3), seen, atol=1e-12)
        if t:
            ends = [in_own_frame(body[t, p], body[t, p, j]) for j in range(1, 22)]
            starts = [in_own_frame(body[t, p], body[t - 1, p, j]) for j in range(1, 22)]
            velocity = 30 * (np.array(ends) - np.array(starts))
            np.testing.assert_allclose(features["own_velocity"][t - 1, p].view(21, 3), velocity, atol=1e-10)
