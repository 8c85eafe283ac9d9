"""Scenes that are put right: what was wrong is gone, what was right is still there."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from magnet.body import load_body
from magnet.body.contact import deepest
from magnet.body.drift import drift, undrifted
from magnet.body.energy import hand_points
from magnet.body.fit import clearance
from magnet.body.joints import FEET, SPINE3, TOES
from magnet.body.repair import grounded, pressed, repaired
from magnet.body.settle import DOFS, corrected, correction, jacobian
from magnet.body.settle_options import Settle
from magnet.body.settle_residuals import Seen
from magnet.body.settle_wishes import Wishes
from magnet.metrics import hand_distance
from magnet.motion.frames import rigid
from magnet.motion.rotations import from_rotvec
from magnet.motion.scene import Scene, cat_time, concatenate
from magnet.synthesis import synthesize
from tests.cases import some_slow

BODY = load_body()


@pytest.fixture(scope="module")
def handshake() -> Scene:
    return synthesize("handshake", 2, 150, torch.Generator().manual_seed(1), BODY).scene.slice(30, 120)


def moved(scene: Scene, agent: int, shift: Tensor) -> Scene:
    """One person moved by (T, 3) metres."""
    T_world_root = scene.T_world_root.clone()
    T_world_root[0, :, agent, :3, 3] += shift
    return scene.replace(T_world_root=T_world_root)


def arms_out(apart: float, before: float, frames: int = 30) -> Scene:
    """Two who stand side by side with their arms stretched out into each other, metres apart along x and z."""
    betas, eye = torch.zeros(1, 2, 10), torch.eye(3)
    floor = float(clearance(BODY, betas[0])[0, 2] - BODY.rest_joints(betas[0, 0])[TOES[0], 1])
    place = torch.tensor([[0.0, floor, 0.0], [apart, floor, before]]).expand(1, frames, 2, 3)
    T_world_root = rigid(eye.expand(1, frames, 2, 3, 3), place)
    return Scene(eye.repeat(1, frames, 2, 21, 1, 1), T_world_root, betas, torch.ones(1, 2, dtype=torch.bool))


def depths(scene: Scene) -> Tensor:
    """How deep the first two people are in each other, as measured. -> (T,) metres"""
    joints = BODY.joints(scene)[0]
    return deepest(joints[:, 0], joints[:, 1])[:, 0]


def speed_of_low_toes(scene: Scene, agent: int) -> float:
    toes = BODY.joints(scene)[0, :, agent][:, TOES]
    low = (toes[1:, :, 1] < 0.05) & (toes[:-1, :, 1] < 0.05)
    return float(scene.fps * toes[..., [0, 2]].diff(dim=0).norm(dim=-1)[low].median())


def test_the_slopes_of_points_are_those_of_finite_differences(handshake: Scene) -> None:
    scene, generator = handshake.slice(40, 41), torch.Generator().manual_seed(0)
    offset = torch.zeros(1, 1, 2, DOFS, dtype=torch.float64)
    double = scene.replace(**{k: v.double() for k, v in scene.tensors().items() if v.dtype == torch.float32})
    R_world, joints = BODY.bone_chain(double.body_rot, double.T_world_root, BODY.rest_joints(double.betas[:, None]))
    seen = Seen(R_world.flatten(0, 2), joints.flatten(0, 2), joints[..., None], joints)
    along = torch.nn.functional.normalize(torch.randn(22, 3, generator=generator, dtype=torch.float64), dim=-1)
    node, bone = torch.ones(22, dtype=torch.long), torch.arange(22)
    slopes = jacobian(seen, node, bone, joints[0, 0, 1], along)
    for number in range(DOFS):
        ahead = offset.clone()
        ahead[0, 0, 1, number] = 1e-5
        change = (BODY.joints(corrected(double, ahead)) - joints)[0, 0, 1] / 1e-5
        torch.testing.assert_close(slopes[:, number], (change * along).sum(dim=-1), atol=1e-4, rtol=0)


def test_what_is_right_is_let_be(handshake: Scene) -> None:
    """No correction where there is nothing to correct: it costs more than it gives."""
    once = repaired(handshake, BODY)
    assert float((BODY.joints(once) - BODY.joints(handshake)).norm(dim=-1).mean()) < 0.012


@pytest.mark.parametrize(
    ("apart", "before"), some_slow([(0.55, 0.0), (0.7, 0.05), (1.1, 0.02)], (0.55, 0.0), (0.7, 0.05))
)
def test_depth_that_is_measured_is_corrected_and_does_not_come_back_with_the_next_step(
    apart: float, before: float
) -> None:
    """Also of arms along one line, whose axes do not tell the way out."""
    scene = arms_out(apart, before)
    assert float(depths(scene).max()) > 0.06
    for iterations in (11, 12):
        assert float(depths(repaired(scene, BODY, settle=Settle(iterations=iterations))).max()) < 0.055


@pytest.mark.parametrize("height", some_slow([0.05, 0.15], 0.05))
def test_whoever_floats_comes_down_and_whoever_jumps_does_not(handshake: Scene, height: float) -> None:
    T = handshake.frames
    up = torch.zeros(T, 3)
    up[20:70, 1] = height
    foot = BODY.joints(repaired(moved(handshake, 1, up), BODY))[0, :, 1][:, FEET, 1].amin(dim=-1)
    real = BODY.joints(handshake)[0, :, 1][:, FEET, 1].amin(dim=-1)
    assert float((foot - real)[25:65].abs().max()) < 0.02
    time = (torch.arange(T) - 40) / 30.0
    jump = torch.zeros(T, 3)
    jump[:, 1] = (0.2 - 0.5 * 9.81 * time**2).clamp_min(0)
    made = repaired(moved(handshake, 1, jump), BODY, slides=0.0)
    assert float((made.T_world_root - moved(handshake, 1, jump).T_world_root)[0, 36:45, 1, 1, 3].abs().max()) < 0.03


@pytest.mark.parametrize("height", [3.0, -2.5])
def test_whoever_is_far_from_the_floor_all_the_time_is_moved_to_it(handshake: Scene, height: float) -> None:
    """Also by more than the steps of a correction come to."""
    scene = moved(handshake, 1, torch.tensor([0.0, height, 0.0]))
    kept = torch.tensor([False, True])
    assert torch.equal(grounded(scene, BODY, kept).T_world_root, scene.T_world_root)
    assert torch.equal(grounded(handshake, BODY).T_world_root, handshake.T_world_root)
    low = scene.slice(0, 40)
    made = repaired(low, BODY)
    assert torch.equal(grounded(scene, BODY).T_world_root[:, :, 0], scene.T_world_root[:, :, 0])
    feet = BODY.joints(made)[0][..., FEET, 1].amin(dim=-1)
    real = BODY.joints(handshake.slice(0, 40))[0][..., FEET, 1].amin(dim=-1)
    assert float((feet - real).abs().max()) < 0.03


def test_a_short_jump_is_not_taken_for_somebody_far_from_the_floor(handshake: Scene) -> None:
    scene = moved(handshake, 1, torch.tensor([0.0, 0.5, 0.0])).slice(0, 12)
    assert torch.equal(grounded(scene, BODY).T_world_root, scene.T_world_root)
    fast = scene.frames_at(torch.arange(48) // 4).replace(fps=120.0)
    assert torch.equal(grounded(fast, BODY).T_world_root, fast.T_world_root)


def test_a_scene_of_nobody_or_of_no_frames_comes_back(handshake: Scene) -> None:
    for scene in (handshake.slice(0, 0), handshake.permute_agents(torch.tensor([], dtype=torch.long))):
        assert repaired(scene, BODY) is scene


def test_whoever_slides_stands_and_holds_again(handshake: Scene) -> None:
    slide = torch.zeros(handshake.frames, 3)
    slide[:, 2] = 0.3 * torch.arange(handshake.frames) / 30.0
    damaged = moved(handshake, 0, slide)
    assert speed_of_low_toes(damaged, 0) > 0.2
    assert speed_of_low_toes(repaired(damaged, BODY), 0) < 0.06
    wishes = Wishes.of(damaged, BODY)
    assert float(drift(BODY.joints(damaged), wishes.stands, 30.0)[0, 20:70, 0, 1].mean()) == pytest.approx(
        0.3, abs=0.05
    )
    whole = undrifted(damaged, BODY, fixed=torch.tensor([True, False]))
    assert torch.equal(whole.T_world_root[:, :, 0], damaged.T_world_root[:, :, 0])


def test_feet_that_glide_under_a_swaying_body_stand_and_the_body_sways_on() -> None:
    """Heels as well as toes, from a frame to the next and over a third of a second."""
    time = torch.arange(90) / 30.0
    sway = torch.zeros(90, 3)
    sway[:, 0], sway[:, 2] = 0.03 * (5.0 * time).sin(), 0.02 * (3.0 * time).cos()
    swaying = moved(arms_out(3.0, 0.0, 90), 0, sway)
    made = BODY.joints(repaired(swaying, BODY, drifting=False))[0, :, 0][..., [0, 2]]
    feet, before = made[:, FEET], BODY.joints(swaying)[0, :, 0][:, FEET][..., [0, 2]]
    for frames in (1, 10):
        speed, was = ((each[frames:] - each[:-frames]).norm(dim=-1).median(dim=0).values for each in (feet, before))
        assert (speed < 0.25 * was).all(), (frames, speed / was)
    assert float(made[:, 12].std(dim=0).norm()) > 0.5 * float(sway[:, [0, 2]].std(dim=0).norm())  # the neck


def test_nobody_is_held_back_from_sliding_away_from_hands_that_they_hold(handshake: Scene) -> None:
    slide = torch.zeros(handshake.frames, 3)
    slide[:, 2] = 0.3 * torch.arange(handshake.frames) / 30.0
    both = moved(moved(handshake, 0, slide), 1, slide)
    alone = undrifted(both, BODY, fixed=torch.tensor([False, True]))
    assert torch.equal(alone.T_world_root, both.T_world_root)
    together = undrifted(both, BODY)
    assert float((together.T_world_root - both.T_world_root)[0, -1, :, 2, 3].max()) < -0.5
    joints = BODY.joints(together)
    assert int((hand_distance(joints[:, :, 0], joints[:, :, 1]) < 0.2).sum()) > 30


def test_hands_that_hold_hold_on_while_bodies_leave_each_other(handshake: Scene) -> None:
    hands = [hand_points(BODY.joints(handshake)[0, :, agent]) for agent in range(2)]
    apart = (hands[0][:, :, None] - hands[1][:, None]).norm(dim=-1).amin(dim=(1, 2))
    holds = apart < 0.15
    assert int(holds.sum()) > 10
    up = torch.zeros(handshake.frames, 3)
    up[:, 1] = 0.12
    made = BODY.joints(repaired(moved(handshake, 0, up), BODY))
    hands = [hand_points(made[0, :, agent]) for agent in range(2)]
    assert float((hands[0][:, :, None] - hands[1][:, None]).norm(dim=-1).amin(dim=(1, 2))[holds].max()) < 0.2


def test_frames_that_are_not_valid_spoil_no_others(handshake: Scene) -> None:
    scene = concatenate([handshake.slice(0, 60), handshake.slice(20, 80)]).replace(names=("a", "b"))
    valid = torch.ones(2, 60, dtype=torch.bool)
    valid[0, :20] = valid[0, 40] = valid[1, 50:] = False
    away = scene.T_world_root.clone()
    away[~valid] = float("nan")
    made = repaired(scene.replace(T_world_root=away, valid=valid), BODY)
    assert torch.equal(made.T_world_root[~valid].isnan(), away[~valid].isnan())
    for b, stretch in ((0, slice(20, 40)), (0, slice(41, 60)), (1, slice(0, 50))):
        alone = repaired(scene.select([b]).slice(stretch.start, stretch.stop), BODY)
        torch.testing.assert_close(made.T_world_root[b, stretch], alone.T_world_root[0])
    assert made.names == scene.names and torch.equal(made.valid, valid)


def test_whoever_is_costly_to_lift_reaches_for_hands_and_stays_on_the_floor(handshake: Scene) -> None:
    """One of two who hold hands is drawn up with a raised hand; the other, who is free, is not lifted after it."""
    still = torch.tensor([True, False])
    scene, wishes, rises = moved(handshake, 0, torch.tensor([0.0, 0.25, 0.0])), Wishes.of(handshake, BODY), []
    for lift in (1.0, 10.0):
        offset = correction(scene, BODY, wishes, still, Settle(hold=4.0, lift=lift))
        rises.append(float(offset[0, :, 1, 1].abs().max()))
        apart = hand_distance(*BODY.joints(corrected(scene, offset)).unbind(dim=2))[0]
        assert float(apart[wishes.held[0].flatten(1).any(dim=1)].max()) < 0.2
    assert rises[1] < 0.75 * rises[0]


def test_fixed_people_and_frames_stay_bit_identical(handshake: Scene) -> None:
    pushed = moved(handshake, 1, torch.tensor([0.2, 0.1, 0.2]).expand(handshake.frames, 3))
    fixed = torch.zeros(handshake.frames, 2, dtype=torch.bool)
    fixed[:, 0], fixed[:30] = True, True
    made = repaired(pushed, BODY, fixed=fixed)
    for before, after in ((pushed.body_rot, made.body_rot), (pushed.T_world_root, made.T_world_root)):
        assert torch.equal(before[0][fixed], after[0][fixed]) and not torch.equal(before, after)


def test_a_correction_grows_from_nothing_where_the_past_stays(handshake: Scene) -> None:
    high = moved(handshake, 1, torch.tensor([0.0, 0.15, 0.0]).expand(handshake.frames, 3)).slice(20, 60)
    steps = {}
    for begun in (False, True):
        made = repaired(high, BODY, begun=begun, drifting=False)
        steps[begun] = float((made.T_world_root - high.T_world_root)[0, 0, 1, 1, 3].abs())
    assert steps[True] < 0.04 < 0.12 < steps[False]


@pytest.fixture
def two_threads() -> Iterator[None]:
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(1)


# More than 150 frames: torch's batched LU fails then (pytorch issue 142815).
@pytest.mark.parametrize(("frames", "iterations"), some_slow([(24, 1), (184, 2)], (184, 2)))
def test_long_batches_are_corrected_by_several_threads_as_by_one(
    frames: int, iterations: int, two_threads: None
) -> None:
    pushed = arms_out(0.3, 0.1, frames)
    several = repaired(pushed.repeat(4), BODY, settle=Settle(iterations=iterations))
    torch.set_num_threads(1)
    one = repaired(pushed, BODY, settle=Settle(iterations=iterations))
    assert float((one.T_world_root - pushed.T_world_root).abs().max()) > 0.01
    torch.testing.assert_close(several.T_world_root, one.T_world_root.expand(4, -1, -1, -1, -1), rtol=0, atol=1e-4)


def test_scenes_of_other_rates_are_corrected_as_smoothly(handshake: Scene) -> None:
    frames = torch.arange(0, handshake.frames, 0.25).floor().long().clamp(max=handshake.frames - 1)
    four = moved(handshake, 1, torch.tensor([0.0, 0.15, 0.0]).expand(handshake.frames, 3)).frames_at(frames)
    made = repaired(four.replace(fps=120.0), BODY)
    shift = (made.T_world_root - four.T_world_root)[0, :, 1, 1, 3]
    assert float(shift[40:300].mean()) == pytest.approx(-0.15, abs=0.03)
    assert max(abs(float(b - a)) for a, b in pairwise(shift)) < 0.01
    assert cat_time([four, four]).frames == 2 * four.frames


def swinging(frames: int) -> Scene:
    """Two who stand with an arm stretched out; one swings it through the other's within some frames in the middle."""
    scene, angle = arms_out(1.0, 0.3, frames), 0.2 + ((torch.arange(frames) - frames / 2) / 3 + 0.5).clamp(0, 1)
    body_rot = scene.body_rot.clone()
    body_rot[0, :, 1, SPINE3 - 1] = from_rotvec(angle[:, None] * torch.tensor([0.0, -1.0, 0.0]))
    return scene.replace(body_rot=body_rot)


