"""Capsules fitted to the mesh, against the mesh itself."""

from __future__ import annotations

import pytest
import roma
import torch
from torch import Tensor

from magnet.body import load_body
from magnet.body.capsules import CAPSULES, capsule_segments
from magnet.body.energy import capsule_depth
from magnet.body.fitted_capsules import PARTS, fit_capsules, with_measured
from magnet.motion.frames import rigid
from magnet.motion.scene import Scene

BODY = load_body()


def people(seed: int, tilt: float = 0.35) -> Scene:
    """Two bodies in one place, their limbs bent at random."""
    generator = torch.Generator().manual_seed(seed)
    body_rot = roma.rotvec_to_rotmat(tilt * torch.randn(1, 1, 2, 21, 3, generator=generator))
    root = roma.rotvec_to_rotmat(torch.randn(1, 1, 2, 3, generator=generator))
    betas = 0.7 * torch.randn(1, 2, 10, generator=generator)
    return Scene(body_rot, rigid(root, torch.zeros(1, 1, 2, 3)), betas, torch.ones(1, 2, dtype=torch.bool))


def winding_numbers(points: Tensor, vertices: Tensor, faces: Tensor) -> Tensor:
    """How often a closed mesh winds around points: 1 inside, 0 outside (solid angles after van Oosterom and Strackee).

    (M, 3), (V, 3), (F, 3) -> (M,)
    """
    result = []
    for part in points.split(64):
        a, b, c = (vertices[faces[:, k]][None] - part[:, None] for k in range(3))
        la, lb, lc = a.norm(dim=-1), b.norm(dim=-1), c.norm(dim=-1)
        over = (a * torch.linalg.cross(b, c, dim=-1)).sum(-1)
        under = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
        result.append(torch.atan2(over, under).sum(dim=-1) / (2 * torch.pi))
    return torch.cat(result)


def mesh_depth(one: Tensor, other: Tensor) -> float:
    """How far the deepest vertex of one body is under the other's skin. (V, 3) x 2 -> metres, 0 where none is"""
    low, high = other.amin(dim=0), other.amax(dim=0)
    near = one[((one > low) & (one < high)).all(dim=-1)][::12]
    inside = near[winding_numbers(near, other, BODY.faces) > 0.5] if len(near) else near
    return float(torch.cdist(inside, other).amin(dim=1).amax()) if len(inside) else 0.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_depth_is_that_of_the_meshes_to_a_few_centimetres(seed: int) -> None:
    scene = people(seed)
    vertices = BODY.vertices(scene)[0, 0]
    capsules = fit_capsules(BODY, scene.betas)
    R_world, joints = BODY.bone_chain(scene.body_rot, scene.T_world_root, BODY.rest_joints(scene.betas[:, None]))
    ends = capsules.posed(R_world, joints)[0, 0]
    away = torch.tensor([1.0, 0.0, 0.0])
    errors, depths = [], []
    for apart in (0.15, 0.30, 0.45):
        depth = capsule_depth(ends[0], capsules.radius[0, 0], ends[1] + apart * away, capsules.radius[0, 1]).amax()
        moved = vertices[1] + apart * away
        real = max(mesh_depth(vertices[0], moved), mesh_depth(moved, vertices[0]))
        depths.append(real)
        # Two capsules are as deep as both their radii; a vertex of one body is at most as deep as the other is thick.
        errors.append(abs(min(max(float(depth), 0.0), 0.12) - min(real, 0.12)))
    assert max(depths) > 0.05
    assert max(errors) < 0.04, (errors, depths)


@pytest.mark.parametrize("beta", [-2.0, 0.0, 2.0])
def test_the_skin_is_a_centimetre_from_the_capsules(beta: float) -> None:
    betas = torch.zeros(1, 1, 10)
    betas[..., :2] = beta
    capsules = fit_capsules(BODY, betas)
    rest = BODY.rest_joints(betas)
    ends = capsules.posed(torch.eye(3).expand(1, 1, 1, 22, 3, 3), rest[:, None])[0, 0, 0]
    skin = BODY.v_template + BODY.shapedirs @ betas[0, 0]
    a, along = ends[:, 0], ends[:, 1] - ends[:, 0]
    share = (((skin[:, None] - a) * along).sum(-1) / along.square().sum(-1).clamp_min(1e-12)).clamp(0, 1)
    off = ((skin[:, None] - a - share[..., None] * along).norm(dim=-1) - capsules.radius[0, 0]).amin(dim=1)
    assert float(off.abs().mean()) < 0.015 and float(off.abs().quantile(0.95)) < 0.04


def test_capsules_that_depth_is_measured_by_move_with_the_same_bones() -> None:
    scene = people(2)
    rest = BODY.rest_joints(scene.betas[:, None])
    R_world, joints = BODY.bone_chain(scene.body_rot, scene.T_world_root, rest)
    both = with_measured(fit_capsules(BODY, scene.betas), rest)
    ends, (first, last, radius) = both.posed(R_world, joints), capsule_segments(joints)
    assert ends.shape[3] == len(PARTS) + len(CAPSULES) == len(both.bones)
    torch.testing.assert_close(ends[:, :, :, len(PARTS) :], torch.stack([first, last], dim=-2), atol=1e-5, rtol=0)
    torch.testing.assert_close(both.radius[0, 1, len(PARTS) :], radius)


def test_left_and_right_are_alike() -> None:
    radius = fit_capsules(BODY, torch.zeros(1, 1, 10)).radius[0, 0]
    for k, part in enumerate(PARTS):
        if part.name.startswith("left"):
            assert PARTS[k + 1].name == part.name.replace("left", "right")
            torch.testing.assert_close(radius[k], radius[k + 1], atol=1e-3, rtol=0)
