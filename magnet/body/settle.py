"""Damped least squares over the poses of several people: out of each other, hands held, feet still, on the floor.

Root, legs, arms and, a little, the back are moved in a window of frames. Corrections are small and smooth in time;
fixed frames and people stay bit-identical.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from magnet.body.base import Body
from magnet.body.fitted_capsules import fit_capsules, with_measured
from magnet.body.joints import ANKLES, ELBOWS, HIPS, KNEES, PARENTS, SHOULDERS, SPINE2
from magnet.body.settle_residuals import Residuals, Seen, all_residuals
from magnet.body.settle_wishes import Wishes
from magnet.motion.frames import rigid
from magnet.motion.rotations import from_rotvec
from magnet.motion.scene import BODY_JOINTS, Scene

MOVED: tuple[int, ...] = (0, SPINE2, *HIPS, *KNEES, *ANKLES, *SHOULDERS, *ELBOWS)
"""Joints that are turned; turning the pelvis turns the whole body."""

DOFS = 3 + 3 * len(MOVED)
"""Numbers that correct a pose: the root's shift in metres, then rotation vectors of the joints `MOVED`, radians."""

LEAD = 2
"""Frames of the past that a correction continues."""

RAMP = 6
"""Frames after a fixed past over which weights grow to their full value."""

FOLLOWS = 20.0
"""Cost of a squared metre between where people are to be moved and a smooth path there."""

WINDOW, AHEAD = 240, 24
"""Frames that are corrected together, and frames after them that are computed and dropped."""

ROUNDS = 2
"""How often it is found out in a Gauss-Newton step which one-sided residuals count."""

SOFT = 0.005
"""Metres around 0 over which a one-sided residual comes to count: a hair's breadth must not decide about a step."""

DONE = 1e-10
"""Squared norm of the preconditioned residual at which conjugate gradients stop."""


@dataclass(frozen=True)
class Settle:
    """How poses are corrected.

    Args:
        iterations: Gauss-Newton steps.
        inner: conjugate gradient steps in each.
        stay: cost of a squared metre or radian of correction.
        speed: cost of its squared change from frame to frame.
        bend: cost of its squared second difference.
        root: factor of these costs for moving the whole body.
        lift: further factor for moving it up or down: where hands are to meet, arms reach and feet stay on the floor.
        tilt: factor for turning the whole body or the back.
        most: largest change of a step, metres or radians.
        stand: factor for the cost of standing feet that move.
        hold: factor for the cost of held hands that part.
        pull: metres that held hands may be off before they pull no harder: a hand far away shall not jerk the body.
        hard: factor for the cost of what must not be: depth between people, feet over the floor.
    """

    iterations: int = 12
    inner: int = 40
    stay: float = 0.05
    speed: float = 0.3
    bend: float = 1000.0
    root: float = 3.0
    lift: float = 1.0
    tilt: float = 3.0
    most: float = 0.15
    stand: float = 1.0
    hold: float = 1.0
    pull: float = math.inf
    hard: float = 1.0


def _ancestry() -> Tensor:
    """Which bones each joint of `MOVED` moves. -> (M, 22) bool"""
    moves = torch.zeros(len(MOVED), BODY_JOINTS, dtype=torch.bool)
    for bone in range(BODY_JOINTS):
        joint = bone
        while joint >= 0:
            if joint in MOVED:
                moves[MOVED.index(joint), bone] = True
            joint = PARENTS[joint]
    return moves


ANCESTRY = _ancestry()


