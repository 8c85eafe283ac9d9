"""The terms of the energy of bodies together, each against a case that is known without it."""

from __future__ import annotations

import pytest
import roma
import torch

from magnet.body import energy as terms
from magnet.body import load_body
from magnet.body.energy import CONTACT, PARTS, allowed_between, allowed_within
from magnet.body.fit import clearance
from magnet.body.fitted_capsules import fit_capsules
from magnet.body.joints import L_ELBOW, L_KNEE, TOES
from magnet.motion.frames import rigid
from magnet.motion.scene import Scene

BODY = load_body()
PLACE = {part.name: place for place, part in enumerate(PARTS)}


def standing(apart: float = 1.0, frames: int = 5, height: float | None = None) -> Scene:
    """Two people of average shape in the rest pose, side by side along x, on the floor."""
    betas = torch.zeros(1, 2, 10)
    above = clearance(BODY, betas[0])[0, 2:]
    floor = float(above[0] - BODY.rest_joints(betas[0, 0])[10, 1]) if height is None else height
    place = torch.tensor([[0.0, floor, 0.0], [apart, floor, 0.0]])
    eye = torch.eye(3)
    T_world_root = rigid(eye.expand(1, frames, 2, 3, 3), place.expand(1, frames, 2, 3))
    return Scene(eye.repeat(1, frames, 2, 21, 1, 1), T_world_root, betas, torch.ones(1, 2, dtype=torch.bool))


def energy_of(scene: Scene, how: str = "firm") -> torch.Tensor:
    capsules = fit_capsules(BODY, scene.betas)
    R_world, joints = BODY.bone_chain(scene.body_rot, scene.T_world_root, BODY.rest_joints(scene.betas[:, None]))
    seen = scene.present[:, None].expand(joints.shape[:3])
    return terms.pair_energy(capsules.posed(R_world, joints), capsules.radius, seen, CONTACT[how])


def test_depth_of_two_capsules_is_their_radii_less_the_distance_of_their_axes() -> None:
    ends = torch.tensor([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]])
    others = torch.tensor([[[0.5, 0.1, -1.0], [0.5, 0.1, 1.0]]])
    depth = terms.capsule_depth(ends, torch.tensor([0.08]), others, torch.tensor([0.05]))
    torch.testing.assert_close(depth, torch.tensor([[0.03]]))


def test_hands_may_be_anywhere_on_hands_and_forearms_and_nothing_else_may() -> None:
    allowed = allowed_between(CONTACT["firm"])
    free = [PLACE[f"{side} {part}"] for side in ("left", "right") for part in ("hand", "forearm")]
    assert torch.isinf(allowed[free][:, free]).all()
    assert int(torch.isinf(allowed).sum()) == len(free) ** 2
    assert float(allowed[PLACE["pelvis"], PLACE["left hand"]]) == pytest.approx(CONTACT["firm"].arms)
    assert float(allowed[PLACE["head"], PLACE["left thigh"]]) == pytest.approx(CONTACT["firm"].body)
    within = allowed_within(CONTACT["firm"])
    assert torch.isinf(within.tril()[torch.ones_like(within).tril() > 0]).all()
    assert torch.isinf(within[PLACE["left upper arm"], PLACE["left forearm"]]), "neighbours always overlap"


def test_people_at_rest_are_in_nobody_and_not_in_themselves() -> None:
    assert float(energy_of(standing(2.0)).sum()) == 0.0


def test_the_energy_falls_as_people_leave_each_other_and_its_slope_points_apart() -> None:
    near = energy_of(standing(0.10)).sum()
    assert float(near) > float(energy_of(standing(0.25)).sum()) > float(energy_of(standing(2.0)).sum())
    assert float(energy_of(standing(0.25), "light").sum()) < float(energy_of(standing(0.25)).sum())
    scene = standing(0.25)
    T_world_root = scene.T_world_root.clone().requires_grad_()
    energy_of(scene.replace(T_world_root=T_world_root)).sum().backward()
    slope = T_world_root.grad[0, 0, :, 0, 3]
    assert slope[0] > 0 > slope[1], "the one at 0 goes left, the other right"


def test_the_energy_of_many_is_that_of_every_two_who_are_there() -> None:
    """Two couples, each in each other, and a kilometre between them."""
    one, two = standing(0.10), standing(0.25)
    away = two.T_world_root.clone()
    away[..., 0, 3] += 1000.0
    four = Scene(
        torch.cat([one.body_rot, two.body_rot], dim=2),
        torch.cat([one.T_world_root, away], dim=2),
        torch.zeros(1, 4, 10),
        torch.ones(1, 4, dtype=torch.bool),
    )
    torch.testing.assert_close(energy_of(four), energy_of(one) + energy_of(two), rtol=1e-2, atol=0.0)
    absent = four.replace(present=torch.tensor([[True, True, True, False]]))
    torch.testing.assert_close(energy_of(absent), energy_of(one), rtol=1e-4, atol=0.0)


def test_the_energy_has_a_finite_slope_where_axes_cross() -> None:
    ends = torch.zeros(1, 1, 2, len(PARTS), 2, 3).requires_grad_()  # all in one point
    radius = torch.full((1, 2, len(PARTS)), 0.1)
    energy = terms.pair_energy(ends, radius, torch.ones(1, 1, 2, dtype=torch.bool), CONTACT["firm"])
    energy.sum().backward()
    assert float(energy.detach()) > 0 and ends.grad.isfinite().all()


def test_a_forearm_in_ones_own_trunk_costs() -> None:
    scene = standing(2.0)
    body_rot = scene.body_rot.clone()
    turn = roma.rotvec_to_rotmat(torch.tensor([0.0, -2.7, 0.0]))  # about the vertical: across the chest
    body_rot[..., 15, :, :] = roma.rotvec_to_rotmat(torch.tensor([0.0, -1.2, 0.0]))
    body_rot[..., L_ELBOW - 1, :, :] = turn
    assert float(energy_of(scene.replace(body_rot=body_rot)).sum()) > 1e-4


def test_feet_and_floor() -> None:
    joints = BODY.joints(standing(1.0, frames=4))
    above = clearance(BODY, torch.zeros(2, 10))[None, None]
    assert float(terms.under_floor(joints, above).max()) < 1e-6
    assert float(terms.under_floor(joints - torch.tensor([0, 0.03, 0]), above).max()) == pytest.approx(0.03, abs=1e-5)
    moving = joints + 0.02 * torch.arange(4)[None, :, None, None, None] * torch.tensor([1.0, 0.0, 0.0])
    stands = torch.ones(1, 3, 2, 2, dtype=torch.bool)
    slid = terms.slide(moving, stands, still=0.06, fps=30.0)
    torch.testing.assert_close(slid, torch.full_like(slid, 0.02 - 0.06 / 30))
    assert not terms.slide(moving, ~stands).any() and len(TOES) == 2


def test_joints_are_out_of_range_by_what_is_beyond_it() -> None:
    body_rot = torch.eye(3).repeat(21, 1, 1)
    assert not terms.limit_excess(body_rot).any()
    body_rot[L_KNEE - 1] = roma.rotvec_to_rotmat(torch.tensor([3.0, 0.0, 0.0]))
    excess = terms.limit_excess(body_rot)
    assert float(excess[L_KNEE - 1]) == pytest.approx(3.0 - terms.TURNS[L_KNEE], abs=1e-3)
    assert int((excess > 0).sum()) == 1