def test_depth_that_a_correction_leaves_for_a_moment_is_corrected_again_around_it() -> None:
    """Limbs that cross within two or three frames weigh less than what is smooth."""
    scene = swinging(200)
    left = correction(scene, BODY, Wishes.of(scene, BODY), settle=Settle(hard=1e-4))
    assert float(depths(corrected(scene, left)).max()) > 0.065
    again = pressed(scene, BODY, left, "firm", None, None, 0.0)
    assert float(depths(corrected(scene, again)).max()) < 0.05
    assert torch.equal(again[:, :30], left[:, :30]) and torch.equal(again[:, -30:], left[:, -30:])
    kept = torch.tensor([True, True])
    assert pressed(scene, BODY, left, "firm", kept, None, 0.0) is left, "who does not move is not asked to"


def test_where_nothing_stays_deep_a_scene_is_corrected_once(handshake: Scene) -> None:
    once = repaired(handshake, BODY, settle=Settle())
    assert torch.equal(repaired(handshake, BODY).body_rot, once.body_rot)


def test_limbs_that_cross_between_the_frames_that_are_corrected_are_corrected_too() -> None:
    scene = swinging(100).replace(fps=120.0)
    assert float(depths(scene).max()) > 0.08 and not depths(scene)[::4].any()
    made = repaired(scene, BODY)
    assert float(depths(made).max()) < 0.05
    kept = repaired(scene, BODY, fixed=torch.tensor([True, False]))
    assert float(depths(kept).max()) < 0.05
    assert torch.equal(kept.body_rot[:, :, 0], scene.body_rot[:, :, 0])
    assert torch.equal(kept.T_world_root[:, :, 0], scene.T_world_root[:, :, 0])
