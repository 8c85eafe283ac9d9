"""Moves people over the ground so far that their bodies no longer run through each other."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from itertools import combinations

import torch
from torch import Tensor
from torch.nn import functional as F

from magnet.body.capsules import CAPSULES, capsule_segments, nearest_points
from magnet.body.joints import PELVIS
from magnet.motion.scene import FPS

ARMS = [capsule.name.endswith("arm") for capsule in CAPSULES]
"""Capsules of arms, which may overlap: people hold each other and link arms."""

FARTHEST = 0.6
"""Most metres that two people are moved apart: no body is thicker."""

HALVINGS = 7
"""Bisections of `FARTHEST`, which find the distance to half a centimetre."""

FEW_PEOPLE = 8
"""Up to so many people, pairs are treated one by one, each after the moves of the pairs before."""

CROWD_ROUNDS, PAIRS = 4, 64
"""How often all pairs of a crowd are moved, and how many are computed together, which bounds memory."""

CROWD_SPEED = 1.0
"""Speed in m/s at which people in a crowd make way: strangers collide faster than partners."""

ARM_REACH = 2.2
"""Metres between pelvises beyond which no arm reaches the other's trunk, head or legs."""

BRIEF = 75
"""Longest encounter, in frames, approach and end included, that counts as passing each other."""

SMOOTHED = 15
"""Frames before and after that the direction between two people is averaged over."""


@dataclass(frozen=True)
class Apart:
    """How people are kept apart.

    Args:
        body: depth in metres that is allowed between trunks, heads and legs.
        arms: the same between an arm and any of these. Arms may overlap each other without limit.
        ease: frames over which people make way before and after a collision: a running maximum, then a running mean.
        speed: highest speed in m/s of a push where the motion continues a past that stays.
        rounds: passes over all pairs; from three people on, more than one matters.
    """

    body: float = 0.03
    arms: float = 0.05
    ease: int = 8
    speed: float = 0.3
    rounds: int = 2


APART: dict[str, Apart] = {"light": Apart(body=0.06, arms=0.08, speed=0.2), "firm": Apart()}
"""By name: `light` lets people lean on each other, `firm` lets them touch."""


def excess_depth(one: Tensor, other: Tensor, keep: Apart) -> Tensor:
    """How much deeper than allowed two bodies are in each other; negative: the room that is left.

    joints (..., 22, 3) in the world x 2 -> (...) metres, of the deepest pair of capsules
    """
    a, b, radius = capsule_segments(one)
    c, d, _ = capsule_segments(other)
    first, second = nearest_points(a[..., :, None, :], b[..., :, None, :], c[..., None, :, :], d[..., None, :, :])
    arm = _arms(one.device)
    allowed = torch.where(arm[:, None] | arm, keep.arms, keep.body).to(one)
    depth = radius[:, None] + radius - (first - second).norm(dim=-1) - allowed
    return torch.where(arm[:, None] & arm, -torch.inf, depth).amax(dim=(-1, -2))


@functools.cache
def _arms(device: torch.device) -> Tensor:
    with torch.inference_mode(False):  # or training, later, could not use it
        return torch.tensor(ARMS, device=device)


def direction(one: Tensor, other: Tensor, near: Tensor) -> Tensor:
    """Direction over the ground, of unit length, in which one person can leave another.

    It leads from pelvis to pelvis, smoothed over time, and turns slowly. People who pass each other change sides from
    one frame to the next: for a brief encounter the direction is its mean over all frames; and where they end on the
    other side from where they came, what of the mean is across their way. So they step aside or around each other, and
    nobody is pushed through anybody.

    Args:
        one: (B, T, 22, 3) joints in the world.
        other: the same.
        near: (B, T) bool, frames of encounters.

    Returns:
        (B, T, 2)
    """
    between = (one - other)[:, :, PELVIS, [0, 2]]
    smooth = turning_slowly(unit(averaged(between)))
    begins, ends = near & ~F.pad(near, (1, 0))[:, :-1], near & ~F.pad(near, (0, 1))[:, 1:]
    encounter = (begins.cumsum(dim=1) * near)[..., None]  # its number, 0 outside
    most = int(encounter.max()) + 1

    def added(values: Tensor, where: Tensor) -> Tensor:
        """The sum of each encounter's values in some of its frames. (B, T, n), (B, T) bool -> (B, most, n)"""
        empty = values.new_zeros(len(values), most, values.shape[-1])
        return empty.scatter_add(1, encounter.expand_as(values), values * where[..., None])

    frames = added(torch.ones_like(between[..., :1]), near)
    mean, first, last = added(between, near) / frames.clamp_min(1), added(between, begins), added(between, ends)
    passes = (first * last).sum(dim=-1, keepdim=True) < 0
    aside = torch.where(passes, across(mean, last - first), mean)
    brief = near[..., None] & (frames <= BRIEF).gather(1, encounter)
    return torch.where(brief, unit(aside).gather(1, encounter.expand_as(between)), smooth)


