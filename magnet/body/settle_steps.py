"""Steps of damped least squares: what corrections cost over time, and the step that all residuals count for."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from magnet.body.settle_options import Settle
from magnet.body.settle_residuals import Residuals

FOLLOWS = 20.0
"""Cost of a squared metre between where people are to be moved and a smooth path there."""

ROUNDS = 2
"""How often it is found out in a Gauss-Newton step which one-sided residuals count."""

TOGETHER = 8
"""Scenes whose steps are solved together."""

STIFF = 1e9
"""Cost that no correction pays."""

SOFT = 0.005
"""Metres around 0 over which a one-sided residual comes to count: a hair's breadth must not decide about a step."""

SHIFTED, TILTED, SHRUGGED = slice(0, 3), slice(3, 9), slice(9, 15)
"""Places among the numbers that correct a pose (`magnet.body.settle.DOFS`): the root's shift, turns of the pelvis and
the back, turns of the collars."""

DONE = 1e-10
"""Squared norm of the preconditioned residual at which conjugate gradients stop."""


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
        like: (B, T, P, DOFS) of the dtype and device of corrections.
    """

    def __init__(self, settle: Settle, free: Tensor, past: Tensor | None, like: Tensor) -> None:
        self.past, self.lead = past, 0 if past is None else past.shape[1]
        self.start = torch.zeros_like(like)  # corrections that cost nothing
        self.scale = torch.ones(like.shape[-1], dtype=like.dtype, device=like.device)
        self.scale[SHIFTED], self.scale[TILTED] = settle.root, settle.tilt
        self.scale[SHRUGGED] = min(settle.shrug, STIFF)
        self.scale[1] *= settle.lift  # along y
        whole = stiffness(settle, self.lead + free.shape[1])
        # In double precision: it ends nearly in nothing where a correction is smooth, and threads split its sums.
        self.cost = whole.to(like.device)[self.lead :]  # (T, L + T)
        keep = free.transpose(1, 2)  # (B, P, T)
        self.free = keep[..., None] & keep[..., None, :]
        self.undone = self.inverse(0.0) * self.free  # (B, P, T, T), 0 for whoever is fixed

    def inverse(self, pull: float) -> Tensor:
        """Inverse of one number's cost with `pull` added for each frame. -> (B, P, T, T)"""
        T = self.cost.shape[0]
        own = self.cost[:, self.lead :]
        eye = torch.eye(T, dtype=own.dtype, device=own.device)
        # Not linalg.inv: torch's batched LU fails on more than 150 rows with several threads (pytorch issue 142815).
        return torch.cholesky_inverse(torch.linalg.cholesky(torch.where(self.free, own + pull * eye, eye)))

    def toward(self, ground: Tensor) -> Tensor:
        """A smooth correction that moves people about so far over the ground. (B, T, P, 2) metres -> (B, T, P, DOFS)"""
        pull = FOLLOWS / float(self.scale[0])
        offset = ground.new_zeros(*ground.shape[:3], len(self.scale))
        offset[..., [0, 2]] = pull * (self.inverse(pull) @ ground.transpose(1, 2).double()).transpose(1, 2).to(ground)
        return offset

    def __call__(self, offset: Tensor) -> Tensor:
        """The cost's matrix times an offset. (B, T, P, DOFS) -> same"""
        return (self.cost[:, self.lead :] @ offset.flatten(2).double()).to(offset).view_as(offset) * self.scale

    def slope(self, offset: Tensor) -> Tensor:
        """The gradient of the cost, the past's corrections included, with `start` free. (B, T, P, DOFS) -> same"""
        offset = offset - self.start
        whole = offset if self.past is None else torch.cat([self.past, offset], dim=1)
        return (self.cost @ whole.flatten(2).double()).to(offset).view_as(offset) * self.scale

    @functools.cached_property
    def moves(self) -> Tensor:
        """Whether each node may move. -> (B T P,) bool"""
        return self.free.diagonal(dim1=2, dim2=3).transpose(1, 2).flatten()

    @functools.cached_property
    def linked(self) -> Tensor:
        """How far a force on a node moves another, times `scale`: 0 between two people. -> (B, T P, T P)"""
        B, P, T, _ = self.undone.shape
        whole = self.scale.new_zeros(B, T, P, T, P)
        whole.diagonal(dim1=2, dim2=4).copy_(self.undone.permute(0, 2, 3, 1))
        return whole.view(B, T * P, T * P)

    def undo(self, force: Tensor) -> Tensor:
        """The inverse of the cost's matrix times a force. (B, T, P, DOFS) -> same"""
        return (self.undone @ force.transpose(1, 2).double()).transpose(1, 2).to(force) / self.scale


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
        flat = step.view(-1, step.shape[-1])
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
        return (slope * x.reshape(-1, x.shape[-1]).index_select(0, node)).sum(-1).view(2, M).sum(0)

    def back(u: Tensor) -> Tensor:
        force = slope * u.repeat(2)[:, None]
        return torch.zeros_like(offset).view(-1, shape[-1]).index_add_(0, node, force).view(shape)

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