def corrected(scene: Scene, offset: Tensor) -> Scene:
    """The scene with corrected poses; poses with offset 0 stay bit-identical. offset (B, T, P, DOFS)

    Turns are in the frame of each joint's parent before the correction, those of the pelvis in the world.
    """
    turns = from_rotvec(offset[..., 3:].unflatten(-1, (len(MOVED), 3)))
    body_rot = scene.body_rot.clone()
    limbs = [joint - 1 for joint in MOVED[1:]]
    body_rot[..., limbs, :, :] = turns[..., 1:, :, :] @ scene.body_rot[..., limbs, :, :]
    root = scene.T_world_root
    T_world_root = rigid(turns[..., 0, :, :] @ root[..., :3, :3], root[..., :3, 3] + offset[..., :3])
    return scene.with_poses((offset != 0).any(dim=-1), body_rot, T_world_root)


def jacobian(seen: Seen, node: Tensor, bone: Tensor, point: Tensor, along: Tensor) -> Tensor:
    """How far points move along a direction per unit of each number that corrects a pose. -> (M, DOFS)

    Args:
        seen: poses of all nodes; a node is one person in one frame.
        node, bone: (M,) int, the node and the bone that each point is fixed to.
        point, along: (M, 3) in the world.
    """
    joints = list(MOVED)
    parents = [max(PARENTS[joint], 0) for joint in MOVED]
    arm = point[:, None] - seen.joints[:, joints][node]  # (M, joints, 3)
    turn = torch.linalg.cross(arm, along[:, None].expand_as(arm), dim=-1)
    R_world_parent = seen.R_world[:, parents][node]
    own = (R_world_parent * turn[..., None]).sum(dim=-2)
    own[:, 0] = turn[:, 0]
    own = own * ANCESTRY.to(own.device)[:, bone].T[..., None]
    return torch.cat([along, own.flatten(1)], dim=-1)


def stiffness(settle: Settle, frames: int) -> Tensor:
    """Quadratic cost of a correction over time: of itself and of its first two differences. -> (T, T)"""
    eye = torch.eye(frames, dtype=torch.float64)
    total = settle.stay * eye
    for order, cost in ((1, settle.speed), (2, settle.bend)):
        if frames > order:
            change = eye.diff(n=order, dim=0)
            total = total + cost * change.T @ change
    return total


class Smoothness:
    """The cost of corrections, number by number, and its inverse, the preconditioner, which makes every step smooth.

    Args:
        settle: the costs.
        free: (B, T, P) bool, who may move.
        past: (B, L, P, DOFS) corrections just before, which stay; None: none.
    """

    def __init__(self, settle: Settle, free: Tensor, past: Tensor | None, like: Tensor) -> None:
        self.past, self.lead = past, 0 if past is None else past.shape[1]
        self.start = torch.zeros_like(like)  # corrections that cost nothing
        self.scale = torch.ones(DOFS, dtype=like.dtype, device=like.device)
        self.scale[:3], self.scale[3:9] = settle.root, settle.tilt
        self.scale[1] *= settle.lift
        whole = stiffness(settle, self.lead + free.shape[1])
        self.cost = whole.to(like)[self.lead :]  # (T, L + T)
        keep = free.transpose(1, 2)  # (B, P, T)
        self.free = keep[..., None] & keep[..., None, :]
        self.undone = self.inverse(0.0) * self.free  # (B, P, T, T), 0 for whoever is fixed

    def inverse(self, pull: float) -> Tensor:
        """Inverse of one number's cost with `pull` added for each frame. -> (B, P, T, T)"""
        T = self.cost.shape[0]
        own = self.cost[:, self.lead :].double()
        eye = torch.eye(T, dtype=own.dtype, device=own.device)
        # Not linalg.inv: torch's batched LU fails on more than 150 rows with several threads (pytorch issue 142815).
        return torch.cholesky_inverse(torch.linalg.cholesky(torch.where(self.free, own + pull * eye, eye))).to(
            self.cost
        )

    def toward(self, ground: Tensor) -> Tensor:
        """A smooth correction that moves people about so far over the ground. (B, T, P, 2) metres -> (B, T, P, DOFS)"""
        pull = FOLLOWS / float(self.scale[0])
        offset = ground.new_zeros(*ground.shape[:3], DOFS)
        offset[..., [0, 2]] = pull * (self.inverse(pull) @ ground.transpose(1, 2)).transpose(1, 2)
        return offset

    def __call__(self, offset: Tensor) -> Tensor:
        """The cost's matrix times an offset. (B, T, P, DOFS) -> same"""
        return (self.cost[:, self.lead :] @ offset.flatten(2)).view_as(offset) * self.scale

    def slope(self, offset: Tensor) -> Tensor:
        """The gradient of the cost, the past's corrections included, with `start` free. (B, T, P, DOFS) -> same"""
        offset = offset - self.start
        whole = offset if self.past is None else torch.cat([self.past, offset], dim=1)
        return (self.cost @ whole.flatten(2)).view_as(offset) * self.scale

    def undo(self, force: Tensor) -> Tensor:
        """The inverse of the cost's matrix times a force. (B, T, P, DOFS) -> same"""
        return (self.undone @ force.transpose(1, 2)).transpose(1, 2) / self.scale


