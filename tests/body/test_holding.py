"""Which hands hold over time."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from magnet.body import load_body
from magnet.body.energy import hand_points
from magnet.body.holding import GRIP, HELD, PARTED, holds, lasting_holds
from magnet.body.repair import repaired
from magnet.metrics import hand_distance
from magnet.motion.scene import Scene
from magnet.synthesis import synthesize
from magnet.testing import standing_people

BODY = load_body()
FPS = 30.0
THERE = torch.ones(1, 2, dtype=torch.bool)


def two_people(apart: Tensor) -> Tensor:
    """Joints of two people whose nearest hands, the first's left and the second's right, are so far apart. apart (T,)

    -> (1, T, 2, 22, 3)
    """
    joints = standing_people(frames=len(apart), agents=2).clone()
    hands = hand_points(joints)
    joints[:, :, 1] += (hands[:, :, 0, 0] - hands[:, :, 1, 1] + torch.tensor([10.0, 0.0, 0.0]))[:, :, None]
    away = torch.zeros(len(apart), 3)
    away[:, 0] = apart - 10.0
    joints[:, :, 1] += away[None, :, None]
    return joints


def near(*stretches: tuple[int, float]) -> Tensor:
    return torch.cat([torch.full((frames,), metres) for frames, metres in stretches])


def held_by(joints: Tensor, before: Tensor | None = None) -> Tensor:
    """Frames in which the first's left hand and the second's right hold."""
    return lasting_holds(joints, THERE, FPS, before)[0][0, :, 0, 0, 1]


def test_hands_that_met_hold_until_they_are_half_a_metre_apart() -> None:
    joints = two_people(near((20, 0.15), (20, 0.35), (20, PARTED + 0.1)))
    held = held_by(joints)
    assert held[:40].all() and not held[40:].any()
    assert int(holds(joints, THERE)[0].any(dim=(2, 3, 4)).sum()) == 20


def test_hands_that_pass_without_meeting_do_not_hold() -> None:
    assert not held_by(two_people(near((30, 0.35)))).any()


def test_who_held_before_holds_on() -> None:
    joints, before = two_people(near((8, 0.35))), torch.zeros(1, 1, 2, 2, dtype=torch.bool)
    assert not held_by(joints, before).any()
    before[0, 0, 0, 1] = True
    assert held_by(joints, before).all()


@pytest.mark.parametrize("frames, holds_on", [(6, True), (12, False)])
def test_a_short_break_is_none(frames: int, holds_on: bool) -> None:
    held = held_by(two_people(near((15, 0.15), (frames, 0.6), (15, 0.4))))
    assert bool(held[-10:].all()) == holds_on


def test_hands_are_drawn_together_and_nearer_ones_are_left_as_they_are() -> None:
    joints = two_people(near((30, 0.15), (30, 0.3)))
    _, between = lasting_holds(joints, THERE, FPS)
    wished = between.norm(dim=-1)[0, :, 0, 0, 1]
    assert torch.allclose(wished, torch.full_like(wished, GRIP), atol=1e-4)
    close = two_people(near((30, 0.06)))
    left = lasting_holds(close, THERE, FPS)[1].norm(dim=-1)[0, :, 0, 0, 1]
    assert torch.allclose(left, torch.full_like(left, 0.06), atol=1e-4)


def test_a_hold_begins_and_ends_smoothly() -> None:
    closer = torch.linspace(PARTED + 0.2, 0.15, 20)
    joints = two_people(torch.cat([closer, torch.full((30,), 0.15), closer.flip(0)]))
    wished = lasting_holds(joints, THERE, FPS)[1].norm(dim=-1)[0, :, 0, 0, 1]
    assert wished[30] == pytest.approx(GRIP, abs=1e-4)
    assert float(wished.diff().abs().max()) < 0.15  # metres a frame; without easing 0.5 at either end


def test_a_hand_holds_one_hand() -> None:
    joints = two_people(near((20, 0.15)))
    aside = torch.tensor([-0.31, 0.0, 0.0])  # a third, as near on the other side, and not near the second
    joints = torch.cat([joints, joints[:, :, 1:] + aside], dim=2)
    held, _ = lasting_holds(joints, torch.ones(1, 3, dtype=torch.bool), FPS)
    by_left_of_first = held[0, :, :2, 0].sum(dim=(1, 2))
    assert bool((by_left_of_first == 1).all())


@pytest.mark.parametrize("longer", [0, 1])
def test_of_two_whom_a_hand_could_hold_it_holds_who_is_longer_near(longer: int) -> None:
    """Three people; the last one's hand is near both others', one of whom comes ten frames later."""
    joints = standing_people(frames=30, agents=3).clone()
    hands = hand_points(joints)
    for p, offset in ((0, 0.15), (1, -0.15)):
        joints[:, :, p] += (hands[:, :, 2, 1] - hands[:, :, p, 0] + torch.tensor([offset, 0.0, 0.0]))[:, :, None]
    joints[:, :10, 1 - longer] += 10.0
    held = lasting_holds(joints, torch.ones(1, 3, dtype=torch.bool), FPS)[0][0, :, 1:, 0, 1]  # the last one's right
    assert held[:, longer].all() and not held[:, 1 - longer].any()


@pytest.mark.parametrize(
    ("first", "second", "who"),
    [
        (near((30, 0.19)), near((12, 0.05), (18, 9.0)), 0),  # longer, and less near
        (near((30, 0.19)), near((30, 0.05)), 1),  # as long, and nearer
        (near((12, 0.19), (5, 9.0), (13, 0.19)), near((12, 0.05), (18, 9.0)), 0),  # far off in a short break
    ],
)
def test_a_hand_holds_who_is_near_for_long_and_short_breaks_cost_nothing(
    first: Tensor, second: Tensor, who: int
) -> None:
    joints = standing_people(frames=30, agents=3).clone()
    hands = hand_points(joints)
    for p, offset in ((0, first), (1, -second)):
        aside = torch.stack([offset, torch.zeros(30), torch.zeros(30)], dim=-1)
        joints[:, :, p] += (hands[:, :, 2, 1] - hands[:, :, p, 0] + aside)[:, :, None]
    held = lasting_holds(joints, torch.ones(1, 3, dtype=torch.bool), FPS)[0][0, :, 1:, 0, 1]  # the last one's right
    assert held[:12, who].all() and not held[:12, 1 - who].any()


def test_nobody_holds_who_is_not_there() -> None:
    joints = two_people(near((20, 0.1)))
    assert not lasting_holds(joints, torch.tensor([[True, False]]), FPS)[0].any()
    alone, between = lasting_holds(joints[:, :, :1], torch.ones(1, 1, dtype=torch.bool), FPS)
    assert alone.shape == (1, 20, 0, 2, 2) and between.shape == (1, 20, 0, 2, 2, 3)


@pytest.fixture(scope="module")
def parting() -> Scene:
    """Two who shake hands, of whom one is then 25 cm further away."""
    scene = synthesize("handshake", 2, 150, torch.Generator().manual_seed(1), BODY).scene.slice(30, 120)
    T_world_root = scene.T_world_root.clone()
    away = (T_world_root[:, :1, 1, :3, 3] - T_world_root[:, :1, 0, :3, 3]) * torch.tensor([1.0, 0.0, 1.0])
    late = torch.linspace(-1, 2, scene.frames).clamp(0, 1)[None, :, None]
    T_world_root[:, :, 1, :3, 3] += 0.25 * late * away / away.norm(dim=-1, keepdim=True)
    return scene.replace(T_world_root=T_world_root)


def frames_together(scene: Scene) -> int:
    joints = BODY.joints(scene)
    return int((hand_distance(joints[:, :, 0], joints[:, :, 1]) < HELD).sum())


def test_hold_brings_hands_together_again_and_firm_does_not(parting: Scene) -> None:
    kept = [repaired(parting, BODY, how, drifting=False) for how in ("firm", "hold")]
    before, firm, hold = (frames_together(scene) for scene in (parting, *kept))
    assert abs(firm - before) <= 3
    assert hold > before + 10


def test_who_is_fixed_stays_and_the_other_reaches(parting: Scene) -> None:
    made = repaired(parting, BODY, "hold", torch.tensor([True, False]), drifting=False)
    assert torch.equal(made.body_rot[:, :, 0], parting.body_rot[:, :, 0])
    assert torch.equal(made.T_world_root[:, :, 0], parting.T_world_root[:, :, 0])
    assert frames_together(made) > frames_together(parting) + 10


def test_hands_take_hold_from_the_distance_that_is_said() -> None:
    joints = two_people(near((10, 0.28)))
    assert not lasting_holds(joints, THERE, FPS)[0].any()
    held, between = lasting_holds(joints, THERE, FPS, takes=0.3)
    assert held[0, :, 0, 0, 1].all()
    assert float(between.norm(dim=-1)[0, 5, 0, 0, 1]) == pytest.approx(GRIP, abs=0.01)
