"""Fitting a body to joints."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from magnet.body import JOINT_NAMES, PARENTS, Body, load_body
from magnet.body.fit import FitSettings, clearance, fit_body, jumps_in, kabsch, shape_from_lengths, start, swing
from magnet.body.joints import HIPS, KNEES
from magnet.datamodules.preparing.fit_cache import LIMBS, fit_whole
from magnet.datamodules.reading.asf_amc import read_amc, read_asf
from magnet.datamodules.reading.cmu_joints import measured
from magnet.motion.frames import rigid
from magnet.motion.rotations import from_rotvec, geodesic
from magnet.motion.scene import Scene
from magnet.testing import random_scene
from tests.datamodules.slow_cmu import slow_ends

ALL = tuple(range(22))
MOST = tuple(j for j in ALL if j not in (6, 13, 14))  # what other captures lack
QUICK = FitSettings(steps=60, shape_steps=80, shape_frames=24)


@pytest.fixture(scope="module")
def body() -> Body:
    return load_body()


@pytest.fixture
def moving(body: Body, generator: torch.Generator) -> Scene:
    scene = random_scene(1, 40, 2, generator)
    betas = 0.8 * torch.randn(1, 2, 10, generator=generator)
    return scene.replace(body=body.id, betas=betas)


def turned(axis: Tensor, radians: Tensor) -> Tensor:
    """Rodrigues' formula, written out."""
    x, y, z = axis
    K = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=axis.dtype)
    return torch.eye(3, dtype=axis.dtype) + radians.sin() * K + (1 - radians.cos()) * K @ K


def test_swing_takes_one_direction_to_the_other_by_the_angle_between(generator: torch.Generator) -> None:
    a, b = torch.randn(2, 50, 3, generator=generator, dtype=torch.float64)
    R = swing(a, b)
    unit_a, unit_b = a / a.norm(dim=-1, keepdim=True), b / b.norm(dim=-1, keepdim=True)
    torch.testing.assert_close((R @ unit_a[..., None])[..., 0], unit_b)
    angle = torch.acos((unit_a * unit_b).sum(-1))
    torch.testing.assert_close(geodesic(R, torch.eye(3, dtype=R.dtype)), angle)


def test_swing_of_opposite_directions_is_a_half_turn() -> None:
    a = torch.eye(3, dtype=torch.float64)
    R = swing(a, -a)
    torch.testing.assert_close((R @ a[..., None])[..., 0], -a)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(3, dtype=torch.float64))


def test_kabsch_finds_the_rotation_points_were_turned_by(generator: torch.Generator) -> None:
    points = torch.randn(4, 6, 3, generator=generator, dtype=torch.float64)
    axis = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    R = turned(axis, torch.tensor(2.5, dtype=torch.float64))
    torch.testing.assert_close(kabsch(points, points @ R.T + 3.0), R.expand(4, 3, 3))


@pytest.mark.parametrize("joints", [ALL, MOST], ids=["all joints", "some joints"])
def test_targets_of_the_body_itself_are_met_within_a_centimetre(
    body: Body, moving: Scene, joints: tuple[int, ...]
) -> None:
    targets = body.joints(moving)[0][:, :, list(joints)]
    fit = fit_body(targets, joints, body, settings=QUICK)
    assert fit.residual.shape == targets.shape[:3]
    found = body.joints(fit.scene)[0][:, :, list(joints)]
    torch.testing.assert_close(fit.residual, (found - targets).norm(dim=-1))
    assert fit.residual.mean() < 0.01
    assert fit.scene.body == body.id


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
@pytest.mark.parametrize("known", [False, True], ids=["joints alone", "shapes and rotations known"])
def test_a_fit_is_the_same_where_the_caller_wants_no_gradients(
    body: Body, moving: Scene, mode: type[torch.no_grad] | type[torch.inference_mode], known: bool
) -> None:
    few = replace(QUICK, steps=3, shape_steps=3)
    local = torch.cat([moving.T_world_root[0, :, :, None, :3, :3], moving.body_rot[0]], dim=2)

    def fitted() -> Scene:
        targets = body.joints(moving)[0]
        rotations, betas = (local.clone(), moving.betas[0].clone()) if known else (None, None)
        return fit_body(
            targets, ALL, body, rotations=rotations, betas=betas, settings=few, grounded=True, refuse_above=9.0
        ).scene

    expected = fitted()
    with mode():
        got = fitted()
    for field, tensor in expected.tensors().items():
        assert torch.equal(getattr(got, field), tensor), field