def solve(
    residuals: Residuals, first: Tensor, second: Tensor, smooth: Smoothness, offset: Tensor, inner: int
) -> Tensor:
    """One Gauss-Newton step. -> (B, T, P, DOFS)

    One-sided residuals count where they are positive before the step, then where they are after it: otherwise what one
    step mends is let go by the next, and depth comes back with every second step.

    Args:
        residuals: M of them.
        first, second: (M, DOFS) their slopes at either end, times the square root of the weight.
        offset: (B, T, P, DOFS) the correction so far.
    """
    a, b, step = residuals.node, residuals.other, torch.zeros_like(offset)
    for _ in range(ROUNDS):
        flat = step.view(-1, DOFS)
        moved = (first * flat[a]).sum(-1) - (second * flat[b]).sum(-1)
        after = residuals.value + moved / residuals.root_weight
        share = torch.where(residuals.one_sided, (after / SOFT / 2 + 0.5).clamp(0, 1), 1.0)
        counts = share.nonzero()[:, 0]
        share = share[counts]
        short = residuals.value[counts] * (residuals.root_weight[counts] * share)
        node = torch.cat([a[counts], b[counts]])
        slope = torch.cat([first[counts] * share[:, None], -second[counts] * share[:, None]])
        step = least_squares(short, node, slope, smooth, offset, step, inner // ROUNDS)
    return step


def least_squares(
    short: Tensor,
    node: Tensor,
    slope: Tensor,
    smooth: Smoothness,
    offset: Tensor,
    step: Tensor,
    inner: int,
) -> Tensor:
    """The step that all residuals count for, by preconditioned conjugate gradients from a first guess `step`.

    Args:
        short: (M,) residuals times the square root of their weights.
        node, slope: (2 M,), (2 M, DOFS) the node at one end of each residual and its slope there, then at the other.
        smooth, offset, step, inner: as for `solve`.
    """
    shape, M = offset.shape, len(short)

    def across(x: Tensor) -> Tensor:
        return (slope * x.reshape(-1, DOFS).index_select(0, node)).sum(-1).view(2, M).sum(0)

    def back(u: Tensor) -> Tensor:
        force = slope * u.expand(2, M).reshape(-1, 1)
        return torch.zeros_like(offset).view(-1, DOFS).index_add_(0, node, force).view(shape)

    def product(x: Tensor, y: Tensor) -> Tensor:
        """Scene by scene, so that scenes do not depend on each other. -> (B, 1, 1, 1)"""
        return (x * y).sum(dim=(1, 2, 3), keepdim=True)

    gradient = back(short + across(step)) + smooth.slope(offset) + smooth(step)
    residual = -gradient
    z = smooth.undo(residual)
    direction, rz = z, product(residual, z)
    for _ in range(inner):
        going = rz > DONE
        if not bool(going.any()):
            break
        turned = back(across(direction)) + smooth(direction)
        length = torch.where(going, rz / product(direction, turned).clamp_min(1e-20), 0.0)
        step = step + length * direction
        residual = residual - length * turned
        z = smooth.undo(residual)
        rz, before = product(residual, z), rz
        direction = z + torch.where(going, rz / before.clamp_min(1e-20), 0.0) * direction
    return step


@torch.no_grad()
def correction(
    scene: Scene,
    body: Body,
    wishes: Wishes,
    fixed: Tensor | None = None,
    settle: Settle | None = None,
    begun: bool = False,
    past: Tensor | None = None,
    toward: Tensor | None = None,
) -> Tensor:
    """The correction of a scene's poses that meets the wishes, for `corrected`. -> (B, T, P, DOFS)

    Args:
        scene: (B, T, P), with shapes of `body`.
        wishes: see `Wishes.of`.
        fixed: (P,), (T, P) or (B, T, P) bool, who must not be moved; None: nobody.
        begun: the motion continues a past that stays, so corrections grow from 0.
        past: (B, 2, P, DOFS) corrections of the two frames before, which are continued; None: see `begun`.
        toward: (B, T, P, 2) metres that people are first moved over the ground: decides who ends on which side.
    """
    T = scene.frames
    if T > WINDOW + AHEAD:
        parts: list[Tensor] = []
        for start in range(0, T, WINDOW):
            stop = min(start + WINDOW + AHEAD, T)
            stay = fixed if fixed is None or fixed.ndim == 1 else fixed[..., start:stop, :]
            push = None if toward is None else toward[:, start:stop]
            more = (stay, settle, begun or start > 0, parts[-1][:, -LEAD:] if parts else past, push)
            made = correction(scene.slice(start, stop), body, wishes.slice(start, stop), *more)
            parts.append(made[:, :WINDOW])
        return torch.cat(parts, dim=1)
    return correct_window(scene, body, wishes, fixed, settle or Settle(), begun, past, toward)


def correct_window(
    scene: Scene,
    body: Body,
    wishes: Wishes,
    fixed: Tensor | None,
    settle: Settle,
    begun: bool,
    past: Tensor | None,
    toward: Tensor | None,
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
    ramp = begun and past is None
    if ramp:
        past = offset.new_zeros(B, LEAD, P, DOFS)
    smooth = Smoothness(settle, free, past, offset)
    if toward is not None and bool(toward.any()):
        smooth.start = smooth.toward(torch.where(free[..., None], toward, 0.0))
    if past is not None:
        offset = torch.where(free[..., None], past[:, -1:], offset)
    offset = offset + smooth.start
    rest = body.rest_joints(scene.betas[:, None])
    capsules = with_measured(fit_capsules(body, scene.betas), rest)
    for _ in range(settle.iterations):
        now = corrected(scene, offset)
        R_world, joints = body.bone_chain(now.body_rot, now.T_world_root, rest)
        seen = Seen(R_world.flatten(0, 2), joints.flatten(0, 2), capsules.posed(R_world, joints), joints)
        residuals = all_residuals(seen, capsules, wishes, free, settle.stand, settle.hold, settle.pull, settle.hard)
        if not len(residuals.node):
            break
        if ramp:
            grown = ((residuals.node // P % T + 1) / RAMP).clamp(max=1.0)
            residuals = replace(residuals, root_weight=residuals.root_weight * grown)
        first = (
            jacobian(seen, residuals.node, residuals.bone, residuals.point, residuals.along)
            * residuals.root_weight[:, None]
        )
        second = jacobian(seen, residuals.other, residuals.other_bone, residuals.other_point, residuals.along)
        second = second * (residuals.root_weight * residuals.two)[:, None]
        step = solve(residuals, first, second, smooth, offset, settle.inner)
        size = step.abs().amax(dim=(1, 2, 3), keepdim=True)
        offset = offset + step * (settle.most / size.clamp_min(settle.most))
    return offset
