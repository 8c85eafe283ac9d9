"""The steps of a correction: solved at once they are what conjugate gradients come to, scene by scene."""

from __future__ import annotations

import math
import unittest.mock
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from magnet.bench.speed import standing
from magnet.body import load_body
from magnet.body.repair import settling
from magnet.body.settle import DOFS, SOLVED_AT_ONCE
from magnet.body.settle_options import Settle
from magnet.body.settle_residuals import Residuals
from magnet.body.settle_steps import TOGETHER, Ends, Smoothness, alike, exact_step, solve, stiffness
from magnet.generation.live_settling import SHOWN
from magnet.motion.frames import rigid
from magnet.motion.rotations import from_rotvec
from magnet.motion.scene import Scene, concatenate

BODY = load_body()
T, P = 8, 2
SETTLE = Settle(stay=2.0, speed=1.0, bend=25.0, root=6.0, lift=10.0, shrug=4.0)


def problem(scenes: int, seed: int = 0) -> tuple[Residuals, Tensor, Tensor, Smoothness, Tensor]:
    """Random residuals of two people who may move; in the last scene only one may, and not in the first frames.

    One scene has forty, several have from none to forty.
    """
    draw = torch.Generator().manual_seed(seed)
    count = torch.randint(0, 41, (scenes,), generator=draw) if scenes > 1 else torch.tensor([40])
    scene = torch.arange(scenes).repeat_interleave(count)[torch.randperm(int(count.sum()), generator=draw)]
    M = len(scene)
    node, other = (scene * T * P + torch.randint(0, T * P, (M,), generator=draw) for _ in range(2))
    point, along = torch.zeros(M, 3), torch.eye(3)[:1].expand(M, 3)
    value, weight = torch.randn(M, generator=draw) * 0.05, torch.rand(M, generator=draw) * 5 + 0.1
    one_sided = torch.rand(M, generator=draw) < 0.5
    residuals = Residuals(node, node * 0, point, other, node * 0, point, along, value, weight, torch.ones(M), one_sided)
    first, second = (torch.randn(M, DOFS, generator=draw) * weight[:, None] for _ in range(2))
    free = torch.ones(scenes, T, P, dtype=torch.bool)
    free[-1, :, 1] = False
    free[-1, :3] = False
    past = torch.randn(scenes, 2, P, DOFS, generator=draw) * 0.1 * free[:, :2, :, None]
    offset = torch.randn(scenes, T, P, DOFS, generator=draw) * 0.02 * free[..., None]
    return residuals, first, second, Smoothness(SETTLE, free, past, offset), offset


@pytest.mark.parametrize("scenes", [1, 3, 2 * TOGETHER + 1])
def test_a_step_solved_at_once_is_where_conjugate_gradients_end(scenes: int) -> None:
    residuals, first, second, smooth, offset = problem(scenes)
    exact = exact_step(residuals, first, second, smooth, offset)
    slow = solve(residuals, first, second, smooth, offset, 4000)
    assert float(slow.abs().max()) > 0.01
    assert torch.allclose(exact, slow, atol=2e-5)
    assert torch.equal(exact[-1, :, 1], torch.zeros_like(exact[-1, :, 1]))
    assert torch.equal(exact[-1, :3], torch.zeros_like(exact[-1, :3]))


def test_a_scene_s_step_does_not_depend_on_the_others() -> None:
    residuals, first, second, smooth, offset = problem(5)
    whole = exact_step(residuals, first, second, smooth, offset)
    for number in range(5):
        mine = residuals.node // (T * P) == number
        shift = number * T * P
        alone = residuals.kept(mine)
        node, other = alone.node - shift, alone.other - shift
        alone = Residuals(node, alone.bone, alone.point, other, *alone[4:])
        free = smooth.free[number : number + 1].diagonal(dim1=2, dim2=3).transpose(1, 2)
        past = None if smooth.past is None else smooth.past[number : number + 1]
        own = Smoothness(SETTLE, free, past, offset[number : number + 1])
        step = exact_step(alone, first[mine], second[mine], own, offset[number : number + 1])
        assert torch.allclose(step[0], whole[number], atol=1e-5)


