import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from magnet.body import load_body
from magnet.body.joints import ELBOWS, WRISTS
from magnet.motion.frames import canonical_frame, pose_features
from magnet.motion.scene import Scene
from magnet.motion.tokens import scene_deltas
from magnet.testing import random_scene
from magnet.tokenizer.losses import TOES, matrices, moved, reconstruction_losses, standing, world_velocity


@pytest.fixture(scope="module")
def body():
    return load_body()


def in_frames(body, scene: Scene) -> torch.Tensor:
    """Joints in each one's own canonical frame. (B, T, P, 22, 3)"""
    return body.forward_kinematics(*matrices(pose_features(scene)), scene.betas[:, None])


def test_ways_over_the_ground_are_those_of_joints_in_the_world(body, generator):
    scene = random_scene(2, 12, 3, generator)
    ways = world_velocity(in_frames(body, scene), scene_deltas(scene))
    world = body.joints(scene).diff(dim=1)
    turn = canonical_frame(scene.T_world_root)[:, :-1, :, :3, :3]
    assert torch.allclose(ways, world @ turn, atol=1e-5)


def toes(height: float, speed: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Two frames of somebody whose canonical frame goes 1 cm forward, and whose toes move at a speed in the world."""
    joints = torch.zeros(1, 2, 1, 22, 3)
    joints[..., TOES, 1] = height
    joints[:, 1, ..., TOES, 2] = speed / 30 - 0.01
    deltas = torch.tensor([1.0, 0, 0, 0, 1, 0, 0, 0, 0.01]).expand(1, 2, 1, 9)
    return joints, deltas


@pytest.mark.parametrize(("height", "speed", "stands"), [(0.02, 0.1, True), (0.08, 0.1, False), (0.02, 0.5, False)])
def test_a_toe_stands_that_is_low_and_slow(height, speed, stands):
    assert standing(*toes(height, speed)).all() == stands


def test_foot_contact_is_the_speed_at_which_given_steps_make_standing_toes_slide(body):
    """Somebody stands; the deltas that the decoder was given lead over the ground at 0.3 m/s."""
    scene = random_scene(1, 1, 2, torch.Generator().manual_seed(1))
    still = scene.replace(
        body_rot=scene.body_rot.expand(-1, 16, -1, -1, -1, -1),
        T_world_root=scene.T_world_root.expand(-1, 16, -1, -1, -1),
    )
    lowest = body.joints(still)[..., TOES, 1].amax()
    pose = pose_features(still)
    pose[..., -2] -= lowest  # both toes on the floor or under it
    deltas = scene_deltas(still)
    away = deltas.clone()
    away[..., 8] += 0.3 / 30
    mask = torch.ones(pose.shape[:3], dtype=torch.bool)

    def joints(pose: torch.Tensor) -> torch.Tensor:
        return body.forward_kinematics(*matrices(pose), still.betas[:, None])

    assert standing(joints(pose), deltas).all()
    got = reconstruction_losses(pose, pose, mask, joints, away, deltas)
    assert got["foot_contact"] == pytest.approx(0.3, rel=1e-2)
    assert reconstruction_losses(pose, pose, mask, joints, deltas, deltas)["foot_contact"] == pytest.approx(0, abs=1e-2)
    assert "foot_contact" not in reconstruction_losses(pose, pose, mask, joints)


def test_moving_points_is_what_a_turn_and_a_shift_do():
    quarter = torch.tensor([math.cos(math.pi / 2), 0, -1, 0, 1, 0, 1.0, 0, 2.0])
    assert torch.allclose(moved(quarter, torch.tensor([[0.0, 1.0, 1.0]])), torch.tensor([[2.0, 1.0, 2.0]]), atol=1e-6)


def test_the_hand_term_is_how_far_the_middles_of_the_hands_are_off(body, generator):
    """Forearms turned at the elbow by an angle: the hand, 8 cm beyond the wrist, swings on that circle."""
    scene = random_scene(1, 4, 1, generator)
    pose, angle = pose_features(scene), 0.3
    bent = scene.body_rot.clone()
    for elbow in ELBOWS:
        turn = torch.tensor(
            [[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1.0]]
        )
        bent[..., elbow - 1, :, :] = bent[..., elbow - 1, :, :] @ turn
    off = pose_features(scene.replace(body_rot=bent))

    def joints(pose: torch.Tensor) -> torch.Tensor:
        return body.forward_kinematics(*matrices(pose), scene.betas[:, None])

    mask = torch.ones(pose.shape[:3], dtype=torch.bool)
    hands = []
    for wrist, elbow in zip(WRISTS, ELBOWS, strict=True):
        for points in (joints(pose), joints(off)):
            arm = points[..., wrist, :] - points[..., elbow, :]
            hands.append(points[..., elbow, :] + arm * (1 + 0.08 / arm.norm(dim=-1, keepdim=True)))
    expected = torch.stack([(hands[1] - hands[0]).norm(dim=-1), (hands[3] - hands[2]).norm(dim=-1)]).mean()
    got = reconstruction_losses(off, pose, mask, joints)["hand"]
    assert got > 0.02 and got == pytest.approx(float(expected), rel=1e-3)


def test_joint_and_velocity_terms_are_metres_and_metres_a_second(generator):
    """Of made-up joints, those that count: somebody's last frames do not, nor steps into or out of them."""
    truth, decoded = torch.randn(2, 2, 6, 3, 135, generator=generator)
    mask = torch.ones(2, 6, 3, dtype=torch.bool)
    mask[1, 4:, 2] = mask[0, 2, 0] = False

    def joints(pose: torch.Tensor) -> torch.Tensor:
        return pose[..., :66].unflatten(-1, (22, 3))

    got = reconstruction_losses(decoded, truth, mask, joints)
    away = (joints(decoded) - joints(truth)).double().numpy()
    lengths, slips, of_feet = [], [], []
    for b, t, p in np.ndindex(2, 6, 3):
        if mask[b, t, p]:
            lengths += [np.linalg.norm(away[b, t, p, j]) for j in range(22)]
        if t and mask[b, t, p] and mask[b, t - 1, p]:
            slip = 30 * np.linalg.norm(away[b, t, p] - away[b, t - 1, p], axis=-1)
            slips += slip.tolist()
            of_feet += slip[[7, 8, 10, 11]].tolist()  # ankles and toes of SMPL
    for name, expected in (("joint", lengths), ("velocity", slips), ("foot_velocity", of_feet)):
        assert float(got[name]) == pytest.approx(np.mean(expected), rel=1e-4), name


def test_rotation_terms_are_quadratic_up_to_one_radian_and_linear_above():
    """One joint of 21 is turned, and the root as far; angles by SciPy. Eq. 4 with its smooth L1."""
    for angle in (0.4, 2.0):
        turned = torch.from_numpy(Rotation.from_rotvec([0, 0.6 * angle, 0.8 * angle]).as_matrix()).float()
        truth = torch.eye(3)[:, :2].T.flatten().repeat(22)
        truth = torch.cat([truth, torch.tensor([0.1, 0.9, 0.2])])
        decoded = truth.clone()
        decoded[5 * 6 : 6 * 6] = decoded[21 * 6 : 22 * 6] = 3 * turned[:, :2].T.flatten()  # of any length
        decoded[-3:] += torch.tensor([0.3, 0.0, 1.7])
        losses = reconstruction_losses(decoded[None, None, None], truth[None, None, None], torch.ones(1, 1, 1).bool())
        smooth = angle**2 / 2 if angle < 1 else angle - 0.5
        assert float(losses["joint_rotation"]) == pytest.approx(smooth / 21, rel=1e-4)
        assert float(losses["root_rotation"]) == pytest.approx(smooth, rel=1e-4)
        assert float(losses["root_translation"]) == pytest.approx((0.3**2 / 2 + 1.7 - 0.5) / 3, rel=1e-4)


def test_frames_that_do_not_count_may_hold_anything_and_pull_at_nothing(body, generator):
    """NaN of a recording reaches a gradient even where a loss leaves it out: 0 times NaN is NaN."""
    scene = random_scene(1, 6, 2, generator)
    truth, mask = pose_features(scene), torch.ones(1, 6, 2, dtype=torch.bool)
    mask[0, 2:4, 1] = False

    def joints(pose: torch.Tensor) -> torch.Tensor:
        return body.forward_kinematics(*matrices(pose), scene.betas[:, None])

    slopes = []
    for filler in (0.5, torch.nan):
        decoded = (truth + 0.1).requires_grad_()
        recorded = torch.where(mask[..., None], truth, filler)
        losses = reconstruction_losses(decoded, recorded, mask, joints, scene_deltas(scene), scene_deltas(scene))
        sum(losses.values()).backward()
        slopes.append(decoded.grad)
    assert torch.equal(*slopes) and slopes[0][mask].any() and not slopes[0][~mask].any()
