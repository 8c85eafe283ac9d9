"""Wishes as residuals of a least-squares problem: lengths in metres along directions between two points, weighted."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from magnet.body.capsules import nearest_points
from magnet.body.energy import Contact, allowed_between_measured, allowed_within, hand_points
from magnet.body.fitted_capsules import FittedCapsules
from magnet.body.joints import FEET, TOES, WRISTS
from magnet.body.settle_wishes import Wishes

WEIGHTS = {"between": 200.0, "within": 15.0, "hold": 10.0, "stand": 60.0, "height": 30.0, "floor": 30.0, "float": 60.0}
"""Cost of a squared metre of each kind of residual."""

ONE_SIDED = ("between", "within", "floor", "float")

NEAR = 0.03
"""Metres short of counting at which one-sided residuals are kept: a step may make them count."""

REACH = 1.6
"""Metres between pelvises beyond which bodies cannot touch, even with arms half stretched out."""


@dataclass(frozen=True)
class Seen:
    """Poses; a node is one person in one frame, in the order (B, T, P)."""

    R_world: Tensor  # (nodes, 22, 3, 3)
    joints: Tensor  # (nodes, 22, 3)
    ends: Tensor  # (B, T, P, K, 2, 3) of capsules
    by_frame: Tensor  # (B, T, P, 22, 3) the same joints

    def node(self, b: Tensor, t: Tensor, p: Tensor) -> Tensor:
        """Numbers of nodes. (M,) int"""
        T, P = self.by_frame.shape[1:3]
        return (b * T + t) * P + p


@dataclass(frozen=True)
class Residuals:
    """M residuals: `value` is to become 0, and changes by along . (d point - d other_point).

    One-sided residuals, of depth and of feet over and under the floor, count only while they are positive.
    """

    node: Tensor  # (M,) int
    bone: Tensor
    point: Tensor  # (M, 3) in the world
    other: Tensor
    other_bone: Tensor
    other_point: Tensor
    along: Tensor  # (M, 3) of unit length
    value: Tensor  # (M,) metres
    root_weight: Tensor  # (M,)
    two: Tensor  # (M,) 1: the other point moves, too; 0: it is the floor
    one_sided: Tensor  # (M,) bool

    def kept(self, keep: Tensor) -> Residuals:
        """Some of the residuals. keep (M,) bool"""
        return Residuals(*(getattr(self, f.name)[keep] for f in fields(self)))


def cat(parts: list[Residuals]) -> Residuals:
    """Residuals of several kinds as one."""
    return Residuals(*(torch.cat([getattr(part, f.name) for part in parts]) for f in fields(Residuals)))


def residuals_of(
    kind: str,
    node: Tensor,
    bone: Tensor,
    point: Tensor,
    along: Tensor,
    value: Tensor,
    other: tuple[Tensor, Tensor, Tensor] | None = None,
) -> Residuals:
    """Residuals of one kind; `other` is (node, bone, point), None the floor."""
    two = torch.full_like(value, float(other is not None))
    weight = torch.full_like(value, WEIGHTS[kind] ** 0.5)
    one_sided = torch.full_like(value, kind in ONE_SIDED, dtype=torch.bool)
    return Residuals(node, bone, point, *(other or (node, bone, point)), along, value, weight, two, one_sided)


def all_residuals(
    seen: Seen,
    capsules: FittedCapsules,
    wishes: Wishes,
    free: Tensor,
    stand: float = 1.0,
    hold: float = 1.0,
    pull: float = math.inf,
    hard: float = 1.0,
) -> Residuals:
    """All unmet wishes of people who can move.

    wishes: `Wishes.of_those` who are free (B, T, P) bool; stand, hold, pull, hard: see `Settle`.
    """
    return cat(
        [
            weighted(between_residuals(seen, capsules, wishes, free), hard),
            within_residuals(seen, capsules, wishes, free),
            weighted(hold_residuals(seen, wishes, pull), hold),
            stand_residuals(seen, wishes, stand),
            height_residuals(seen, wishes),
            floor_residuals(seen, wishes, free),
            weighted(float_residuals(seen, wishes, free), hard),
        ]
    )


def weighted(residuals: Residuals, factor: float | Tensor) -> Residuals:
    """The residuals with their cost times a factor, one or (M,)."""
    return replace(residuals, root_weight=residuals.root_weight * factor**0.5)


@functools.cache
def limits(kind: str, contact: Contact, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Depths (K, K) in metres that are allowed, and the L pairs of capsules that have a limit, (L,) int x 2.

    Kept, because every step of every correction asks for them.
    """
    with torch.inference_mode(False):
        allowed = (allowed_between_measured if kind == "between" else allowed_within)(contact).to(device)
        i, j = allowed.isfinite().nonzero(as_tuple=True)
    return allowed, i, j