def averaged(values: Tensor) -> Tensor:
    """Values averaged over `SMOOTHED` frames before and after. (B, T, n) -> same"""
    padded = F.pad(values.transpose(1, 2), (SMOOTHED, SMOOTHED), mode="replicate")
    return F.avg_pool1d(padded, 2 * SMOOTHED + 1, stride=1).transpose(1, 2)


def turning_slowly(away: Tensor) -> Tensor:
    """Directions whose angle is averaged over time: who walks through another turns over at once. (B, T, 2) -> same"""
    angle = torch.atan2(away[..., 1:], away[..., :1])
    turn = torch.remainder(angle.diff(dim=1) + torch.pi, 2 * torch.pi) - torch.pi
    angle = averaged(torch.cat([angle[:, :1], angle[:, :1] + turn.cumsum(dim=1)], dim=1))
    return torch.cat([angle.cos(), angle.sin()], dim=-1)


def across(vector: Tensor, way: Tensor) -> Tensor:
    """What of a ground vector is across a way; where nothing is, the way's left. (..., 2) x 2 -> (..., 2)"""
    left = unit(torch.stack([way[..., 1], -way[..., 0]], dim=-1))
    share = (vector * left).sum(dim=-1, keepdim=True)
    return left * torch.where(share.abs() > 1e-6, share, 1.0)


def unit(ground: Tensor) -> Tensor:
    """A ground vector with length 1; x where it has none. (..., 2) -> (..., 2)"""
    length = ground.norm(dim=-1, keepdim=True)
    return torch.where(length > 1e-6, ground / length.clamp_min(1e-6), ground.new_tensor([1.0, 0.0]))


def distance_needed(one: Tensor, other: Tensor, away: Tensor, keep: Apart) -> Tensor:
    """How far one body must move along a ground direction to leave the other, frame by frame.

    joints (n, 22, 3) x 2, away (n, 2) of unit length -> (n,) metres, 0 where nothing is in the way
    """
    needed = one.new_zeros(len(one))
    stuck = (excess_depth(one, other, keep) > 0).nonzero()[:, 0]
    if not len(stuck):
        return needed
    one, other, way = one[stuck], other[stuck], lifted(away[stuck])[:, None]
    near, far = one.new_zeros(len(stuck)), one.new_full((len(stuck),), FARTHEST)
    for _ in range(HALVINGS):
        middle = (near + far) / 2
        inside = excess_depth(one + middle[:, None, None] * way, other, keep) > 0
        near, far = torch.where(inside, middle, near), torch.where(inside, far, middle)
    needed[stuck] = far
    return needed


def widened(mask: Tensor, frames: int) -> Tensor:
    """The mask, True also `frames` before and after each True. (B, T) bool -> same"""
    return F.max_pool1d(F.pad(mask.float(), (frames, frames))[:, None], 2 * frames + 1, stride=1)[:, 0] > 0


def eased(needed: Tensor, ease: int) -> Tensor:
    """A smooth distance, nowhere less than needed. (B, T) -> (B, T)"""
    width = 2 * ease + 1
    most = F.max_pool1d(F.pad(needed, (ease, ease))[:, None], width, stride=1)
    return F.avg_pool1d(F.pad(most, (ease, ease), mode="replicate"), width, stride=1)[:, 0]