def test_a_fit_to_joints_alone_starts_with_thighs_that_lead_to_the_knees(body: Body, moving: Scene) -> None:
    targets, rest = body.joints(moving)[0], body.rest_joints(moving.betas[0])
    sure = torch.ones(targets.shape[:3], dtype=torch.bool)
    local, place, _ = start(targets, ALL, rest, None, sure)
    found = body.bone_chain(local[:, :, 1:], rigid(local[:, :, 0], place), rest)[1]
    bones = [each[:, :, KNEES] - each[:, :, HIPS] for each in (found, targets)]
    torch.testing.assert_close(*bones, atol=1e-4, rtol=0)


def test_a_known_thigh_starts_as_it_is_known(body: Body, moving: Scene) -> None:
    targets = body.joints(moving)[0]
    hints = torch.full((*targets.shape[:3], 3, 3), torch.nan)
    hints[:, :, HIPS] = torch.eye(3)
    sure = torch.ones(targets.shape[:3], dtype=torch.bool)
    local = start(targets, ALL, body.rest_joints(moving.betas[0]), hints, sure)[0]
    thigh = local[:, :, :1] @ local[:, :, HIPS]
    torch.testing.assert_close(thigh, torch.eye(3).expand_as(thigh), atol=1e-5, rtol=0)


def test_known_rotations_come_back(body: Body, moving: Scene) -> None:
    world = [moving.T_world_root[0, :, :, :3, :3]]
    for j in range(1, 22):
        world.append(world[PARENTS[j]] @ moving.body_rot[0, :, :, j - 1])
    targets = body.joints(moving)[0]
    fit = fit_body(targets, ALL, body, rotations=torch.stack(world, dim=2), betas=moving.betas[0])
    apart = geodesic(fit.scene.body_rot, moving.body_rot).rad2deg()
    assert apart.mean() < 3 and fit.residual.mean() < 0.003
    torch.testing.assert_close(fit.scene.betas, moving.betas)


def test_lengths_of_the_body_itself_give_its_bones_back(body: Body, moving: Scene) -> None:
    targets = body.rest_joints(moving.betas)  # at rest the nearly rigid distances are exact as well
    sure = torch.ones(targets.shape[:3], dtype=torch.bool)
    betas = shape_from_lengths(targets, ALL, body, sure, prior=1e-3)
    bones = [(PARENTS[j], j) for j in range(1, 22)]
    for p in range(2):
        ours, theirs = body.rest_joints(betas[p]), body.rest_joints(moving.betas[0, p])
        for a, b in bones:
            assert abs((ours[a] - ours[b]).norm() - (theirs[a] - theirs[b]).norm()) < 0.002, JOINT_NAMES[b]


def test_frames_and_targets_that_do_not_count_do_not_change_the_others(body: Body, moving: Scene) -> None:
    targets = body.joints(moving)[0]
    valid = torch.ones(targets.shape[:2], dtype=torch.bool)
    valid[20] = False
    wrong = targets.clone()
    wrong[20, :, 20] += 2.0
    fit = fit_body(wrong, ALL, body, valid=valid, settings=QUICK)
    assert fit.residual[valid].mean() < 0.01
    assert not fit.scene.valid[0, 20] and fit.scene.valid[0].sum() == len(targets) - 1

    weights = torch.ones(22)
    weights[10] = 0.0
    astray = targets.clone()
    astray[:, :, 10] += 1.0
    fit = fit_body(astray, ALL, body, weights=weights, settings=QUICK)
    kept = [j for j in ALL if j != 10]
    assert fit.residual[..., kept].mean() < 0.01


