"""Marks say what the metrics measure."""

import itertools

import numpy as np
import torch

from magnet.body import Body
from magnet.export.page.palette import COLLIDES, SLIDES
from magnet.metrics.penetration import penetration_depth
from magnet.metrics.skating import toe_steps
from magnet.motion.scene import Scene
from magnet.viewer import scenery as marks
from magnet.viewer.scenery import Spots, ball


def test_standing_and_sliding_are_those_of_the_metric(duet: Scene, body: Body) -> None:
    joints = body.joints(duet)[0]
    joints = joints - joints[..., [10, 11], 1].min() * torch.tensor([0.0, 1.0, 0.0])  # onto the floor
    speed, stands = toe_steps(joints)
    for t in range(1, len(joints)):
        low, slides = marks.standing(joints[t - 1].numpy(), joints[t].numpy(), 30.0)
        assert (low == stands[t - 1].numpy()).all()
        assert (slides == (stands & (speed > 0.05))[t - 1].numpy()).all()
    assert stands.any()


def test_hands_touch_only_between_people_and_each_pair_counts_once() -> None:
    joints = np.zeros((3, 22, 3))
    joints[:, :, 0] = np.arange(3)[:, None] * 5.0
    joints[0, 20] = joints[0, 21] = [1.0, 1.0, 0.0]  # own hands do not count
    joints[1, 20] = [1.1, 1.0, 0.0]
    touching = marks.touching(joints)
    np.testing.assert_allclose(touching, [[1.05, 1.0, 0.0]] * 2)


def test_collisions_are_as_deep_as_the_metric_says_and_lie_in_both_bodies(duet: Scene, body: Body) -> None:
    near = duet.T_world_root.clone()
    near[:, :, 1, :3, 3] = near[:, :, 0, :3, 3] + torch.tensor([0.1, 0.0, 0.0])
    joints = body.joints(duet.replace(T_world_root=near))[0, 5]
    places, radii, depths = marks.penetrations(joints.numpy())
    truth = sum(penetration_depth(joints[[p]], joints[[q]]) for p, q in itertools.combinations(range(2), 2))
    assert len(depths) == int((truth > 0).sum()) > 0
    assert depths.max() == truth.max().item()
    for place, radius in zip(places, radii, strict=True):
        for person in joints.numpy():
            assert np.linalg.norm(person - place, axis=1).min() < radius + 0.35


def test_one_person_alone_collides_with_nobody(duet: Scene, body: Body) -> None:
    joints = body.joints(duet)[0, 0, :1].numpy()
    assert len(marks.penetrations(joints)[2]) == 0
    assert len(marks.touching(joints)) == 0


def test_marks_that_are_not_needed_are_too_small_to_be_seen(server) -> None:
    spots = Spots(server, "/spots", ball(1.0), 5, None)
    assert spots.batch.batched_scales.max() < 1e-5
    for shown in (3, 1, 0):
        spots.show(np.ones((shown, 3)), np.zeros(3), 0.5)
        assert (spots.batch.batched_scales[:shown] == 0.5).all() and spots.batch.batched_scales[shown:].max() < 1e-5


def test_the_deeper_a_collision_the_redder_its_mark():
    colours = marks.depth_colours(np.array([0.05, 0.075, 0.10, 0.30]))
    assert colours[0].tolist() == list(SLIDES) and colours[2].tolist() == colours[3].tolist() == list(COLLIDES)
    assert np.allclose(colours[1], (colours[0] + colours[2]) / 2)
