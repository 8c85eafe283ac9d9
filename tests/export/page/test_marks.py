"""Marks say what the metrics measure, and a page holds them."""

import itertools

import numpy as np
import pytest
import torch

from magnet.body import Body
from magnet.body.contact import WITHIN, deepest, hand_distance, penetration_depth, toe_steps
from magnet.body.energy import hand_points
from magnet.export.page.marks import (
    AT_ONCE,
    DEPTH,
    MOST,
    SLIDING,
    TOUCHING,
    depth_colours,
    marked,
    penetrations,
    standing,
    touching,
)
from magnet.export.page.palette import COLLIDES, SLIDES
from magnet.motion.scene import Scene
from magnet.testing import random_scene


@pytest.fixture
def embrace(duet: Scene) -> Scene:
    """The second person stands 10 cm beside the first."""
    near = duet.T_world_root.clone()
    near[:, :, 1, :3, 3] = near[:, :, 0, :3, 3] + torch.tensor([0.1, 0.0, 0.0])
    return duet.replace(T_world_root=near)


def test_standing_and_sliding_are_those_of_the_metric(duet: Scene, body: Body) -> None:
    joints = body.joints(duet)[0]
    joints = joints - joints[..., [10, 11], 1].min() * torch.tensor([0.0, 1.0, 0.0])  # onto the floor
    speed, stands = toe_steps(joints)
    low, slides = standing(joints.numpy(), 30.0)
    assert (low == stands.numpy()).all() and (slides == (stands & (speed > 0.05)).numpy()).all()
    assert stands.any()


def test_hands_touch_only_between_people_and_each_pair_counts_once() -> None:
    joints = np.zeros((2, 3, 22, 3))
    joints[..., 0] = np.arange(3)[:, None] * 5.0
    joints[1, 0, 18:22] = [1.0, 1.0, 0.0]  # elbows in the wrists, so that hands are there too; own ones do not count
    joints[1, 1, [18, 20]] = [1.1, 1.0, 0.0]
    frames, places = touching(joints)
    np.testing.assert_allclose(places, [[1.05, 1.0, 0.0]] * 2)
    assert frames.tolist() == [1, 1]


def test_collisions_are_as_deep_as_the_metric_says_and_lie_in_both_bodies(embrace: Scene, body: Body) -> None:
    joints = body.joints(embrace)[0]
    frames, places, radii, depths = penetrations(joints.numpy())
    for t, now in enumerate(joints):
        truth = sum(penetration_depth(now[[p]], now[[q]]) for p, q in itertools.combinations(range(2), 2))
        assert (frames == t).sum() == int((truth > 0).sum()) > 0
        assert depths[frames == t].max() == truth.max().item()
        for place, radius in zip(places[frames == t], radii[frames == t], strict=True):
            for person in now.numpy():
                assert np.linalg.norm(person - place, axis=1).min() < radius + 0.35


def test_collisions_of_a_long_motion_are_those_of_its_frames(embrace: Scene, body: Body) -> None:
    joints = body.joints(embrace)[0].numpy()
    times = AT_ONCE // len(joints) + 2  # more than are looked at together
    frames, *found = penetrations(joints)
    longer, *again = penetrations(np.concatenate([joints] * times))
    assert (longer == np.concatenate([frames + k * len(joints) for k in range(times)])).all()
    for once, often in zip(found, again, strict=True):
        np.testing.assert_allclose(often, np.concatenate([once] * times), atol=1e-6)


def test_one_person_alone_collides_with_nobody(duet: Scene, body: Body) -> None:
    joints = body.joints(duet)[0, :, :1].numpy()
    assert len(penetrations(joints)[3]) == 0
    assert len(touching(joints)[0]) == 0


def test_the_deeper_a_collision_the_redder_its_mark() -> None:
    colours = depth_colours(np.array([0.05, 0.075, 0.10, 0.30]))
    assert colours[0].tolist() == list(SLIDES) and colours[2].tolist() == colours[3].tolist() == list(COLLIDES)
    assert np.allclose(colours[1], (colours[0] + colours[2]) / 2)


def test_a_page_marks_each_frame_as_deep_as_the_metric_says_in_the_take_that_it_is_of(
    duet: Scene, embrace: Scene, body: Body
) -> None:
    apart = duet.T_world_root.clone()
    apart[:, :, 1, :3, 3] = apart[:, :, 0, :3, 3] + torch.tensor([9.0, 0.0, 0.0])
    alone = duet.replace(T_world_root=apart)
    shift = np.array([3.0, 0.0, -2.0])
    arrays = marked(body, [alone, embrace], [np.zeros(3), shift])
    frames, places, (take, kind, _, depth) = arrays["mark_frames"], arrays["mark_places"], arrays["mark_facts"].T
    assert (np.diff(frames.astype(int)) >= 0).all()
    assert set(take[kind == DEPTH]) == {1} and set(take[kind == TOUCHING]) <= {1}
    joints = body.joints(embrace)[0]
    truth = deepest(joints[:, 0], joints[:, 1])[:, 0].numpy()
    for t in range(embrace.frames):
        here = (frames == t) & (kind == DEPTH)
        assert 0 < here.sum() <= MOST
        assert depth[here].max() == pytest.approx(1000 * truth[t], abs=0.51)
    for t, place in zip(frames[kind == TOUCHING], places[kind == TOUCHING], strict=True):
        hands = hand_points(joints[t]).reshape(-1, 3).numpy() + shift
        assert np.sort(np.linalg.norm(hands - place, axis=1))[1] < WITHIN / 2 + 1e-5
    contact = hand_distance(joints[:, 0], joints[:, 1]) < WITHIN
    assert set(frames[kind == TOUCHING]) == set(contact.nonzero()[:, 0].tolist())


def test_a_page_marks_feet_where_they_slide_and_stand_nowhere_else(duet: Scene, body: Body) -> None:
    root = duet.T_world_root[:, :1].expand_as(duet.T_world_root).clone()
    root[..., 0, 3] += 0.01 * torch.arange(duet.frames)[:, None]  # 30 cm/s
    still = duet.replace(body_rot=duet.body_rot[:, :1].expand_as(duet.body_rot), T_world_root=root)
    lowest = body.joints(still)[0, 0, :, [10, 11], 1].min()
    root[..., 1, 3] -= lowest
    arrays = marked(body, [still.replace(T_world_root=root)], [np.zeros(3)])
    sliding = arrays["mark_facts"][:, 1] == SLIDING
    feet = body.joints(still.replace(T_world_root=root))[0, :, :, [10, 11]]
    low = (feet[..., 1] < 0.05).any(dim=0).numpy()
    assert sliding.sum() == (duet.frames - 1) * low.sum() > 0
    assert (arrays["mark_places"][sliding, 1] == 0).all()
    assert sorted(set(arrays["mark_frames"][sliding])) == list(range(1, duet.frames))


def test_crowds_have_no_marks(body: Body) -> None:
    crowd = random_scene(1, 4, 9, torch.Generator().manual_seed(3))
    together = crowd.replace(T_world_root=crowd.T_world_root[:, :, :1].expand_as(crowd.T_world_root))
    assert not len(marked(body, [together], [np.zeros(3)])["mark_frames"])