def test_soles_stay_on_the_floor_when_grounded(body: Body, moving: Scene) -> None:
    standing = torch.zeros(1, 60, 1, 21, 3, 3) + torch.eye(3)
    root = torch.eye(4).repeat(1, 60, 1, 1, 1)
    scene = Scene(standing, root, torch.zeros(1, 1, 10), torch.ones(1, 1, dtype=torch.bool), body=body.id)
    targets = body.joints(scene)[0]
    targets[40:50, :, [10, 11], 1] -= 0.04  # balls of the feet below where the sole allows
    fit = fit_body(targets, ALL, body, grounded=True)
    height = body.joints(fit.scene)[0][:, 0, [10, 11], 1]
    floor = (targets[:40, 0, [10, 11], 1] - clearance(body, fit.scene.betas[0])[0, [2, 3]]).mean()
    deep = floor + clearance(body, fit.scene.betas[0])[0, [2, 3]] - height
    assert deep.max() < 0.02


# -- bad input ---------------------------------------------------------------------------------


def test_a_body_that_does_not_fit_is_refused_with_the_worst_joint(body: Body, moving: Scene) -> None:
    targets = body.joints(moving)[0].clone()
    targets[:, :, 20] += 3.0
    with pytest.raises(ValueError, match=r"mean error of .* cm, expected at most 4\.0 cm; worst is left_wrist"):
        fit_body(targets, ALL, body, settings=QUICK)


