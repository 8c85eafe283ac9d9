"""What a correction has not met yet: lengths in metres along directions between two points, weighted."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from magnet.body.capsules import nearest_points
from magnet.body.energy import Contact, allowed_between_measured, allowed_within, hand_points
from magnet.body.fitted_capsules import FittedCapsules
from magnet.body.indices import indices, pairs_of, picked
from magnet.body.joints import FEET, TOES
from magnet.body.settle_goals import BONES, WEIGHTS, Goals
from magnet.waiting import constant

NEAR = 0.03
"""Metres short of counting at which capsules are kept: a step may make them count."""

BODY_REACH = 1.6
"""Metres between pelvises beyond which bodies cannot touch, even with arms half stretched out."""

SWUNG, DRAGS, QUICKENS = 0.03, 0.3, 0.6
"""Metres over where it stands that a toe is swung at high speed; m/s up to which it may stay down, and over which it
comes near that height (`swung`)."""


@dataclass(frozen=True)
class Seen:
    """Poses; a node is one person in one frame, in the order (B, T, P)."""

    R_world: Tensor  # (nodes, 22, 3, 3)
    joints: Tensor  # (nodes, 22, 3)
    ends: Tensor  # (B, T, P, K, 2, 3) of capsules
    by_frame: Tensor  # (B, T, P, 22, 3) the same joints


class Residuals(NamedTuple):
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

    def kept(self, keep: Tensor | slice) -> Residuals:
        """Some of the residuals. keep (M,) bool, or which of them"""
        return Residuals(*(each[keep] for each in self))


def cat(parts: list[Residuals]) -> Residuals:
    """Residuals of several kinds as one."""
    return Residuals(*(torch.cat(field) for field in zip(*parts, strict=True)))


def all_residuals(seen: Seen, capsules: FittedCapsules, goals: Goals, contact: Contact) -> Residuals:
    """How far people who can move are from their goals, and how deep in each other and themselves."""
    return cat([touching(seen, capsules, goals, contact), unmet(seen, goals)])


def unmet(seen: Seen, goals: Goals) -> Residuals:
    """Residuals of the goals' rows, then of lower feet: they come down to the floor, and nobody's rises."""
    points = torch.cat([seen.joints, hand_points(seen.joints)], dim=1)
    rows, bones, feet = goals.rows, indices(BONES, points.device), indices(FEET, points.device)
    height = points[goals.float_node[:, None], feet, 1] - goals.clearance
    lowest, which = height.min(dim=-1)
    foot = feet[which]
    sole = points[goals.float_node, foot]
    up = constant((0.0, 1.0, 0.0), rows.along).expand(len(foot), 3)
    point, other = points[rows.node, rows.place], points[rows.other, rows.other_place]
    value = ((point - other * rows.two[:, None]) * rows.along).sum(-1) - rows.goal
    weight = rows.root_weight
    hands, pull = 3 * goals.holds, goals.settle.pull
    if hands and pull < torch.inf:
        off = value[:hands].view(-1, 3).norm(dim=-1).clamp_min(pull)
        weight = torch.cat([weight[:hands] * (pull / off).sqrt().repeat_interleave(3), weight[hands:]])
    if goals.settle.swing:
        value, weight = lifted(value, weight, seen, goals)
    own = Residuals(
        rows.node,
        bones[rows.place],
        point,
        rows.other,
        bones[rows.other_place],
        other,
        rows.along,
        value,
        weight,
        rows.two,
        rows.one_sided,
    )
    over = lowest - goals.highest
    cost = torch.full_like(over, (WEIGHTS["float"] * goals.settle.hard) ** 0.5)
    alone, one_sided = torch.zeros_like(over), torch.ones_like(over, dtype=torch.bool)
    node = goals.float_node
    floating = Residuals(node, foot, sole, node, foot, sole, up, over, cost, alone, one_sided)
    return cat([own, floating])


def lifted(value: Tensor, weight: Tensor, seen: Seen, goals: Goals) -> tuple[Tensor, Tensor]:
    """Values and weights of the goals' rows (M,) where the floor is higher under toes that swing."""
    lift = swung(seen.by_frame, goals.fps, goals.before)[goals.own]  # (nodes that are free, 2)
    lift = torch.cat([torch.zeros_like(lift), lift], dim=1).flatten()  # ankles, toes
    floor = len(value) - len(lift)
    more = 1 + (goals.settle.swing**0.5 - 1) * (lift > 0).to(lift)
    return torch.cat([value[:floor], value[floor:] + lift]), torch.cat([weight[:floor], weight[floor:] * more])


