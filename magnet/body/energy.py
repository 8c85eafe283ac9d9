"""The energy of bodies together: depth, standing feet that slide, soles under the floor, joints beyond their range.

Each term is a function of points or rotations, batched, differentiable and in metres or radians, or in their squares.
Which depth is contact and which is penetration depends on the parts that meet (`Contact`).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from magnet.body.capsules import CAPSULES, nearest_points
from magnet.body.fitted_capsules import FOREARMS, HANDS, LEGS, PARTS, TRUNK, UPPER_ARMS
from magnet.body.indices import indices, pairs_of

from magnet.body.joints import (  # isort: skip
    ANKLES, ELBOWS, HEAD, HIPS, KNEES, NECK, SHOULDERS, SPINE1, SPINE2, SPINE3, TOES, WRISTS,
)  # fmt: skip
from magnet.motion.scene import BODY_JOINTS, FPS

GRAVITY = 9.81
BEYOND = 0.08
"""Metres from the wrist to the middle of the hand, along the forearm: bodies of 22 joints have no hands."""


@dataclass(frozen=True)
class Contact:
    """Depths in metres up to which parts of bodies touch, and beyond which they penetrate.

    Hands and forearms, of two people or one's own, may overlap without limit: they hold each other.

    Args:
        body: trunks, heads and legs of two people.
        arms: an arm or a hand of one, and any part of the other.
        own: parts of one body; neighbouring parts always overlap and do not count.
        measured: the capsules that depth is measured by (`magnet.body.capsules`), forearm on forearm apart.
    """

    body: float = 0.02
    arms: float = 0.03
    own: float = 0.04
    measured: float = 0.04


CONTACT: dict[str, Contact] = {"light": Contact(body=0.05, arms=0.06, own=0.06, measured=0.06), "firm": Contact()}
"""By name: `light` lets people lean on each other, `firm` lets them touch."""


def allowed_between(contact: Contact) -> Tensor:
    """Depth allowed between capsules of two people. -> (K, K) metres, infinite: no limit"""
    K = len(PARTS)
    arm, hold = torch.zeros(K, dtype=torch.bool), torch.zeros(K, dtype=torch.bool)
    arm[list(UPPER_ARMS + FOREARMS + HANDS)], hold[list(FOREARMS + HANDS)] = True, True
    allowed = torch.where(arm[:, None] | arm, contact.arms, contact.body).float()
    return torch.where(hold[:, None] & hold, torch.inf, allowed)


def allowed_between_measured(contact: Contact) -> Tensor:
    """`allowed_between` for capsules of `with_measured`, each kind against its own. -> (K + 13, K + 13) metres"""
    fitted = allowed_between(contact)
    K = len(fitted)
    allowed = torch.full((K + len(CAPSULES), K + len(CAPSULES)), torch.inf, dtype=fitted.dtype)
    allowed[:K, :K], allowed[K:, K:] = fitted, contact.measured
    forearm = torch.tensor([False] * K + [capsule.name.endswith("forearm") for capsule in CAPSULES])
    allowed[forearm[:, None] & forearm] = torch.inf
    return allowed


def allowed_within(contact: Contact) -> Tensor:
    """The same within one body, infinite except in the upper triangle and for neighbours. -> (K, K)"""
    K = len(PARTS)
    allowed = torch.full((K, K), torch.inf, dtype=torch.float32)
    free = list(FOREARMS + HANDS)
    for part in free:
        allowed[list(TRUNK + LEGS), part] = contact.own
        allowed[UPPER_ARMS[1 - free.index(part) % 2], part] = contact.own  # of the other side
    left, right = LEGS[::2], LEGS[1::2]  # thigh, shin, foot
    for i, one in enumerate(left):
        for j, other in enumerate(right):
            if i + j:  # everybody's thighs touch
                allowed[one, other] = contact.own
    allowed = torch.minimum(allowed, allowed.T)
    return torch.where(torch.ones(K, K, dtype=torch.bool).triu(1), allowed, torch.inf)


def capsule_depth(ends: Tensor, radius: Tensor, others: Tensor, other_radius: Tensor) -> Tensor:
    """Depth of capsules in others, negative: the gap. (..., K, 2, 3), (..., K) x 2 -> (..., K, K) metres"""
    a, b = ends[..., :, None, 0, :], ends[..., :, None, 1, :]
    c, d = others[..., None, :, 0, :], others[..., None, :, 1, :]
    first, second = nearest_points(a, b, c, d)
    gap = (first - second).square().sum(dim=-1).clamp_min(1e-12).sqrt()  # a finite slope where axes cross
    return radius[..., :, None] + other_radius[..., None, :] - gap


def excess(depth: Tensor, allowed: Tensor) -> Tensor:
    """Depth beyond what is allowed. (..., K, K) metres, 0 where there is none"""
    return (depth - allowed.to(depth)).clamp_min(0)


def hand_points(joints: Tensor, beyond: float = BEYOND) -> Tensor:
    """The middle of each hand, left and right. (..., 22, 3) -> (..., 2, 3) metres"""
    wrist, elbow = (joints.index_select(-2, indices(each, joints.device)) for each in (WRISTS, ELBOWS))
    return wrist + beyond * torch.nn.functional.normalize(wrist - elbow, dim=-1)


def slide(joints: Tensor, stands: Tensor, still: float = 0.05, fps: float = FPS) -> Tensor:
    """How much farther than allowed standing toes move over the floor in a frame, in metres.

    joints (..., T, P, 22, 3), stands (..., T - 1, P, 2) bool; still: m/s that are allowed -> (..., T - 1, P, 2)
    """
    moved = joints[..., TOES, :][..., [0, 2]].diff(dim=-4).square().sum(dim=-1).clamp_min(1e-12).sqrt()
    return torch.where(stands, (moved - still / fps).clamp_min(0), 0.0)


def under_floor(joints: Tensor, clearance: Tensor) -> Tensor:
    """Depth of soles under y = 0. joints (..., P, 22, 3), clearance (..., P, 4) of `FEET` -> (..., P, 4) metres"""
    return (clearance - joints[..., ANKLES + TOES, 1]).clamp_min(0)


TURNS: dict[int, float] = {
    **dict.fromkeys((*SHOULDERS, *HIPS), 2.6),
    **dict.fromkeys((*ELBOWS, *KNEES), 2.7),
    **dict.fromkeys(ANKLES, 1.2),
    **dict.fromkeys((SPINE1, SPINE2, SPINE3), 1.0),
    **dict.fromkeys((NECK, HEAD), 1.2),
    **dict.fromkeys(WRISTS, 1.6),
}
"""Radians that a joint may turn from rest, a little more than clinical ranges of motion; other joints 1.2."""


def limit_excess(body_rot: Tensor) -> Tensor:
    """How far joints are turned beyond `TURNS`. (..., 21, 3, 3) -> (..., 21) radians, 0 within"""
    most = torch.tensor([TURNS.get(joint, 1.2) for joint in range(1, BODY_JOINTS)]).to(body_rot)
    cosine = (body_rot.diagonal(dim1=-2, dim2=-1).sum(dim=-1) - 1) / 2
    return (cosine.clamp(-1 + 1e-6, 1 - 1e-6).acos() - most).clamp_min(0)


def pair_energy(ends: Tensor, radius: Tensor, seen: Tensor, contact: Contact) -> Tensor:
    """Squared excess of depth between people, and of each body with itself, by frame.

    Args:
        ends: (B, T, P, K, 2, 3) of posed capsules, metres.
        radius: (B, P, K) metres.
        seen: (B, T, P) bool, who counts.
        contact: depths that are allowed.

    Returns:
        (B, T) m^2
    """
    P, radius = ends.shape[2], radius[:, None].expand(ends.shape[:4])
    total = ends.new_zeros(ends.shape[:2])
    first, second = pairs_of(P, ends.device)
    if len(first):
        depth = capsule_depth(ends[:, :, first], radius[:, :, first], ends[:, :, second], radius[:, :, second])
        found = excess(depth, allowed_between(contact)).square().sum(dim=(-1, -2))
        total = total + torch.where(seen[:, :, first] & seen[:, :, second], found, 0.0).sum(dim=-1)
    return total + own_energy(ends, radius, seen, contact)


def own_energy(ends: Tensor, radius: Tensor, seen: Tensor, contact: Contact) -> Tensor:
    """`pair_energy` of each body with itself. (B, T, P, K, 2, 3), (B, T, P, K), (B, T, P) -> (B, T) m^2"""
    allowed = allowed_within(contact)
    i, j = allowed.isfinite().nonzero(as_tuple=True)
    first, second = nearest_points(ends[..., i, 0, :], ends[..., i, 1, :], ends[..., j, 0, :], ends[..., j, 1, :])
    gap = (first - second).square().sum(dim=-1).clamp_min(1e-12).sqrt()
    found = (radius[..., i] + radius[..., j] - gap - allowed[i, j].to(ends)).clamp_min(0).square().sum(dim=-1)
    return torch.where(seen, found, 0.0).sum(dim=-1)