def test_many_frames_a_second_fit_as_well_as_thirty(body: Body, generator: torch.Generator) -> None:
    """At 240 a second smoothness weighed 4,096 times as much between neighbours: joints were thrice as far off."""
    axes, phases = 0.5 * torch.randn(21, 3, generator=generator), 2 * math.pi * torch.rand(21, 1, generator=generator)

    def off(fps: int) -> float:
        seconds = torch.arange(fps // 3)[:, None, None] / fps
        still = random_scene(1, len(seconds), 1, torch.Generator().manual_seed(0))
        place = torch.cat([seconds[:, 0], torch.ones(len(seconds), 1), torch.zeros(len(seconds), 1)], dim=1)
        scene = still.replace(
            body_rot=from_rotvec(axes * (3 * math.pi * seconds + phases).sin())[None, :, None],
            T_world_root=rigid(torch.eye(3).expand(len(seconds), 3, 3), place)[None, :, None],
            betas=torch.zeros(1, 1, 10),
            fps=float(fps),
            body=body.id,
        )
        targets = body.joints(scene)[0]
        fit = fit_body(targets[:, :, list(MOST)], MOST, body, fps=fps, refuse_above=1.0, settings=QUICK)
        return float((body.joints(fit.scene)[0] - targets).norm(dim=-1).mean())

    assert off(240) < 1.2 * off(30)


def test_a_cut_in_many_frames_a_second_stays_one(body: Body) -> None:
    scene = random_scene(1, 1, 1, torch.Generator().manual_seed(0)).replace(betas=torch.zeros(1, 1, 10), body=body.id)
    targets = body.joints(scene)[0].repeat(40, 1, 1, 1)
    targets[20:, ..., 0] += 1.0
    fit = fit_body(targets[:, :, list(MOST)], MOST, body, betas=torch.zeros(1, 10), fps=120.0, settings=QUICK)
    off = fit.residual.mean(dim=(1, 2))
    assert off[14:26].max() < 1.5 * off[:10].max() + 1e-3


def test_what_a_leap_may_be_grows_with_the_time_between_frames() -> None:
    """Somebody who brakes by 6 g: seen 30 times a second, and 15 times."""
    time = torch.arange(0, 0.5, 1 / 30)
    targets = (30.0 * time**2)[:, None, None, None].expand(-1, 1, 15, 3) / 3**0.5
    assert not jumps_in(targets, 30.0).any()
    assert not jumps_in(targets[::2], 15.0).any()
    assert jumps_in(targets[::2], 30.0).any()


def test_centimetres_are_refused(body: Body, moving: Scene) -> None:
    with pytest.raises(ValueError, match="check units"):
        fit_body(100 * body.joints(moving)[0], ALL, body, settings=QUICK)


def test_bad_arguments_are_named(body: Body, moving: Scene) -> None:
    targets = body.joints(moving)[0]
    with pytest.raises(ValueError, match="targets: got"):
        fit_body(targets, ALL[:5], body)
    with pytest.raises(ValueError, match="targets lack left_hip"):
        fit_body(targets[:, :, 2:], ALL[2:], body)
    with pytest.raises(ValueError, match="NaN"):
        fit_body(targets * torch.nan, ALL, body)
    with pytest.raises(ValueError, match="rotations: got"):
        fit_body(targets, ALL, body, rotations=torch.zeros(3, 2, 22, 3, 3))
    with pytest.raises(ValueError, match="valid frame for everybody"):
        fit_body(targets, ALL, body, valid=torch.zeros(40, 2, dtype=torch.bool))


# -- a real couple -----------------------------------------------------------------------------


@pytest.mark.slow
def test_a_real_couple_fits_within_the_bars(cmu_root: Path, body: Body) -> None:
    people = []
    for subject in (60, 61):
        whole = read_amc(cmu_root / f"salsa/{subject}_10.amc", read_asf(cmu_root / f"salsa/{subject}.asf"), 60)
        people.append(replace(whole, root=whole.root[700:1000], local=whole.local[700:1000]))
    scene, report = fit_whole(*measured(people), body)
    assert scene.frames == 150 and scene.agents == 2 and scene.fps == 30
    assert report["limb error cm"] < 2.5
    assert abs(report["nearest wrists fitted cm"] - report["nearest wrists recorded cm"]) < 1
    assert scene.betas.abs().max() < 3
    joints = body.joints(scene)[0]
    for p, subject in enumerate((60, 61)):
        for frame in (0, 75, 149):
            files = cmu_root / f"salsa/{subject}.asf", cmu_root / f"salsa/{subject}_10.amc"
            ends = slow_ends(*files, 700 + 2 * frame)
            for joint, bone in ((20, "lwrist"), (21, "rwrist")):
                recorded = torch.from_numpy(ends[bone]).float() - torch.tensor([0.0, report["floor cm"] / 100, 0.0])
                assert (joints[frame, p, joint] - recorded).norm() < 0.01, (subject, frame, bone)
    forearm = (joints[0, :, [20, 21]] - joints[0, :, [18, 19]]).norm(dim=-1)
    upper_arm = (joints[0, :, [18, 19]] - joints[0, :, [16, 17]]).norm(dim=-1)
    assert ((forearm / upper_arm) > 0.8).all() and ((forearm / upper_arm) < 1.0).all()
    lowest = (joints[:, :, [10, 11], 1] - clearance(body, scene.betas[0])[:, 2:]).amin(dim=-1)
    assert lowest.min() > -0.03 and lowest.median().abs() < 0.01
    angles = geodesic(scene.body_rot[0], torch.eye(3)).rad2deg()
    limits = {3: 60, 4: 160, 5: 160, 6: 45, 7: 80, 8: 80, 9: 45, 12: 80, 15: 50, 18: 160, 19: 160, 20: 100, 21: 100}
    for joint, limit in limits.items():
        assert angles[..., joint - 1].max() < limit, JOINT_NAMES[joint]
    assert len(LIMBS) == 14