def touching(
    seen: Seen, capsules: FittedCapsules, pairs: tuple[Tensor, Tensor, Tensor, Tensor], contact: Contact, kind: str
) -> Residuals:
    """Residuals of capsules deeper than allowed, or nearly so. pairs: (M,) b, t and the two people"""
    b, t, p, q = pairs
    allowed, i, j = limits(kind, contact, b.device)
    bones = torch.tensor(capsules.bones, device=b.device)
    K = len(allowed)
    one, other = seen.ends[b, t, p, :K], seen.ends[b, t, q, :K]  # (M, K, 2, 3)
    reach = (capsules.radius[b, p, :K], capsules.radius[b, q, :K], allowed.to(one))
    m, k = meeting(one, other, *reach)[:, i, j].nonzero(as_tuple=True)
    i, j = i[k], j[k]
    first, second = nearest_points(one[m, i, 0], one[m, i, 1], other[m, j, 0], other[m, j, 1])
    apart = first - second
    length = apart.norm(dim=-1)
    depth = reach[0][m, i] + reach[1][m, j] - length - reach[2][i, j]
    near = depth > -NEAR
    m, i, j, first, second, apart, length, depth = (x[near] for x in (m, i, j, first, second, apart, length, depth))
    away, cross = apart / length.clamp_min(0.005)[:, None], length <= 0.005
    if bool(cross.any()):
        pelvis = (seen.by_frame[b[m], t[m], p[m], 0] - seen.by_frame[b[m], t[m], q[m], 0]) * torch.tensor(
            [1.0, 0.0, 1.0]
        ).to(one)
        away = torch.where(cross[:, None], off_axis(pelvis, one[m, i, 1] - one[m, i, 0]), away)
    node, others = seen.node(b, t, p)[m], seen.node(b, t, q)[m]
    # The value is the depth; moving along `away` reduces it.
    return residuals_of(kind, node, bones[i], first, -away, depth, (others, bones[j], second))


def meeting(one: Tensor, other: Tensor, radius: Tensor, other_radius: Tensor, allowed: Tensor) -> Tensor:
    """Which capsules may be near enough to count: the balls around them are. -> (M, K, K) bool

    Args:
        one, other: (M, K, 2, 3) ends of two people's capsules.
        radius, other_radius: (M, K) metres.
        allowed: (K, K) metres of depth that are none.
    """
    balls = [(ends.mean(dim=-2), (ends[..., 1, :] - ends[..., 0, :]).norm(dim=-1) / 2) for ends in (one, other)]
    apart = torch.cdist(balls[0][0], balls[1][0], compute_mode="donot_use_mm_for_euclid_dist")
    sizes = (balls[0][1] + radius)[..., None] + (balls[1][1] + other_radius)[..., None, :]
    return sizes - apart - allowed > -NEAR - 1e-4


def off_axis(pelvis: Tensor, axis: Tensor) -> Tensor:
    """The way out for capsules whose axes cross: no direction leads from one to the other. (M, 3) x 2 -> (M, 3)

    People part along the line between their pelvises, but not along the limb itself.
    """
    axis = torch.nn.functional.normalize(axis, dim=-1)
    pelvis = torch.nn.functional.normalize(pelvis, dim=-1)
    beside = torch.linalg.cross(axis, axes(1, axis)[[1]].expand_as(axis), dim=-1)
    across = pelvis - (pelvis * axis).sum(dim=-1, keepdim=True) * axis
    return torch.nn.functional.normalize(across + 0.1 * beside + 1e-6 * axes(1, axis)[0], dim=-1)


def between_residuals(seen: Seen, capsules: FittedCapsules, wishes: Wishes, free: Tensor) -> Residuals:
    """Depth between people, not both of whom are fixed."""
    first, second = pairs_of(seen)
    pelvis = seen.by_frame[..., 0, :]
    near = (pelvis[:, :, first] - pelvis[:, :, second]).norm(dim=-1) < REACH
    both = (wishes.present[:, first] & wishes.present[:, second])[:, None] & (free[..., first] | free[..., second])
    b, t, pair = (near & both).nonzero(as_tuple=True)
    return touching(seen, capsules, (b, t, first[pair], second[pair]), wishes.contact, "between")


def pairs_of(seen: Seen) -> tuple[Tensor, Tensor]:
    """The people of each pair, in the order of `combinations`. -> (Q,) x 2"""
    people = torch.arange(seen.by_frame.shape[2], device=seen.joints.device)
    first, second = torch.combinations(people).unbind(dim=1)
    return first, second


def within_residuals(seen: Seen, capsules: FittedCapsules, wishes: Wishes, free: Tensor) -> Residuals:
    """Depth of each body in itself."""
    b, t, p = free.nonzero(as_tuple=True)
    return touching(seen, capsules, (b, t, p, p), wishes.contact, "within")


def axes(count: int, like: Tensor) -> Tensor:
    """The world's axes, `count` times. -> (3 * count, 3)"""
    return torch.eye(3).to(like).repeat(count, 1)


