"""Damped least squares over the poses of several people: out of each other, hands held, feet still, on the floor.

Root, legs, arms and, a little, the back are moved in a window of frames. Corrections are small and smooth in time;
fixed frames and people stay bit-identical.
"""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from magnet.body.base import Body
from magnet.body.fitted_capsules import fit_capsules, with_measured
from magnet.body.fixed import fixed_in
from magnet.body.indices import indices
from magnet.body.joints import ANKLES, COLLARS, ELBOWS, HIPS, KNEES, PARENTS, SHOULDERS, SPINE2
from magnet.body.settle_goals import Goals
from magnet.body.settle_options import Settle
from magnet.body.settle_past import Past
from magnet.body.settle_residuals import Residuals, Seen, all_residuals
from magnet.body.settle_steps import Smoothness, exact_step, solve
from magnet.body.settle_wishes import Wishes
from magnet.motion.frames import rigid
from magnet.motion.rotations import from_rotvec
from magnet.motion.scene import BODY_JOINTS, Scene

MOVED: tuple[int, ...] = (0, SPINE2, *COLLARS, *HIPS, *KNEES, *ANKLES, *SHOULDERS, *ELBOWS)
"""Joints that are turned; turning the pelvis turns the whole body. `magnet.body.settle_steps` knows the places of the
first four."""

LIMBS = tuple(joint - 1 for joint in MOVED[1:])
"""Where their rotations are among those of the body."""

TURNED_IN = tuple(max(PARENTS[joint], 0) for joint in MOVED)
"""The joint in whose frame each is turned."""

DOFS = 3 + 3 * len(MOVED)
"""Numbers that correct a pose: the root's shift in metres, then rotation vectors of the joints `MOVED`, radians."""

LEAD = 2
"""Frames of the past that a correction continues."""

RAMP = 6
"""Frames after a fixed past over which weights grow to their full value."""

SOLVED_AT_ONCE = 32
"""Poses of a scene that may move, up to which a step is solved at once, and not by conjugate gradients."""

SMALL = 0.002
"""Metres and radians of a step after which such a scene is done with."""

WINDOW, AHEAD = 240, 24
"""Frames that are corrected together, and frames after them that are computed and dropped."""


@functools.cache
def _ancestry(device: torch.device) -> Tensor:
    """Which joints of `MOVED` move each bone. -> (22, joints) bool"""
    moves = [[False] * len(MOVED) for _ in range(BODY_JOINTS)]
    for bone in range(BODY_JOINTS):
        joint = bone
        while joint >= 0:
            if joint in MOVED:
                moves[bone][MOVED.index(joint)] = True
            joint = PARENTS[joint]
    with torch.inference_mode(False):  # or training, later, could not use them
        return torch.tensor(moves, device=device)


def corrected(scene: Scene, offset: Tensor) -> Scene:
    """The scene with corrected poses; poses with offset 0 stay bit-identical. offset (B, T, P, DOFS)

    Turns are in the frame of each joint's parent before the correction, those of the pelvis in the world.
    """
    return scene.with_poses((offset != 0).any(dim=-1), *moved(scene.body_rot, scene.T_world_root, offset))


def moved(body_rot: Tensor, T_world_root: Tensor, offset: Tensor) -> tuple[Tensor, Tensor]:
    """Poses as an offset corrects them. (..., 21, 3, 3), (..., 4, 4), (..., DOFS) -> the first two"""
    turns = from_rotvec(offset[..., 3:].unflatten(-1, (len(MOVED), 3)))
    limbs = indices(LIMBS, offset.device)
    body_rot = body_rot.index_copy(-3, limbs, turns[..., 1:, :, :] @ body_rot.index_select(-3, limbs))
    turned = turns[..., 0, :, :] @ T_world_root[..., :3, :3]
    return body_rot, rigid(turned, T_world_root[..., :3, 3] + offset[..., :3])


def jacobian(seen: Seen, node: Tensor, bone: Tensor, point: Tensor, along: Tensor) -> Tensor:
    """How far points move along a direction per unit of each number that corrects a pose. -> (M, DOFS)

    Args:
        seen: poses of all nodes; a node is one person in one frame.
        node, bone: (M,) int, the node and the bone that each point is fixed to.
        point, along: (M, 3) in the world.
    """
    arm = point[:, None] - seen.joints.index_select(1, indices(MOVED, node.device))[node]  # (M, joints, 3)
    turn = torch.linalg.cross(arm, along[:, None].expand_as(arm), dim=-1)
    R_world_parent = seen.R_world.index_select(1, indices(TURNED_IN, node.device))[node]
    own = (R_world_parent * turn[..., None]).sum(dim=-2)
    own[:, 0] = turn[:, 0]
    own = own * _ancestry(own.device)[bone][..., None]
    return torch.cat([along, own.flatten(1)], dim=-1)


