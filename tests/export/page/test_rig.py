"""What a browser draws from bone poses is the body."""

import numpy as np
import pytest
import roma
import torch

from magnet.body import Body
from magnet.export.drawing import STYLES
from magnet.export.limbs import CAPSULES, STICKS, limbs, turn_to
from magnet.export.page.rig import bend, bone_poses, capsule, rigs, strongest
from magnet.motion.scene import Scene

MILLIMETRE = 1e-3


def test_bending_by_bone_poses_gives_the_bodys_vertices_within_a_millimetre(duet: Scene, body: Body) -> None:
    turns, places = bone_poses(body, duet)
    truth = body.vertices(duet)[0].numpy()
    for p, rig in enumerate(rigs(body, duet.betas[0])):
        for t in (0, 7, 23):
            assert np.abs(bend(rig, turns[t, p], places[t, p]) - truth[t, p]).max() < MILLIMETRE


def test_a_body_whose_vertices_follow_more_than_four_bones_keeps_the_strongest_four() -> None:
    weights = torch.tensor([[0.3, 0.25, 0.2, 0.1, 0.1, 0.05] + [0.0] * 16])
    bones, shares = strongest(weights)
    assert set(bones[0, :3].tolist()) == {0, 1, 2}
    assert shares.sum() == pytest.approx(1.0)
    assert shares[0, 0] == pytest.approx(0.3 / 0.85)


def test_dense_weights_are_those_of_the_body(duet: Scene, body: Body) -> None:
    dense = rigs(body, duet.betas[0])[0].skin.dense_weights()
    np.testing.assert_allclose(dense, body.weights.numpy(), atol=1e-5)


@pytest.mark.parametrize(("style", "table"), [("capsules", CAPSULES), ("skeleton", STICKS)])
def test_every_limb_of_a_mannequin_stays_around_its_joints_in_any_pose(duet, body, style, table) -> None:
    turns, places = bone_poses(body, duet)
    per_limb = len(capsule(1.0, 0.1, 0.1)[0])
    for p, rig in enumerate(rigs(body, duet.betas[0], style)):
        start, end, radii = (x[0] for x in limbs(places[11, p][None].astype(float), table))
        bent = bend(rig, turns[11, p], places[11, p]).reshape(len(table), per_limb, 3)
        for a, b, r, points in zip(start, end, radii, bent, strict=True):
            share = np.clip(((points - a) @ (b - a)) / max(float((b - a) @ (b - a)), 1e-9), 0, 1)
            away = np.linalg.norm(points - a - share[:, None] * (b - a), axis=1)
            # Heels, toes and the crown are guessed from the pose, so they lie a little elsewhere.
            assert away.max() < r.max() + 0.06


def test_faces_of_a_capsule_look_outwards() -> None:
    points, faces, far = capsule(0.5, 0.1, 0.05)
    corners = points[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    middle = corners.mean(axis=1)
    axis = np.stack([np.zeros(len(middle)), np.zeros(len(middle)), np.clip(middle[:, 2], 0, 0.5)], axis=1)
    outward = ((middle - axis) * normal).sum(axis=1)
    assert (outward > -1e-9).all()
    assert points[far][:, 2].max() == pytest.approx(0.55)
    assert points[~far][:, 2].min() == pytest.approx(-0.1)


def test_turn_to_takes_z_to_the_direction() -> None:
    direction = np.random.default_rng(1).normal(size=(50, 3))
    R = turn_to(direction)
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-9)
    np.testing.assert_allclose(R[..., 2], direction / np.linalg.norm(direction, axis=1, keepdims=True), atol=1e-9)
    assert (np.linalg.det(R) > 0).all()


def test_bones_of_a_body_at_rest_are_turned_as_its_pelvis_is(duet: Scene, body: Body) -> None:
    still = duet.replace(body_rot=torch.eye(3).expand_as(duet.body_rot))
    rotations = roma.unitquat_to_rotmat(torch.from_numpy(bone_poses(body, still)[0])[..., [1, 2, 3, 0]])
    torch.testing.assert_close(rotations, still.T_world_root[0, ..., None, :3, :3].expand_as(rotations))


@pytest.mark.parametrize("style", STYLES)
def test_each_style_has_whole_meshes_with_weights_that_sum_to_one(duet: Scene, body: Body, style) -> None:
    for rig in rigs(body, duet.betas[0], style):
        skin = rig.skin
        assert skin.faces.max() < len(skin.vertices)
        assert skin.bones.max() < 22
        np.testing.assert_allclose(skin.weights.sum(axis=1), 1, atol=1e-5)
