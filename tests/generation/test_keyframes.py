"""Goals and keyframes: where they lie, what they hold, how fast they are reached."""

from __future__ import annotations

import math

import pytest
import torch

from magnet.body import load_body
from magnet.generation.keyframes import (
    Goal,
    Keyframe,
    keyframe,
    limb_places,
    pace,
    reached,
    require_soon,
    speeds,
    with_keyframes,
    with_limb,
)
from magnet.motion.frames import canonical_frame, from_planar
from magnet.motion.scene import Scene
from magnet.testing import random_scene


@pytest.fixture
def duet(generator: torch.Generator) -> Scene:
    return random_scene(1, 38, 2, generator)


def test_a_goal_is_a_place_on_the_floor_and_a_heading_in_which_zero_looks_along_z() -> None:
    T_world_can = Goal(2.0, -3.0, math.pi / 2).frame()
    assert T_world_can[:3, 3].tolist() == [2.0, 0.0, -3.0]
    torch.testing.assert_close(T_world_can[:3, 2], torch.tensor([1.0, 0.0, 0.0]), atol=1e-6, rtol=0)  # now along x
    back = Goal.of(T_world_can)
    assert (back.x, back.z, back.heading) == pytest.approx((2.0, -3.0, math.pi / 2))


@pytest.mark.parametrize("frame", [0, 13, 37])
def test_a_keyframe_of_its_own_frame_is_the_motion_of_the_token_that_holds_it(frame: int, duet: Scene) -> None:
    key = keyframe(duet, 1, frame)
    frames = torch.arange(frame // 4 * 4, frame // 4 * 4 + 4).clamp(max=37)  # the last token is cut: its end is held
    assert (key.agent, key.frame) == (1, frame // 4 * 4)
    assert torch.equal(key.body_rot, duet.body_rot[0, frames, 1])
    torch.testing.assert_close(key.T_world_root(), duet.T_world_root[0, frames, 1], atol=1e-5, rtol=0)


@pytest.mark.parametrize("held", [False, True])
def test_a_pose_from_elsewhere_is_brought_to_the_place_and_heading_of_its_frame(held: bool, duet: Scene) -> None:
    key = keyframe(duet, 0, 24, pose=10, held=held)
    frames = torch.tensor([10] * 4 if held else [10, 11, 12, 13])
    assert key.frame == 24 and torch.equal(key.body_rot, duet.body_rot[0, frames, 0])
    there = canonical_frame(duet.T_world_root[0])[:, 0]
    torch.testing.assert_close(canonical_frame(key.T_world_root()[:1, None])[0, 0], there[24], atol=1e-5, rtol=0)
    moved = torch.linalg.solve(there[10], duet.T_world_root[0, frames, 0])
    torch.testing.assert_close(torch.linalg.solve(there[24], key.T_world_root()), moved, atol=1e-4, rtol=0)


def test_behind_the_end_a_keyframe_stands_where_the_scene_ends(duet: Scene) -> None:
    key = keyframe(duet, 0, 100, pose=20)
    there = canonical_frame(duet.T_world_root[0])[37, 0]
    assert key.frame == 100
    torch.testing.assert_close(key.goal.frame(), there, atol=1e-5, rtol=0)


def test_keyframes_of_nobody_and_of_no_frame_are_refused(duet: Scene) -> None:
    for agent in (-1, 2):
        with pytest.raises(ValueError, match=rf"person {agent + 1} is not there: the scene has 2"):
            keyframe(duet, agent, 0)
    for frame, pose in ((-1, 0), (0, -1), (0, 38), (40, None)):
        with pytest.raises(ValueError, match="the scene has frames 0 to 37"):
            keyframe(duet, 0, frame, pose)


def test_a_keyframe_lies_five_minutes_behind_the_end_at_most() -> None:
    require_soon(9000 + 38, 38)
    for frame in (9001 + 38, math.inf, math.nan):
        with pytest.raises(ValueError, match="it lies at frame 9038 or earlier, 9000 after the end of the scene"):
            require_soon(frame, 38)


def test_a_limb_is_brought_to_a_place_and_moves_from_there_as_it_did(duet: Scene) -> None:
    body, key = load_body(), keyframe(duet, 1, 8)
    betas = duet.betas[0, 1]
    before = limb_places(key, "left hand", body, betas)
    place = before[0] + torch.tensor([0.03, -0.02, 0.02])
    after = limb_places(with_limb(key, "left hand", place, body, betas), "left hand", body, betas)
    torch.testing.assert_close(after[0], place, atol=0.02, rtol=0)
    torch.testing.assert_close(after - after[:1], before - before[:1], atol=0.02, rtol=0)
    joints = body.joints(duet)[0, 8:12, 1]
    torch.testing.assert_close(before, joints[:, 20], atol=1e-4, rtol=0)


def test_people_are_as_their_keyframes_say_and_only_they_are_given_there(duet: Scene) -> None:
    given = torch.zeros(1, 38, 2, dtype=torch.bool)
    given[0, :4, 0] = True
    key = keyframe(duet, 1, 16, pose=3)
    for told in (None, given):
        made = with_keyframes(duet.replace(given=told), [key])
        expected = torch.zeros_like(given) if told is None else told.clone()
        expected[0, 16:20, 1] = True
        assert torch.equal(made.given, expected)
        assert torch.equal(made.body_rot[0, 16:20, 1], key.body_rot)
        torch.testing.assert_close(made.T_world_root[0, 16:20, 1], key.T_world_root())
        elsewhere = ~expected if told is None else ~expected | told
        assert torch.equal(made.T_world_root[elsewhere], duet.T_world_root[elsewhere])
    assert not given[0, 16:20].any(), "what was given stays as it was"


@pytest.mark.parametrize(
    ("x", "z", "seconds", "gone"), [(3.0, 4.0, 1.0, 1.6), (3.0, 4.0, 9.0, 5.0), (0.0, 0.0, 1.0, 0.0)]
)
def test_a_goal_is_gone_to_at_a_metre_and_sixty_a_second_and_no_farther_than_it(x, z, seconds, gone) -> None:
    start = from_planar(torch.tensor(0.3), torch.tensor([1.0, -2.0]))
    goal = reached(start, Goal(1.0 + x, -2.0 + z, 2.0), seconds)
    assert math.hypot(goal.x - 1.0, goal.z + 2.0) == pytest.approx(gone, abs=1e-6)
    assert (goal.x - 1.0) * z == pytest.approx((goal.z + 2.0) * x, abs=1e-6)
    assert goal.heading == 2.0, "who stands turns there"


def at(agent: int, frame: int, x: float, z: float) -> Keyframe:
    return Keyframe(agent, frame, Goal(x, z, 0.0), torch.zeros(4, 21, 3, 3), torch.zeros(4, 4, 4))


def test_each_keyframe_is_as_fast_as_its_way_from_the_one_before_of_the_same_person(duet: Scene) -> None:
    (x, z), fps = duet.T_world_root[0, 8, 0, [0, 2], 3].tolist(), 60.0
    keys = [at(0, 68, x + 3, z), at(0, 38, x, z + 4), at(1, 44, 0.0, 0.0)]  # in no order
    found = speeds(keys, duet.replace(fps=fps), 8)
    assert found[0, 38] == pytest.approx(4 / 0.5) and found[0, 68] == pytest.approx(5 / 0.5)
    own = math.hypot(*duet.T_world_root[0, 8, 1, [0, 2], 3].tolist())
    assert found[1, 44] == pytest.approx(own / 0.6)
    assert math.isfinite(speeds([at(0, 8, x, z + 1)], duet, 8)[0, 8]), "at once"


def test_above_three_metres_a_second_a_keyframe_is_too_far() -> None:
    assert pace(2.9) == "2.9 m/s from the one before" and pace(3.1) == "3.1 m/s from the one before: too far"