def test_without_residuals_a_step_leads_where_corrections_cost_least() -> None:
    residuals, first, second, smooth, offset = problem(2)
    none = residuals.kept(slice(0))
    for step in (
        exact_step(none, first[:0], second[:0], smooth, offset),
        solve(none, first[:0], second[:0], smooth, offset, 400),
    ):
        free = smooth.free.diagonal(dim1=2, dim2=3).transpose(1, 2)
        assert (smooth.slope(offset + step)[free].abs() < 1e-3).all()


def test_residuals_of_scenes_are_put_beside_those_of_scenes_that_have_about_as_many() -> None:
    residuals = problem(2 * TOGETHER + 1)[0]
    scene = residuals.node // (T * P)
    groups = list(alike(scene, 2 * TOGETHER + 1))
    rows = torch.cat([group.rows for group in groups if isinstance(group.rows, Tensor)])
    assert torch.equal(rows.sort().values, torch.arange(len(scene)))
    assert [group.size[0] for group in groups] == [TOGETHER, TOGETHER, 1]
    assert groups[0].size[1] <= groups[1].size[1] <= groups[2].size[1]
    number = torch.arange(len(scene), dtype=torch.float64)
    for group in groups:
        assert torch.equal(group.all_of(group.each(number)), number[group.rows])


def test_one_sided_residuals_far_from_counting_do_not_pull() -> None:
    residuals, first, second, smooth, offset = problem(1, seed=2)
    value, always = torch.full_like(residuals.value, -1.0), torch.ones_like(residuals.one_sided)
    far = Residuals(*residuals[:7], value, residuals.root_weight, residuals.two, always)
    none = exact_step(far.kept(slice(0)), first[:0], second[:0], smooth, offset)
    assert torch.allclose(exact_step(far, first, second, smooth, offset), none, atol=1e-6)


def test_the_cost_of_corrections_is_of_themselves_and_their_first_two_differences() -> None:
    settle, x = Settle(stay=0.5, speed=2.0, bend=3.0), torch.randn(6, dtype=torch.float64)
    cost = 0.5 * x.square().sum() + 2.0 * x.diff().square().sum() + 3.0 * x.diff(n=2).square().sum()
    assert torch.allclose(x @ stiffness(settle, 6) @ x, cost)


@pytest.mark.parametrize("heavy", [1.0, 1e4])
def test_people_in_each_other_are_corrected_by_what_a_step_may_be(heavy: float) -> None:
    """However much goals weigh, what float32 rounds does not stop a step."""
    draw, body = torch.Generator().manual_seed(3), BODY
    turns = from_rotvec(torch.randn(2, 20, 3, 22, 3, generator=draw) * 0.1)
    place = torch.randn(2, 20, 3, 3, generator=draw) * 0.05 + torch.tensor([0.0, 0.9, 0.0])
    betas, present = torch.randn(2, 3, 10, generator=draw), torch.ones(2, 3, dtype=torch.bool)
    scene = Scene(turns[..., 1:, :, :], rigid(turns[..., 0, :, :], place), betas, present, body=body.id)
    settle = replace(SHOWN, iterations=3, stay=0.01, root=0.1, stand=heavy, swing=heavy, hold=heavy, hard=heavy)
    offset = settling(scene, body, "hold", settle=settle)
    assert offset.isfinite().all()
    assert 0.1 < float(offset.abs().max()) <= 3 * 0.4 + 1e-4


def standing_scene(frames: int, people: int = 2) -> Scene:
    return standing(1, frames, people, torch.device("cpu"))


def test_somebody_who_stands_still_is_corrected_however_much_it_weighs() -> None:
    """Slopes of a foot that stands nearly cancel between two frames."""
    scene = standing_scene(frames=8)
    heavy = replace(SHOWN, iterations=1, stay=0.01, root=0.1, stand=1e5, swing=1e5, hold=1e5, hard=1e5)
    assert settling(scene, BODY, "hold", settle=heavy).isfinite().all()


