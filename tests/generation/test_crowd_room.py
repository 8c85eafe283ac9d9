"""Strangers in a crowd who walk keep some room."""

import torch

from magnet.generation.crowd_room import SHARE, room_made
from magnet.motion.frames import from_planar

FRAMES = 60


def walked(places: list[list[float]], speeds: list[list[float]]) -> torch.Tensor:
    """People who walk straight on, at metres a second. -> (1, T, P, 4, 4)"""
    time = torch.arange(FRAMES)[:, None, None] / 30
    ground = torch.tensor(places) + time * torch.tensor(speeds)
    return from_planar(torch.zeros(ground.shape[:2]), ground)[None]


def ground(T_world_can: torch.Tensor) -> torch.Tensor:
    return T_world_can[0][..., [0, 2], 3]


def couples(people: int) -> torch.Tensor:
    pair = torch.arange(people) // 2
    return (pair[:, None] == pair) & ~torch.eye(people, dtype=torch.bool)


def test_who_walks_beside_a_stranger_leaves_it_by_a_share_of_the_way_and_who_stands_is_not_moved() -> None:
    alone, everybody = torch.zeros(3, 3, dtype=torch.bool), torch.ones(3, dtype=torch.bool)
    before = walked([[0.0, 0.0], [1.0, 0.0], [20.0, 0.0]], [[0.0, 0.3], [0.0, 0.0], [0.5, 0.0]])
    after = room_made(before, torch.ones(FRAMES, 3, dtype=torch.bool), alone, everybody)
    moved = ground(after) - ground(before)
    assert torch.equal(after[:, :, 1:], before[:, :, 1:]), "one stands, one is far from everybody"
    assert float(moved[-1, 0, 0]) < -0.05, "to the side on which nobody is"
    way = ground(before)[:, 0].diff(dim=0).norm(dim=-1)
    assert bool((moved[:, 0].diff(dim=0).norm(dim=-1) <= 1.01 * SHARE * way.max()).all())


def test_two_who_belong_together_step_aside_together() -> None:
    before = walked([[0.0, 0.0], [0.6, 0.0], [1.5, 0.0], [2.1, 0.0]], [[0.0, 0.4], [0.0, 0.2], [0.0, 0.3], [0.0, 0.3]])
    everybody, all_new = torch.ones(4, dtype=torch.bool), torch.ones(FRAMES, 4, dtype=torch.bool)
    moved = ground(room_made(before, all_new, couples(4), everybody)) - ground(before)
    torch.testing.assert_close(moved[:, 0], moved[:, 1])
    torch.testing.assert_close(moved[:, 2], moved[:, 3])
    assert moved[-1, 0, 0] < -0.02 and moved[-1, 2, 0] > 0.02


def test_what_is_not_new_stays_and_nobody_makes_room_for_who_is_not_there() -> None:
    before = walked([[0.0, 0.0], [1.0, 0.0]], [[0.0, 0.3], [0.0, 0.3]])
    alone, new = torch.zeros(2, 2, dtype=torch.bool), torch.ones(FRAMES, 2, dtype=torch.bool)
    new[:20] = False
    new[:, 1] = False
    after = room_made(before, new, alone, torch.ones(2, dtype=torch.bool))
    assert torch.equal(after[:, :20], before[:, :20]) and torch.equal(after[:, :, 1], before[:, :, 1])
    assert not torch.equal(after[:, 40:, 0], before[:, 40:, 0])
    assert torch.equal(room_made(before, new, alone, torch.tensor([True, False])), before)