def slopes(seen: Seen, residuals: Residuals) -> tuple[Tensor, Tensor]:
    """How residuals change with the poses at either end, times the square root of their weight. -> (M, DOFS) twice"""
    node = torch.cat([residuals.node, residuals.other])
    bone = torch.cat([residuals.bone, residuals.other_bone])
    point = torch.cat([residuals.point, residuals.other_point])
    both = jacobian(seen, node, bone, point, residuals.along.repeat(2, 1))
    weight = torch.cat([residuals.root_weight, residuals.root_weight * residuals.two])
    first, second = (both * weight[:, None]).chunk(2)
    return first, second


@torch.no_grad()
def correction(
    scene: Scene,
    body: Body,
    wishes: Wishes,
    fixed: Tensor | None = None,
    settle: Settle | None = None,
    past: Past | None = None,
    toward: Tensor | None = None,
    guess: Tensor | None = None,
) -> Tensor:
    """The correction of a scene's poses that meets the wishes, for `corrected`. -> (B, T, P, DOFS)

    Args:
        scene: (B, T, P), with shapes of `body`.
        wishes: see `Wishes.of`.
        fixed: (P,), (T, P) or (B, T, P) bool, who must not be moved; None: nobody.
        past: the frames before; None: there are none.
        toward: (B, T, P, 2) metres that people are first moved over the ground: decides who ends on which side.
        guess: (B, T, P, DOFS) a correction to begin with, 0 where nobody may move; None: that of the last frame before,
            moved `toward` there.
    """
    T = scene.frames
    if T > WINDOW + AHEAD:
        parts: list[Tensor] = []
        for start in range(0, T, WINDOW):
            stop = min(start + WINDOW + AHEAD, T)
            stay = fixed_in(fixed, slice(start, stop))
            push, first = (None if each is None else each[:, start:stop] for each in (toward, guess))
            before = Past(parts[-1][:, -LEAD:]) if parts else past
            part = scene.slice(start, stop), body, wishes.slice(start, stop)
            parts.append(correction(*part, stay, settle, before, push, first)[:, :WINDOW])
        return torch.cat(parts, dim=1)
    return correct_window(scene, body, wishes, fixed, settle or Settle(), past, toward, guess)


def correct_window(
    scene: Scene,
    body: Body,
    wishes: Wishes,
    fixed: Tensor | None,
    settle: Settle,
    past: Past | None,
    toward: Tensor | None,
    guess: Tensor | None,
) -> Tensor:
    """`correction` of frames that are corrected together."""
    B, T, P = scene.T_world_root.shape[:3]
    free = scene.present[:, None].expand(B, T, P).clone()
    if fixed is not None:
        free &= ~fixed.to(free.device)
    offset = scene.T_world_root.new_zeros(B, T, P, DOFS)
    if not bool(free.any()):
        return offset
    wishes = wishes.of_those(free)
    before = None if past is None else past.offset
    ramp = past is not None and before is None
    if ramp:
        before = offset.new_zeros(B, LEAD, P, DOFS)
    smooth = Smoothness(settle, free, before, offset)
    if toward is not None and bool(toward.any()):
        smooth.start = smooth.toward(torch.where(free[..., None], toward, 0.0))
    if before is not None:
        offset = torch.where(free[..., None], before[:, -1:], offset)
    offset = offset + smooth.start if guess is None else guess
    rest = body.rest_joints(scene.betas[:, None])
    capsules = with_measured(fit_capsules(body, scene.betas), rest)
    few = (free.sum(dim=(1, 2)) <= SOLVED_AT_ONCE).view(B, 1, 1, 1)  # no scene depends on the others
    done = torch.zeros_like(few)
    goals = Goals.of(wishes, free, settle)
    for _ in range(settle.iterations):
        R_world, joints = body.bone_chain(*moved(scene.body_rot, scene.T_world_root, offset), rest)
        seen = Seen(R_world.flatten(0, 2), joints.flatten(0, 2), capsules.posed(R_world, joints), joints)
        residuals = all_residuals(seen, capsules, goals, wishes.contact)
        if ramp:
            grown = ((residuals.node // P % T + 1) / RAMP).clamp(max=1.0)
            residuals = residuals._replace(root_weight=residuals.root_weight * grown)
        step = torch.where(done, 0.0, step_of(residuals, *slopes(seen, residuals), smooth, offset, few, settle.inner))
        size = step.abs().amax(dim=(1, 2, 3), keepdim=True)
        offset = offset + step * (settle.most / size.clamp_min(settle.most))
        done = done | (few & (size < SMALL))
        if bool(done.all()):
            break
    return offset


def step_of(
    residuals: Residuals, first: Tensor, second: Tensor, smooth: Smoothness, offset: Tensor, few: Tensor, inner: int
) -> Tensor:
    """One Gauss-Newton step: at once in scenes in which `few` poses may move, by conjugate gradients in others.

    few (B, 1, 1, 1) bool; other arguments as for `solve`. -> (B, T, P, DOFS)
    """
    if bool(few.all()):
        return exact_step(residuals, first, second, smooth, offset)
    step = solve(residuals, first, second, smooth, offset, inner)
    if not bool(few.any()):
        return step
    mine = few.flatten()[residuals.node // (offset.shape[1] * offset.shape[2])]
    return torch.where(few, exact_step(residuals.kept(mine), first[mine], second[mine], smooth, offset), step)
