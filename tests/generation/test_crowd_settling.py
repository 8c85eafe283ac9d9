"""Moments in which two people of a crowd are in each other."""

import torch

from magnet.bench.speed import standing
from magnet.body.contact import deepest
from magnet.generation.crowd_settling import bonded_groups, deep_moments, settled_groups, settled_moments
from magnet.generation.settling import settled_chunk
from magnet.motion.scene import Scene, cat_time

FRAMES = 90


def passing() -> Scene:
    """Five people; the second walks through the first at 2 m/s, the others stand by."""
    scene = standing(1, FRAMES, 5, torch.device("cpu"))
    root = scene.T_world_root.clone()
    places = torch.tensor([[0.0, 0.0], [0.0, 0.12], [0.0, 1.5], [4.0, 0.0], [0.0, -4.0]])
    root[..., :3, 3] = torch.stack([places[:, 0], torch.full((5,), 0.95), places[:, 1]], dim=-1)
    root[:, :, 1, 0, 3] = torch.linspace(-3.0, 3.0, FRAMES)
    return scene.replace(T_world_root=root)


def depth(scene: Scene) -> float:
    from magnet.body import load_body

    joints = load_body().joints(scene)[0]
    return float(deepest(joints[:, 0], joints[:, 1])[:, 0].max())


def test_who_walks_through_somebody_goes_around_them_and_nobody_else_moves() -> None:
    scene = passing()
    made = settled_moments(scene)
    assert depth(scene) > 0.10 and depth(made) < 0.05
    assert torch.equal(made.T_world_root[:, :, 2:], scene.T_world_root[:, :, 2:])
    assert torch.equal(made.T_world_root[:, [0, -1]], scene.T_world_root[:, [0, -1]]), (
        "before and after they go as they went"
    )
    step = (made.T_world_root - scene.T_world_root)[..., :3, 3].diff(dim=1).norm(dim=-1)
    assert step.max() < 0.02, "metres a frame"


def test_who_is_given_does_not_make_way() -> None:
    given = torch.zeros(1, FRAMES, 5, dtype=torch.bool)
    given[..., 0] = True
    scene = passing().replace(given=given)
    made = settled_moments(scene)
    assert torch.equal(made.body_rot[:, :, 0], scene.body_rot[:, :, 0]) and depth(made) < depth(scene)


def test_free_slots_take_nobodys_place_beside_two_who_meet() -> None:
    """They hold nobody at the origin, where two pass each other, in front of a third whom they must not step into."""
    scene = passing()
    crowd = scene.pad_agents(12)
    made, among = settled_moments(scene), settled_moments(crowd)
    assert torch.equal(among.T_world_root[:, :, :5], made.T_world_root)
    assert torch.equal(among.T_world_root[:, :, 5:], crowd.T_world_root[:, :, 5:])


def test_a_crowd_that_keeps_apart_is_left_as_it_is() -> None:
    scene = passing().permute_agents(torch.tensor([0, 2, 3, 4]))
    assert settled_moments(scene) is scene


def test_a_moment_is_found_with_its_frames() -> None:
    from magnet.body import load_body

    scene = passing()
    (moment,) = deep_moments(load_body().joints(scene)[0], scene.present[0])
    assert (moment.one, moment.other) == (0, 1) and moment.start < FRAMES / 2 < moment.stop < FRAMES - 10


def test_those_whom_bonds_join_are_a_group_and_too_many_are_each_alone() -> None:
    bonds = torch.zeros(7, 7, dtype=torch.bool)
    for one, other in ((0, 3), (3, 5), (1, 6)):
        bonds[one, other] = bonds[other, one] = True
    present = torch.arange(7) != 2
    assert bonded_groups(bonds, present, 3) == [(0, 3, 5), (1, 6), (4,)]
    assert bonded_groups(bonds, present, 2) == [(0,), (3,), (5,), (1, 6), (4,)]


def test_a_pair_in_a_crowd_is_corrected_as_it_is_alone() -> None:
    """In two chunks; whom nobody belongs to is corrected alone, what is given stays."""
    given = torch.zeros(1, FRAMES, 5, dtype=torch.bool)
    given[:, :8] = True
    scene = passing()
    root = scene.T_world_root.clone()
    root[:, :, 3, 1, 3] += torch.linspace(0, 0.06, FRAMES)  # rises off the floor
    scene = scene.replace(T_world_root=root, given=given)
    past, parts = {}, []
    for part in (scene.slice(0, 40), scene.slice(40)):
        made, past = settled_groups(part, [(0, 2), (1,), (3,)], "firm", past)
        parts.append(made)
    made = cat_time(parts)
    assert torch.equal(made.T_world_root[:, :8], scene.T_world_root[:, :8]) and torch.equal(made.given, given)
    assert torch.equal(made.body_rot[:, :, 4], scene.body_rot[:, :, 4]), "in no group"
    pair, alone, before = scene.permute_agents(torch.tensor([0, 2])), [], None
    for part, still in ((pair.slice(0, 40), given[0, :40, :2]), (pair.slice(40), given[0, 40:, :2])):
        one, before = settled_chunk(part.replace(given=None), still, "firm", before)
        alone.append(one)
    torch.testing.assert_close(made.T_world_root[:, :, [0, 2]], cat_time(alone).T_world_root)
    torch.testing.assert_close(made.body_rot[:, :, [0, 2]], cat_time(alone).body_rot)
    assert made.T_world_root[0, -1, 3, 1, 3] < scene.T_world_root[0, -1, 3, 1, 3] - 0.02, "back on the floor"