def exact_step(residuals: Residuals, first: Tensor, second: Tensor, smooth: Smoothness, offset: Tensor) -> Tensor:
    """The same step as `solve`, without conjugate gradients: by as many unknowns as there are residuals.

    By Woodbury's identity: with C the cost of corrections, J the slopes and r the residuals, the step is d - C^-1 J' l,
    where d = -C^-1 (its slope so far) is the step without any residuals and l solves (1 + J C^-1 J') l = r + J d. For
    few poses: J C^-1 J' of all residuals of a scene is formed.

    Arguments as for `solve`. -> (B, T, P, DOFS)
    """
    a, b = residuals.node, residuals.other
    free = -smooth.undo(smooth.slope(offset))
    if not len(a):
        return free
    flat = free.flatten(0, 2)
    moves = (first * flat[a]).sum(-1) - (second * flat[b]).sum(-1)
    force, ends = torch.zeros_like(moves), Ends.of(residuals, first, second, smooth.moves)
    for group in alike(a // (offset.shape[1] * offset.shape[2]), len(offset)):
        force[group.rows] = forces(residuals, ends, moves, smooth, group)
    pull = torch.zeros_like(flat).index_add_(0, a, first * force[:, None]).index_add_(0, b, second * -force[:, None])
    return free - smooth.undo(pull.view_as(offset))


class Group(NamedTuple):
    """Residuals of a few scenes with about as many each: their numbers, and the place of each within its scene."""

    rows: Tensor | slice  # (R,) int
    scene: Tensor | None  # (R,) int, of S scenes; None: there is one
    place: Tensor | None  # (R,) int, under M
    size: tuple[int, int]  # S, M

    def each(self, x: Tensor) -> Tensor:
        """Scene by scene, zeros behind a scene's own. (all residuals, ...) -> (S, M, ...)"""
        if self.scene is None or self.place is None:
            return x[None]
        return x.new_zeros(*self.size, *x.shape[1:]).index_put((self.scene, self.place), x[self.rows])

    def all_of(self, x: Tensor) -> Tensor:
        """Back again. (S, M) -> (R,)"""
        return x[0] if self.scene is None or self.place is None else x[self.scene, self.place]


def alike(scene: Tensor, scenes: int) -> Iterator[Group]:
    """Residuals of `TOGETHER` scenes at a time. scene (M,) int"""
    if scenes == 1:
        yield Group(slice(None), None, None, (1, len(scene)))
        return
    count = torch.bincount(scene, minlength=scenes)
    begin = count.cumsum(0) - count
    by_scene = scene.argsort(stable=True)
    for few in count.argsort(stable=True).split(TOGETHER):
        number = torch.arange(len(few), device=scene.device).repeat_interleave(count[few])
        place = torch.arange(len(number), device=scene.device) - (count[few].cumsum(0) - count[few])[number]
        yield Group(by_scene[begin[few][number] + place], number, place, (len(few), int(count[few].max())))


class Ends(NamedTuple):
    """The ends of M residuals that a step moves: what is fixed, and a second end on one node, would only cost time.

    In double precision: what nearly cancels, as of a foot that stands, would round to what is not positive.
    """

    node: Tensor  # (M,) int
    slope: Tensor  # (M, DOFS)
    two: Tensor  # (M,) bool, whether another node is moved, too
    other: Tensor  # (M,) int
    other_slope: Tensor  # (M, DOFS) 0 where it is not

    @classmethod
    def of(cls, residuals: Residuals, first: Tensor, second: Tensor, moves: Tensor) -> Ends:
        """Of residuals and their slopes (M, DOFS) at either end. moves (nodes,) bool, who may move"""
        node, other, second = residuals.node, residuals.other, second.double()
        here, same = moves[node], node == other
        two = here & moves[other] & ~same
        slope = torch.where(here[:, None], first, 0.0) - torch.where((same | ~here)[:, None], second, 0.0)
        return cls(torch.where(here, node, other), slope, two, other, torch.where(two[:, None], -second, 0.0))


def forces(residuals: Residuals, ends: Ends, moves: Tensor, smooth: Smoothness, group: Group) -> Tensor:
    """How hard the residuals of a group pull. -> (R,)

    Args:
        residuals, smooth: as for `exact_step`.
        ends: of the residuals.
        moves: (M,) how much the step without residuals changes them, times the square root of the weight.
    """
    M = group.size[1]
    both = group.each(ends.two).any(dim=0).nonzero()[:, 0]  # (K,) places whose second end moves, too
    node = torch.cat([group.each(ends.node), group.each(ends.other)[:, both]], dim=1)  # (S, M + K)
    slope = torch.cat([group.each(ends.slope), group.each(ends.other_slope)[:, both]], dim=1)
    nodes = smooth.linked.shape[1]
    linked = smooth.linked.flatten(0, 1)[node].mT  # (S, T P, M + K)
    linked = linked.flatten(0, 1)[node % nodes + nodes * torch.arange(len(node), device=node.device)[:, None]]
    gram = ((slope / smooth.scale) @ slope.mT).mul_(linked)
    gram = gram[:, :M].index_add_(1, both, gram[:, M:])
    gram = gram[..., :M].index_add_(2, both, gram[..., M:])
    value, weight, free = group.each(residuals.value), group.each(residuals.root_weight), group.each(moves)
    one_sided, moved = group.each(residuals.one_sided), torch.zeros_like(free)
    divisor = weight.clamp_min(1e-12)
    for _ in range(ROUNDS):
        share = torch.where(one_sided, ((value + moved / divisor) / SOFT / 2 + 0.5).clamp(0, 1), 1.0)
        counts = share.any(dim=0).nonzero()[:, 0]  # (C,) places; others would only make the matrix larger
        part = share[:, counts]
        # Twice by rows, of what is the same across: quicker than by rows and columns.
        whole = gram.index_select(1, counts).mT.contiguous().index_select(1, counts)
        whole = whole.mul_(part[:, :, None]).mul_(part[:, None])
        whole.diagonal(dim1=1, dim2=2).add_(1.0)
        short = part * (value * weight + free)[:, counts]
        pull = part * torch.cholesky_solve(short.double()[..., None], torch.linalg.cholesky(whole))[..., 0]
        force = torch.zeros_like(gram[..., 0]).index_copy_(1, counts, pull)
        moved = free - (gram @ force[..., None])[..., 0].to(free)
    return group.all_of(force.to(moves))