def kept_apart(
    joints: Tensor,
    present: Tensor,
    fixed: Tensor | None = None,
    keep: Apart | None = None,
    begun: bool = False,
    fps: float = FPS,
) -> Tensor:
    """Offsets over the ground that keep bodies out of each other, exactly 0 where nobody is in the way.

    Two people make way along the line between them, half each; if one is fixed, the other makes all of it.

    Args:
        joints: (B, T, P, 22, 3) in the world, metres.
        present: (B, P) bool.
        fixed: (P,), (T, P) or (B, T, P) bool, who must not be moved; None: nobody.
        keep: depths and times.
        begun: the motion continues a past that stays, so offsets grow from 0.
        fps: frames a second.

    Returns:
        (B, T, P, 2) metres along x and z.
    """
    keep = keep or Apart()
    B, T, P = joints.shape[:3]
    offsets = joints.new_zeros(B, T, P, 2)
    free = present[:, None].expand(B, T, P).clone()
    if fixed is not None:
        free &= ~fixed.to(joints.device)
    if P > FEW_PEOPLE:
        each = [_crowd_apart(*one, keep, begun, fps) for one in zip(joints, present, free, strict=True)]
        return torch.stack(each)
    for _ in range(keep.rounds if P > 2 else 1):
        moved = joints + lifted(offsets)[..., None, :]
        for i, j in combinations(range(P), 2):
            one, other = moved[:, :, i], moved[:, :, j]
            both = (present[:, i] & present[:, j])[:, None]
            inside = (excess_depth(one, other, keep) > 0) & both
            if not bool(inside.any()):
                continue
            away = direction(one, other, widened(inside, 2 * keep.ease))
            needed = distance_needed(one.flatten(0, 1), other.flatten(0, 1), away.flatten(0, 1), keep).view(B, T)
            movable = free[:, :, i].int() + free[:, :, j].int()
            needed = eased(torch.where(both & (movable > 0), needed, 0.0), keep.ease)
            if begun:
                ramp = keep.speed / fps * torch.arange(1, T + 1, device=joints.device, dtype=joints.dtype)
                needed = torch.minimum(needed, ramp * movable)
            push = (needed / movable.clamp_min(1))[..., None] * away
            offsets[:, :, i] += torch.where(free[:, :, i, None], push, 0.0)
            offsets[:, :, j] -= torch.where(free[:, :, j, None], push, 0.0)
    return offsets


def _crowd_apart(joints: Tensor, present: Tensor, free: Tensor, keep: Apart, begun: bool, fps: float) -> Tensor:
    """`kept_apart` of one scene of many people: all near pairs at once, `CROWD_ROUNDS` times.

    joints (T, P, 22, 3), present (P,), free (T, P) bool -> (T, P, 2)
    """
    T = len(joints)
    offsets = joints.new_zeros(*joints.shape[:2], 2)
    ramp = max(keep.speed, CROWD_SPEED) / fps * torch.arange(1, T + 1, device=joints.device, dtype=joints.dtype)
    for _ in range(CROWD_ROUNDS):
        moved = (joints + lifted(offsets)[..., None, :]).transpose(0, 1)  # (P, T, 22, 3)
        i, j = near_pairs(moved, present)
        parts = [excess_depth(moved[a], moved[b], keep) for a, b in zip(i.split(PAIRS), j.split(PAIRS), strict=True)]
        inside = torch.cat(parts) > 0 if parts else joints.new_zeros(0, T, dtype=torch.bool)
        meet = inside.any(dim=1)
        i, j, inside = i[meet], j[meet], inside[meet]
        if not len(i):
            break
        one, other = moved[i], moved[j]
        away = direction(one, other, widened(inside, 2 * keep.ease))
        needed = distance_needed(one.flatten(0, 1), other.flatten(0, 1), away.flatten(0, 1), keep).view(len(i), T)
        may = free.T[i], free.T[j]
        movable = may[0].int() + may[1].int()
        needed = eased(torch.where(movable > 0, needed, 0.0), keep.ease)
        push = (needed / movable.clamp_min(1))[..., None] * away
        for who, way, sign in ((i, may[0], 1.0), (j, may[1], -1.0)):
            offsets = offsets.index_add(1, who, torch.where(way[..., None], sign * push, 0.0).transpose(0, 1))
        if begun:
            length = offsets.norm(dim=-1, keepdim=True)
            offsets = offsets * (torch.minimum(length, ramp[:, None, None]) / length.clamp_min(1e-9))
    return offsets


def near_pairs(moved: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
    """Pairs whose pelvises come near enough for bodies to touch. moved (P, T, 22, 3) -> (E,) int x 2"""
    ground = moved[:, :, PELVIS, [0, 2]].transpose(0, 1)  # (T, P, 2)
    near = (torch.cdist(ground, ground) < ARM_REACH).any(dim=0) & present[:, None] & present
    i, j = near.triu(1).nonzero(as_tuple=True)
    return i, j


def lifted(ground: Tensor) -> Tensor:
    """Ground vectors as vectors in the world. (..., 2) -> (..., 3)"""
    x, z = ground.unbind(-1)
    return torch.stack([x, torch.zeros_like(x), z], dim=-1)