def test_few_poses_are_solved_at_once_and_a_scene_s_correction_is_its_own() -> None:
    """Also beside one in which more people may move, and beside one that is done with."""
    scene = standing_scene(frames=SOLVED_AT_ONCE // 2 + 2)
    root = scene.T_world_root.clone()
    root[..., 1, 0, 3] = root[..., 0, 0, 3] + 0.15
    deep = scene.replace(T_world_root=root)
    alone = deep.replace(present=torch.tensor([[True, False]]))
    batch = concatenate([deep, scene, alone])
    whole = settling(batch, BODY, "firm", settle=SHOWN)
    assert float(whole[0].abs().max()) > 0.02
    for number, one in enumerate((deep, scene, alone)):
        assert torch.allclose(settling(one, BODY, "firm", settle=SHOWN)[0], whole[number], atol=1e-4), number


def test_a_correction_goes_on_from_a_first_guess() -> None:
    """Two halves of the steps, the second from where the first has ended, are all of them."""
    scene = standing_scene(frames=8)
    root = scene.T_world_root.clone()
    root[..., 1, 0, 3] = root[..., 0, 0, 3] + 0.15
    deep = scene.replace(T_world_root=root)
    one, two = replace(SHOWN, iterations=1), replace(SHOWN, iterations=2)
    begun = settling(deep, BODY, "firm", settle=one)
    kept, whole = begun.clone(), settling(deep, BODY, "firm", settle=two)
    gone_on = settling(deep, BODY, "firm", settle=one, guess=begun)
    assert torch.equal(gone_on, whole) and torch.equal(begun, kept) and not torch.equal(begun, whole)


def test_the_shoulder_girdle_turns_where_that_costs_something_finite() -> None:
    scene = standing_scene(frames=8)
    root = scene.T_world_root.clone()
    root[..., 1, 0, 3] = root[..., 0, 0, 3] + 0.15
    girdle = slice(9, 15)
    for shrug, turns in ((5.0, True), (math.inf, False)):
        made = settling(scene.replace(T_world_root=root), BODY, "firm", settle=replace(SHOWN, shrug=shrug))
        assert bool((made[..., girdle].abs() > 1e-6).any()) is turns
        assert float(made.abs().max()) > 0.02


@pytest.mark.slow
def test_many_people_in_a_short_window_are_not_solved_at_once() -> None:
    """Unknowns of all would be linked to each other: time with their third power."""
    row = standing_scene(frames=12, people=8)
    root = row.T_world_root.clone()
    root[..., 0, 3] *= 0.25
    crowd = row.replace(T_world_root=root)
    with unittest.mock.patch("magnet.body.settle.exact_step", side_effect=AssertionError):
        made = settling(crowd, BODY, "firm", settle=replace(SHOWN, iterations=1))
    assert made.isfinite().all()


def test_ends_that_cannot_move_and_two_on_one_node_are_left_out() -> None:
    node, other = torch.tensor([0, 0, 3, 2, 1]), torch.tensor([2, 3, 1, 2, 3])
    moves = torch.tensor([True, False, True, False])
    zero = torch.zeros(5, 3)
    first, second = torch.randn(5, DOFS), torch.randn(5, DOFS)

    def ends_of(one: Tensor, two: Tensor, *slopes: Tensor) -> Ends:
        residuals = Residuals(one, one, zero, two, two, zero, zero, *(torch.zeros(5),) * 4)
        return Ends.of(residuals, *slopes, moves)

    ends = ends_of(node, other, first, second)
    assert ends.two.tolist() == [True, False, False, False, False]
    assert torch.equal(ends.slope[0], first[0].double()) and torch.equal(ends.other_slope[0], -second[0].double())
    assert torch.equal(ends.slope[1], first[1].double()) and ends.node.tolist()[:2] == [0, 0]
    assert torch.equal(ends.slope[3], first[3].double() - second[3].double())
    assert not ends.other_slope[1:].any()
    swapped = ends_of(other, node, second, first)
    assert swapped.node[1] == 0 and torch.equal(swapped.slope[1], -first[1].double())
