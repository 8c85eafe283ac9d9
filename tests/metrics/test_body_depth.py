"""Depth between bodies against a plain loop over capsules, and bodies put into each other on purpose."""

import itertools
import math

import pytest
import torch
from torch import Tensor

from magnet.body.capsules import CAPSULES
from magnet.body.contact import ARMS, deepest
from magnet.metrics import BodyDepth

from .batches import WHO_SLOWLY, Choose, crowd, gridded, pair_places, result

BIN = BodyDepth.BIN


def is_arm(name: str) -> bool:
    return "arm" in name.split()[-1]


def test_the_arms_are_upper_arms_and_forearms() -> None:
    assert [i for i, capsule in enumerate(CAPSULES) if is_arm(capsule.name)] == list(range(ARMS.start, ARMS.stop))


def order_statistic(values: list[float], q: float) -> float:
    """The least value with a share q of all at or below it."""
    return sorted(values)[math.ceil(q * len(values)) - 1]


@WHO_SLOWLY
def test_depths_equal_a_plain_loop(choose: Choose) -> None:
    batch = crowd()
    every, body, arms = [], [], []
    for (b, t, p, q), s in itertools.product(pair_places(batch, choose), range(2)):
        one, other = batch[0][s, b, t, p], batch[0][s, b, t, q]
        found: dict[str, list[float]] = {"every": [0.0], "body": [0.0], "arms": [0.0]}
        for i, j in itertools.product(CAPSULES, CAPSULES):
            apart = gridded(one[i.joint_a], one[i.joint_b], other[j.joint_a], other[j.joint_b])
            depth = i.radius + j.radius - apart
            if not ("forearm" in i.name and "forearm" in j.name):
                found["every"].append(depth)
            found["arms" if is_arm(i.name) and is_arm(j.name) else "body"].append(depth)
        for kind, values in zip((every, body, arms), found.values(), strict=True):
            kind.append(max(values))
    got = result(BodyDepth(), *batch, agents=choose(batch))
    for name, values in (("depth", every), ("depth_body", body), ("depth_arms", arms)):
        for limit in (5, 10)[: 1 if name == "depth_arms" else 2]:
            near = sum(abs(v - limit / 100) < 2e-4 for v in values)  # the grid is good to a tenth of a millimetre
            share = sum(v > limit / 100 for v in values) / len(values)
            assert got[f"{name}_over_{limit}cm"] == pytest.approx(share, abs=near / len(values) + 1e-12)
        assert got[f"{name}_p99"] == pytest.approx(order_statistic(values, 0.99), abs=BIN + 2e-4)
    contact = [v for v in every if v > 0.05]
    assert got["depth_p99_in_contact"] == pytest.approx(order_statistic(contact, 0.99), abs=BIN + 2e-4)
    assert max(arms) <= 0.1 and 0 < got["depth_body_over_10cm"] < 1 and 0 < got["depth_arms_over_5cm"] < 1


def spread() -> Tensor:
    """Joints on a twisted curve, metres from each other: no two bones meet but at their joint. -> (22, 3)"""
    i = torch.arange(22, dtype=torch.float64)
    return torch.stack([10 * i, i**2, i**3 / 10], dim=-1)


def placed(joints: tuple[int, int], ends: Tensor) -> Tensor:
    """Another body far away, but for one bone, whose ends are put somewhere. (2, 3) -> (22, 3)"""
    other = spread() + torch.tensor([0.0, 1e4, 0.0])
    other[list(joints)] = ends
    return other


def test_arm_on_arm_is_told_from_a_thigh_in_a_thigh() -> None:
    one, up = spread(), torch.tensor([0.0, 0.02, 0.0]).double()
    middle, across = one[[18, 20]].mean(dim=0), torch.tensor([[0.0, 0.0, 5.0], [0.0, 0.0, -5.0]]).double()
    lifted = torch.linalg.cross(one[20] - one[18], across[0])
    cases = {
        "upper arms": (placed((16, 18), one[[16, 18]] + up), [0.08, 0.0, 0.08]),
        "crossed forearms": (placed((18, 20), middle + across + 0.02 * lifted / lifted.norm()), [0.0, 0.0, 0.06]),
        "thighs": (placed((1, 4), one[[1, 4]] + up), [0.12, 0.12, 0.0]),
        "a torso in an arm": (placed((0, 3), one[[16, 18]] + up), [0.15, 0.15, 0.0]),
    }
    for name, (other, expected) in cases.items():
        assert deepest(one[None], other[None])[0].tolist() == pytest.approx(expected, abs=3e-3), name


def test_the_deepest_hundredth_is_found_within_a_bin() -> None:
    """Two thighs in each other by 0 to 9.99 cm, evenly over 1000 frames."""
    down = torch.tensor([0.0, 1.0, 0.0]).double()
    bone = spread()[[1, 4]]
    down -= (bone[1] - bone[0]) * (bone[1] - bone[0])[1] / ((bone[1] - bone[0]) ** 2).sum()
    apart = 0.14 - 0.1 * torch.arange(1000).double() / 1000
    other = [placed((1, 4), bone + x * down / down.norm()) for x in apart]
    joints = torch.stack([spread().expand(1000, 22, 3), torch.stack(other)], dim=1)
    got = result(BodyDepth(), joints[None, None], joints[None], torch.ones(1, 2, dtype=torch.bool))
    assert got["depth_p99"] == pytest.approx(0.099, abs=BIN)
    assert got["depth_over_5cm"] == pytest.approx(0.5, abs=0.002) and got["depth_over_10cm"] == 0
    assert got["depth_p99_in_contact"] == pytest.approx(0.0995, abs=BIN)


def test_people_apart_have_no_depth_at_all() -> None:
    joints = torch.stack([spread(), spread() + 1e4])[None, None]
    got = result(BodyDepth(), joints[None], joints, torch.ones(1, 2, dtype=torch.bool))
    assert set(got.values()) == {0.0} and "depth_p99_in_contact" not in got
