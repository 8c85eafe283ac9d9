"""How the bones of a recorded skeleton rest, against those of our body, as its rest pose and its motion tell."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from magnet.body.fit import swing

from magnet.body.joints import (  # isort: skip
    ANKLES, ELBOWS, HIPS, KNEES, L_ANKLE, L_ELBOW, L_HIP, L_KNEE, L_SHOULDER, L_WRIST, PARENTS, TOES, WRISTS,
)  # fmt: skip
from magnet.export.rig import LIMBS, Skeleton
from magnet.motion.scene import BODY_JOINTS

FARTHEST_SWING = math.radians(110.0)
"""Largest angle between a bone in our rest pose and in theirs; beyond it the bone's roll is ambiguous."""
BENDS = {L_HIP: (L_KNEE, L_ANKLE, -1.0), L_SHOULDER: (L_ELBOW, L_WRIST, 1.0)}
"""Left bone with a hinge at its end, the hinge, the joint behind it, and where along z that goes as the hinge bends."""
BENT = 0.2
"""Mean share of the bone behind a hinge that is aside of the one before it, from which on bends tell."""


def rests_aligned(skeleton: Skeleton, rest: Tensor) -> dict[int, Tensor]:
    """Rotations (3, 3) from our rest pose, rest (22, 3), to where a skeleton's bones rest; NaN: it does not tell.

    Some programs write bones that all rest along one axis, each rolled in its own way. Nobody rests so: legs are folded
    up beside the trunk. How thighs and upper arms of such are rolled knees and elbows tell, which bend to one side.
    """
    ours, theirs = skeleton.naming.joints, torch.from_numpy(skeleton.file.rest())
    Q = torch.from_numpy(skeleton.R_rest_ours)
    aligned = {j: Q for j in range(BODY_JOINTS)}
    upright = rests_upright(skeleton, rest)
    for left, child in LIMBS:
        for s in (0, 1):
            j, c = left + s, child + s
            first = aligned[PARENTS[j]] if left in (L_KNEE, L_ANKLE, L_ELBOW) else Q
            aligned[j] = first
            if c not in ours:
                continue
            ours_bone, their_bone = first @ (rest[c] - rest[j]), theirs[ours[c]] - theirs[ours[j]]
            if left in BENDS and not upright:
                aligned[j] = _as_it_bends(skeleton, rest, left, s)
            elif _angle(ours_bone, their_bone) <= FARTHEST_SWING:
                aligned[j] = swing(ours_bone, their_bone) @ first
            else:
                aligned[j] = torch.full_like(Q, torch.nan)
    for s in (0, 1):
        aligned[TOES[s]], aligned[WRISTS[s]] = aligned[ANKLES[s]], aligned[ELBOWS[s]]
    return aligned


def rests_upright(skeleton: Skeleton, rest: Tensor) -> bool:
    """Whether thighs rest as a person's may. rest (22, 3)"""
    ours, theirs = skeleton.naming.joints, torch.from_numpy(skeleton.file.rest())
    thighs = [(rest[k] - rest[h], theirs[ours[k]] - theirs[ours[h]]) for h, k in zip(HIPS, KNEES, strict=True)]
    Q = torch.from_numpy(skeleton.R_rest_ours)
    return all(_angle(Q @ own, their) <= FARTHEST_SWING for own, their in thighs)


def _as_it_bends(skeleton: Skeleton, rest: Tensor, left: int, s: int) -> Tensor:
    """Where a thigh or an upper arm rests by how its hinge bends, (3, 3); NaN: it hardly does."""
    hinge, behind, way = BENDS[left]
    j, h, b = (joint + s for joint in (left, hinge, behind))
    ours, theirs = skeleton.naming.joints, torch.from_numpy(skeleton.file.rest())
    along = theirs[ours[h]] - theirs[ours[j]]
    lower = torch.from_numpy(skeleton.at[:, ours[b]] - skeleton.at[:, ours[h]])
    lower = (torch.from_numpy(skeleton.turned[:, ours[j]]).mT @ lower[..., None])[..., 0]  # as the upper bone rests
    bends = _aside(lower, along).mean(dim=0)
    if float(bends.norm()) < BENT:
        return torch.full_like(theirs[:3], torch.nan)
    ahead = torch.tensor([0.0, 0.0, way], dtype=rest.dtype)
    return _frame(along, bends) @ _frame(rest[h] - rest[j], ahead).mT


def _angle(one: Tensor, other: Tensor) -> float:
    """Radians between two directions (3,); NaN if one is."""
    return float(torch.acos(torch.nn.functional.cosine_similarity(one, other, dim=0).clamp(-1, 1)))


def _aside(direction: Tensor, bone: Tensor) -> Tensor:
    """The part of unit directions (..., 3) that is aside of a bone (3,)."""
    direction, bone = (torch.nn.functional.normalize(vector, dim=-1) for vector in (direction, bone))
    return direction - (direction @ bone)[..., None] * bone


def _frame(bone: Tensor, aside: Tensor) -> Tensor:
    """Axes (3, 3), in columns: along a bone, to its side, and across both."""
    x, y = (torch.nn.functional.normalize(vector, dim=0) for vector in (bone, _aside(aside, bone)))
    return torch.stack([x, y, torch.linalg.cross(x, y)], dim=1)
