"""Synthetic people look like people: feet stay planted, joints bend the right way, nothing jerks."""

from __future__ import annotations

from functools import cache

import pytest
import torch
from torch import Tensor

from magnet.body import Body, load_body
from magnet.motion.rotations import geodesic
from magnet.motion.scene import Scene
from magnet.synthesis import COUPLINGS, synthesize
from tests.counting import Counting

SCENES = [(name, max(kind.fewest, people)) for name, kind in COUPLINGS.items() for people in (1, 3)]
each_scene = pytest.mark.parametrize(("name", "people"), SCENES)


@cache
def body() -> Body:
    return load_body("open")


@cache
def made(name: str, people: int) -> tuple[Scene, Tensor]:
    scene = synthesize(name, people, 300, torch.Generator().manual_seed(11), body()).scene
    return scene, body().joints(scene)[0]


def standing_heights(scene: Scene) -> Tensor:
    """Heights of ankles and balls when standing. (P, 4)"""
    rest = body().rest_joints(scene.betas)[0]
    lowest = torch.stack([(body().v_template + body().shapedirs @ betas)[:, 1].min() for betas in scene.betas[0]])
    return rest[:, [7, 8, 10, 11], 1] - lowest[:, None]


@each_scene
def test_a_foot_that_stands_does_not_skate(name: str, people: int) -> None:
    scene, joints = made(name, people)
    feet = joints[:, :, [7, 8, 10, 11]]
    low = feet[..., 1] - standing_heights(scene) < 0.01
    flat = low[..., :2] & low[..., 2:]
    speed = feet.diff(dim=0).norm(dim=-1) * 30
    flat = flat[1:] & flat[:-1]
    assert flat.float().mean() > 0.25
    assert speed[..., :2][flat].median() < 0.01
    assert speed[..., 2:][flat].median() < 0.01
    # More than a fifth of all toe frames do not move at all.
    assert (speed[..., 2:] < 1e-4).float().mean() > 0.2


@each_scene
def test_feet_neither_sink_nor_float(name: str, people: int) -> None:
    scene, joints = made(name, people)
    over = joints[:, :, [7, 8, 10, 11], 1] - standing_heights(scene)
    assert over.min() > -0.015
    assert over.amin(dim=-1).max() < 0.04
    some = scene.replace(body_rot=scene.body_rot[:, ::10], T_world_root=scene.T_world_root[:, ::10])
    soles = body().vertices(some)[..., 1].amin(dim=-1)
    assert soles.min() > -0.02
    assert soles.max() < 0.03


@each_scene
def test_nothing_jerks(name: str, people: int) -> None:
    scene, joints = made(name, people)
    turn = geodesic(scene.body_rot[:, 1:], scene.body_rot[:, :-1]) * 30
    assert turn.max() < 15
    assert (joints.diff(n=2, dim=0).norm(dim=-1) * 900).max() < 80


@each_scene
def test_rotations_are_rotations(name: str, people: int) -> None:
    scene, _ = made(name, people)
    for R in (scene.body_rot, scene.T_world_root[..., :3, :3]):
        assert torch.allclose(R @ R.transpose(-1, -2), torch.eye(3).expand_as(R), atol=1e-5)
        assert (torch.linalg.det(R) > 0).all()


@each_scene
def test_knees_and_elbows_bend_the_way_they_do(name: str, people: int) -> None:
    scene, _ = made(name, people)
    rotation = scene.body_rot[0]
    for knee in (4, 5):
        shin = rotation[:, :, knee - 1] @ torch.tensor([0.0, -1.0, 0.0])
        assert shin[..., 2].max() < 0.05  # backward
        assert shin[..., 0].abs().max() < 0.2  # not aside
        assert shin[..., 1].max() < 0.4  # at most 110 degrees
    for elbow, side in ((18, 1.0), (19, -1.0)):
        forearm = rotation[:, :, elbow - 1] @ torch.tensor([side, 0.0, 0.0])
        assert forearm[..., 2].min() > -0.05  # forward
        assert forearm[..., 1].abs().max() < 0.1


@each_scene
def test_people_are_upright_and_all_different(name: str, people: int) -> None:
    scene, joints = made(name, people)
    assert (joints[:, :, 15, 1] - joints[:, :, 0, 1]).min() > 0.4
    assert scene.T_world_root[..., 1, 1].min() > 0.85
    assert scene.betas.abs().max() <= 2
    for a in range(people):
        for b in range(a):
            assert not torch.equal(scene.betas[0, a], scene.betas[0, b])


def test_walkers_swing_each_arm_with_the_other_leg() -> None:
    _, joints = made("follow", 3)
    ahead = joints - joints[:, :, :1]
    forward = torch.linalg.cross(joints[:, :, 1] - joints[:, :, 2], torch.tensor([0.0, 1.0, 0.0]).expand(300, 3, 3))
    along = (ahead * (forward / forward.norm(dim=-1, keepdim=True))[:, :, None]).sum(-1)
    arms, legs = along[..., 20] - along[..., 21], along[..., 7] - along[..., 8]
    for person in range(3):
        assert torch.corrcoef(torch.stack([arms[:, person], legs[:, person]]))[0, 1] < -0.8


def test_many_frames_take_hardly_more_operators_than_few() -> None:
    """Nothing loops over frames, of which a core makes thousands a second."""
    made("mirror", 2)
    counts = []
    for frames in (120, 1200):
        with Counting() as counted:
            synthesize("mirror", 4, frames, torch.Generator().manual_seed(1), body())
        counts.append(counted.operators)
    assert counts[1] < 1.2 * counts[0]
