"""A hand or a foot comes to its place by its own two bones alone."""

from __future__ import annotations

import pytest
import torch

from magnet.body import load_body
from magnet.body.joints import ANKLES, PARENTS
from magnet.body.reach import LIMBS, reach
from magnet.motion.scene import Scene
from magnet.synthesis.generate import synthesize

BODY = load_body()


@pytest.fixture(scope="module")
def scene() -> Scene:
    return synthesize("handshake", 2, 128, torch.Generator().manual_seed(3), BODY).scene


def turned(scene: Scene, limb: str, place: torch.Tensor) -> Scene:
    return scene.replace(body_rot=reach(BODY, scene.body_rot, scene.T_world_root, scene.betas[:, None], limb, place))


def world(scene: Scene) -> torch.Tensor:
    return BODY.bone_chain(scene.body_rot, scene.T_world_root, BODY.rest_joints(scene.betas[:, None]))[0]


@pytest.mark.parametrize("limb", LIMBS)
def test_an_end_comes_to_its_place_and_nothing_but_its_limb_moves(scene: Scene, limb: str) -> None:
    first, middle, end = LIMBS[limb]
    joints = BODY.joints(scene)
    way = joints[..., end, :] - joints[..., first, :]
    generator = torch.Generator().manual_seed(1)
    place = joints[..., first, :] + 0.7 * way + 0.03 * torch.randn(way.shape, generator=generator)
    made = turned(scene, limb, place)
    found = BODY.joints(made)
    torch.testing.assert_close(found[..., end, :], place, atol=1e-4, rtol=0)
    moves = {joint for joint in range(22) if any(up in (middle, end) for up in ancestors(joint))}
    stays = [joint for joint in range(22) if joint not in moves]
    torch.testing.assert_close(found[..., stays, :], joints[..., stays, :], atol=1e-5, rtol=0)
    if end in ANKLES:
        torch.testing.assert_close(world(made)[..., end, :, :], world(scene)[..., end, :, :], atol=1e-4, rtol=0)
    # brought back, it bends to the side that it bent to
    back = turned(made, limb, joints[..., end, :])
    torch.testing.assert_close(BODY.joints(back)[..., end, :], joints[..., end, :], atol=1e-4, rtol=0)
    elbow = (BODY.joints(back)[..., middle, :] - joints[..., middle, :]).norm(dim=-1)
    assert elbow.median() < 0.03


def ancestors(joint: int) -> list[int]:
    return [] if joint < 0 else [joint, *ancestors(PARENTS[joint])]


@pytest.mark.parametrize("limb", LIMBS)
def test_where_it_is_already_nothing_turns_and_out_of_reach_it_points_there(scene: Scene, limb: str) -> None:
    first, middle, end = LIMBS[limb]
    joints = BODY.joints(scene)
    torch.testing.assert_close(turned(scene, limb, joints[..., end, :]).body_rot, scene.body_rot, atol=1e-3, rtol=0)
    place = joints[..., first, :] + torch.tensor([0.0, 5.0, 0.0])
    found = BODY.joints(turned(scene, limb, place))
    way = found[..., end, :] - joints[..., first, :]
    length = (joints[..., middle, :] - joints[..., first, :]).norm(dim=-1)
    length = length + (joints[..., end, :] - joints[..., middle, :]).norm(dim=-1)
    torch.testing.assert_close(way[..., 1], length, atol=1e-3, rtol=0)


@pytest.mark.parametrize("limb", LIMBS)
def test_a_straight_limb_bends_as_people_do(limb: str) -> None:
    """Standing with arms out: elbows go back when hands come nearer, knees go forward when feet come up."""
    first, middle, end = LIMBS[limb]
    body_rot, root, betas = torch.eye(3).expand(21, 3, 3), torch.eye(4), torch.zeros(10)
    joints = BODY.forward_kinematics(body_rot, root, betas)
    place = joints[first] + 0.7 * (joints[end] - joints[first])
    found = BODY.forward_kinematics(reach(BODY, body_rot, root, betas, limb, place), root, betas)
    torch.testing.assert_close(found[end], place, atol=1e-3, rtol=0)
    line = (joints[first] + place) / 2
    ahead = float(found[middle, 2] - line[2])
    assert ahead < -0.1 if "hand" in limb else ahead > 0.1


def test_what_is_no_limb_is_refused() -> None:
    with pytest.raises(ValueError, match="limb: got 'tail', expected left hand, right hand, left foot, right foot"):
        reach(BODY, torch.eye(3).expand(21, 3, 3), torch.eye(4), torch.zeros(10), "tail", torch.zeros(3))