def swung(joints: Tensor, fps: float, before: Tensor | None = None) -> Tensor:
    """How far toes must be lifted over where they stand, by how fast they go. -> (B, T, P, 2) metres

    Of the toes of CMU's dancers a fifth are lower at each speed, that of the slower of two steps.

    Args:
        joints: (B, T, P, 22, 3).
        fps: frames a second.
        before: (B, 1, P, 22, 3) the frame before; None: there is none.
    """
    toes = picked(joints if before is None else torch.cat([before, joints], dim=1), TOES)[..., 0:3:2]
    steps = F.pad(toes.diff(dim=1).norm(dim=-1) * fps, (0, 0, 0, 0, int(before is None), 1), value=torch.inf)
    speed = torch.minimum(steps[:, 1:], steps[:, :-1])
    speed = torch.where(speed.isfinite(), speed, 0.0)  # of a single frame nothing is known
    return SWUNG * (1 - torch.exp((DRAGS - speed).clamp(max=0) / QUICKENS))


@functools.cache
def limits(contact: Contact, device: torch.device) -> Tensor:
    """Depths allowed between two people, then within one body; infinite: not compared. -> (2, K, K) metres

    Kept, because every step of every correction asks for them.
    """
    with torch.inference_mode(False):
        between, own = allowed_between_measured(contact), allowed_within(contact)
        within = torch.full_like(between, torch.inf)
        within[: len(own), : len(own)] = own
        return torch.stack([between, within]).to(device)


def touching(seen: Seen, capsules: FittedCapsules, goals: Goals, contact: Contact) -> Residuals:
    """Residuals of capsules deeper than allowed, or nearly so: of two people, not both of them fixed, and of one."""
    T, P = seen.by_frame.shape[1:3]
    first, second = pairs_of(P, seen.joints.device)
    pelvis = seen.by_frame[..., 0, :]
    near = (pelvis[:, :, first] - pelvis[:, :, second]).norm(dim=-1) < BODY_REACH
    b, t, pair = (near & goals.both).nonzero(as_tuple=True)
    count = len(b)
    b, t, p, q = (
        torch.cat([x, y]) for x, y in zip((b, t, first[pair], second[pair]), (*goals.own, goals.own[2]), strict=True)
    )
    allowed = limits(contact, b.device)
    allowed = torch.cat([allowed[:1].expand(count, -1, -1), allowed[1:].expand(len(b) - count, -1, -1)])
    bones = indices(capsules.bones, b.device)
    node, others = (b * T + t) * P + p, (b * T + t) * P + q
    ends = seen.ends.flatten(0, 2)
    one, other = ends[node], ends[others]  # (M, K, 2, 3)
    reach = capsules.radius[b, p], capsules.radius[b, q]
    m, i, j = meeting(one, other, *reach, allowed.to(one)).nonzero(as_tuple=True)
    one, other = one[m, i], other[m, j]
    first, second = nearest_points(one[:, 0], one[:, 1], other[:, 0], other[:, 1])
    apart = first - second
    length = apart.norm(dim=-1)
    depth = reach[0][m, i] + reach[1][m, j] - length - allowed[m, i, j].to(one)
    kept = (depth > -NEAR).nonzero()[:, 0]
    m, i, j, first, second, apart, length, depth = (x[kept] for x in (m, i, j, first, second, apart, length, depth))
    away, cross = apart / length.clamp_min(0.005)[:, None], length <= 0.005
    if bool(cross.any()):
        pelvis = pelvis.flatten(0, 2)[node[m]] - pelvis.flatten(0, 2)[others[m]]
        axis = one[kept, 1] - one[kept, 0]
        away = torch.where(cross[:, None], off_axis(pelvis * constant((1.0, 0.0, 1.0), pelvis), axis), away)
    cost = torch.where(m < count, (WEIGHTS["between"] * goals.settle.hard) ** 0.5, WEIGHTS["within"] ** 0.5).to(depth)
    always = torch.ones_like(depth)
    # The value is the depth; moving along `away` reduces it.
    return Residuals(node[m], bones[i], first, others[m], bones[j], second, -away, depth, cost, always, always.bool())


def meeting(one: Tensor, other: Tensor, radius: Tensor, other_radius: Tensor, allowed: Tensor) -> Tensor:
    """Which capsules may be near enough to count: the balls around them are. -> (M, K, K) bool

    Args:
        one, other: (M, K, 2, 3) ends of two people's capsules.
        radius, other_radius: (M, K) metres.
        allowed: (M, K, K) metres of depth that are none.
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
    up = axis.new_tensor([0.0, 1.0, 0.0])
    beside = torch.linalg.cross(axis, up.expand_as(axis), dim=-1)
    across = pelvis - (pelvis * axis).sum(dim=-1, keepdim=True) * axis
    return torch.nn.functional.normalize(across + 0.1 * beside + axis.new_tensor([1e-6, 0.0, 0.0]), dim=-1)