def hold_residuals(seen: Seen, wishes: Wishes, pull: float = math.inf) -> Residuals:
    """Hands that hold each other keep their distance vector; farther off than `pull` metres they pull no harder."""
    wrists = torch.tensor(WRISTS, device=seen.joints.device)
    hands, (first, second) = hand_points(seen.by_frame), pairs_of(seen)
    b, t, pair, i, j = wishes.held.nonzero(as_tuple=True)
    p, q = first[pair], second[pair]
    point, other = hands[b, t, p, i], hands[b, t, q, j]
    off = point - other - wishes.between[b, t, pair, i, j]
    node, bone, end = (x.repeat_interleave(3, dim=0) for x in (seen.node(b, t, p), wrists[i], point))
    others, other_bone, other_end = (x.repeat_interleave(3, dim=0) for x in (seen.node(b, t, q), wrists[j], other))
    reach = (others, other_bone, other_end)
    residuals = residuals_of("hold", node, bone, end, axes(len(b), off), off.flatten(), reach)
    if math.isinf(pull):
        return residuals
    return weighted(residuals, (pull / off.norm(dim=-1).clamp_min(pull)).repeat_interleave(3))


def stand_residuals(seen: Seen, wishes: Wishes, cost: float = 1.0) -> Residuals:
    """Standing feet stay where they are on the floor from a frame to the next.

    Both ways along the floor count: less than that, such as the speed alone, lets feet go sideways as each step of the
    solver turns.
    """
    b, t, p, i = wishes.stands.nonzero(as_tuple=True)
    feet = torch.tensor(FEET, device=b.device)[i]
    before, after = seen.by_frame[b, t, p, feet], seen.by_frame[b, t + 1, p, feet]
    node = seen.node(b, t, p).repeat_interleave(2)
    other = node, feet.repeat_interleave(2), before.repeat_interleave(2, dim=0)
    part = kept_on_floor(seen.node(b, t + 1, p), feet, after, before[:, [0, 2]], cost, other)
    if wishes.stood is None:
        return part
    b, p, i = wishes.stood.isfinite().all(dim=-1).nonzero(as_tuple=True)
    feet = torch.tensor(FEET, device=b.device)[i]
    node, now = seen.node(b, torch.zeros_like(b), p), seen.by_frame[b, 0, p, feet]
    return cat([part, kept_on_floor(node, feet, now, wishes.stood[b, p, i], cost)])


def kept_on_floor(
    node: Tensor,
    bone: Tensor,
    point: Tensor,
    place: Tensor,
    cost: float,
    other: tuple[Tensor, Tensor, Tensor] | None = None,
) -> Residuals:
    """Two residuals for each of M points that shall be at a place on the floor. point (M, 3), place (M, 2)

    other: whose point the place is, see `residuals_of`; None: nobody's.
    """
    node, bone, point = (x.repeat_interleave(2, dim=0) for x in (node, bone, point))
    off = (point[::2, [0, 2]] - place).flatten()
    along = axes(1, point)[[0, 2]].repeat(len(place), 1)
    return weighted(residuals_of("stand", node, bone, point, along, off, other), cost)


def height_residuals(seen: Seen, wishes: Wishes) -> Residuals:
    """Low toes keep their height."""
    b, t, p, i = wishes.heights.isfinite().nonzero(as_tuple=True)
    toes = torch.tensor(TOES, device=b.device)[i]
    point = seen.by_frame[b, t, p, toes]
    up = axes(1, point)[1].expand(len(b), 3)
    return residuals_of("height", seen.node(b, t, p), toes, point, up, point[:, 1] - wishes.heights[b, t, p, i])


def floor_residuals(seen: Seen, wishes: Wishes, free: Tensor) -> Residuals:
    """Soles are not under the floor."""
    feet = torch.tensor(FEET, device=seen.joints.device)
    depth = wishes.clearance[:, None] - seen.by_frame[..., FEET, 1]  # (B, T, P, 4)
    b, t, p, i = ((depth > -NEAR) & free[..., None]).nonzero(as_tuple=True)
    down = -axes(1, depth)[1].expand(len(b), 3)
    return residuals_of("floor", seen.node(b, t, p), feet[i], seen.by_frame[b, t, p, feet[i]], down, depth[b, t, p, i])


def float_residuals(seen: Seen, wishes: Wishes, free: Tensor) -> Residuals:
    """The lower foot of a floating person comes down to the floor, and nobody's rises."""
    height = seen.by_frame[..., FEET, 1] - wishes.clearance[:, None]
    lowest, which = height.min(dim=-1)
    over = lowest - wishes.highest
    b, t, p = ((over > -NEAR) & free).nonzero(as_tuple=True)
    feet = torch.tensor(FEET, device=b.device)[which[b, t, p]]
    up = axes(1, height)[1].expand(len(b), 3)
    return residuals_of("float", seen.node(b, t, p), feet, seen.by_frame[b, t, p, feet], up, over[b, t, p])
