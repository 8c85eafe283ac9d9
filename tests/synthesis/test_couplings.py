"""What couples the people of a synthetic scene is what its closed form says."""

from __future__ import annotations

import math
from functools import cache

import pytest
import torch
from torch import Tensor

from magnet.body import Body, load_body
from magnet.metrics import penetration_depth
from magnet.synthesis import COUPLINGS, CoupledScene, coupling_error, synthesize
from magnet.synthesis.people import PALM
from magnet.synthesis.ring import BOTH, LEFT, RIGHT
from tests.cases import few

GROUPS = [(name, people) for name, kind in COUPLINGS.items() for people in (2, 3, 4) if people >= kind.fewest]
LIMITS = {  # what the closed form leaves to living bodies: sway, shapes, a frame's rounding
    "mirror": {"delay": 1e-6, "distance": 0.16},
    "follow": {"delay": 1e-6, "distance": 0.08},
    "handshake": {"gap": 0.01},
    "circle": {"radius": 0.03, "omega": 0.04, "gap": 0.01},
    "patty_cake": {"gap": 0.02, "period": 0.005},
}


@cache
def body() -> Body:
    return load_body("open")


@cache
def made(name: str, people: int, seed: int) -> tuple[CoupledScene, Tensor]:
    """A scene of 300 frames and its joints (T, P, 22, 3)."""
    one = synthesize(name, people, 300, torch.Generator().manual_seed(seed), body())
    return one, body().joints(one.scene)[0]


def palms(one: CoupledScene) -> Tensor:
    """Middle of each palm by the wrists' rotations, left and right. (T, P, 2, 3)"""
    scene = one.scene
    R, t = body().bone_chain(scene.body_rot, scene.T_world_root, body().rest_joints(scene.betas[:, None]))
    out = torch.tensor([[PALM, 0.0, 0.0], [-PALM, 0.0, 0.0]])
    return (t[..., 20:22, :] + (R[..., 20:22, :, :] @ out[..., None])[..., 0])[0]


@pytest.mark.parametrize("seed", few([0, 1, 2], 1))
@pytest.mark.parametrize(("name", "people"), GROUPS)
def test_a_scene_obeys_its_own_closed_form(name: str, people: int, seed: int) -> None:
    one, joints = made(name, people, seed)
    error = coupling_error(name, joints, one.truth)
    assert error.keys() == LIMITS[name].keys()
    for measure, limit in LIMITS[name].items():
        assert error[measure] <= limit, (measure, error)


@pytest.mark.parametrize(("name", "people"), [group for group in GROUPS if group[1] == 2])
def test_people_of_two_scenes_put_together_do_not_obey_it(name: str, people: int) -> None:
    one, joints = made(name, people, 0)
    strangers = torch.stack([joints[:, 0], made(name, people, 1)[1][:, 1]], dim=1)
    error = coupling_error(name, strangers, one.truth)
    assert any(not error[measure] <= 2 * limit for measure, limit in LIMITS[name].items()), error


@pytest.mark.parametrize(("name", "people"), GROUPS)
def test_a_later_stretch_is_measured_from_its_start(name: str, people: int) -> None:
    one, joints = made(name, people, 0)
    later = coupling_error(name, joints[90:], one.truth, start=3.0)
    for measure, limit in LIMITS[name].items():
        assert math.isnan(later[measure]) or later[measure] <= limit, (measure, later)


def test_a_stretch_without_the_contact_says_nan() -> None:
    one, joints = made("handshake", 2, 0)
    assert math.isnan(coupling_error("handshake", joints[:20], one.truth)["gap"])


@pytest.mark.parametrize("people", [2, 3, 4])
def test_shaking_hands_meet_within_two_centimetres(people: int) -> None:
    one, _ = made("handshake", people, 1)
    hands = palms(one)
    for (a, b), (grip, release) in zip(one.truth["pairs"].tolist(), one.truth["contact"].tolist(), strict=True):
        held = slice(math.ceil(grip * 30), math.floor(release * 30))
        assert (hands[held, a, 1] - hands[held, b, 1]).norm(dim=-1).max() < 0.02
        assert (hands[:, a, 1] - hands[:, b, 1]).norm(dim=-1)[[0, -1]].min() > 0.5


@pytest.mark.parametrize("people", [2, 3, 4])
def test_hands_in_the_circle_never_let_go(people: int) -> None:
    hands = palms(made("circle", people, 1)[0])
    assert (hands[:, :, 0] - hands.roll(-1, dims=1)[:, :, 1]).norm(dim=-1).max() < 0.025


@pytest.mark.parametrize("people", [2, 3, 4])
def test_palms_clap_at_the_times_told(people: int) -> None:
    one, _ = made("patty_cake", people, 1)
    hands = palms(one)
    meeting = {BOTH: [(p, 0, (p + 1) % people, 1) for p in range(people)], RIGHT: [(0, 1, 1, 1)], LEFT: [(0, 0, 1, 0)]}
    assert len(one.truth["claps"]) >= 5
    for clap, kind in zip(one.truth["claps"].tolist(), one.truth["kinds"].tolist(), strict=True):
        for a, hand_a, b, hand_b in meeting[kind]:
            now = hands[round(clap * 30)]
            assert (now[a, hand_a] - now[b, hand_b]).norm() < 0.03


@pytest.mark.parametrize(("name", "people"), GROUPS)
def test_people_keep_out_of_each_other(name: str, people: int) -> None:
    for seed in (0, 1, 2):
        joints = made(name, people, seed)[1]
        for a in range(people):
            for b in range(a + 1, people):
                assert (joints[:, a, 0] - joints[:, b, 0]).norm(dim=-1).min() > 0.3
                depth = penetration_depth(joints[:, a], joints[:, b]).amax(dim=(1, 2))
                assert (depth > 0).float().mean() < 0.03


@pytest.mark.parametrize(("name", "people"), [*GROUPS, ("mirror", 1), ("follow", 1)])
def test_the_same_seed_makes_the_same_scene_bit_for_bit(name: str, people: int) -> None:
    first, again, other = (
        synthesize(name, people, 120, torch.Generator().manual_seed(seed), body()) for seed in (5, 5, 6)
    )
    for field, value in first.scene.tensors().items():
        assert torch.equal(value, again.scene.tensors()[field])
    assert first.truth.keys() == again.truth.keys()
    assert all(torch.equal(first.truth[key], again.truth[key]) for key in first.truth)
    assert not torch.equal(first.scene.body_rot, other.scene.body_rot)


def test_bad_wishes_are_told_what_was_expected(generator: torch.Generator) -> None:
    with pytest.raises(ValueError, match=r"waltz.*expected one of mirror"):
        synthesize("waltz", 2, 300, generator, body())
    with pytest.raises(ValueError, match="got 1 people, expected 2 to 4"):
        synthesize("handshake", 1, 300, generator, body())
    with pytest.raises(ValueError, match="got 30 frames, expected at least 120"):
        synthesize("mirror", 2, 30, generator, body())
