"""How the bones of a recorded skeleton rest, against those of our body, as its rest pose and its motion tell."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from magnet.body.fit import swing

from magnet.body.joints import (  # isort: skip
    ANKLES, ELBOWS, HIPS, KNEES, L_ANKLE, L_ELBOW, L_HIP, L_KNEE, L_SHOULDER, L_WRIST, PARENTS, SHOULDERS, TOES,
    WRISTS,
)  # fmt: skip
from magnet.export.palms import bent_aside, elbow_roll, palms_rolled
from magnet.export.rig import LIMBS, Skeleton
from magnet.motion.rotations import from_rotvec
from magnet.motion.scene import BODY_JOINTS

FARTHEST_SWING = math.radians(110.0)
"""Largest angle between a bone in our rest pose and in theirs; beyond it the bone's roll is ambiguous."""
STANDS = torch.zeros(BODY_JOINTS, 3, dtype=torch.float64)
"""Directions of thighs and upper arms in our rest pose, as places of knees and elbows."""
STANDS[list(KNEES), 1] = -1.0
STANDS[list(ELBOWS), 0] = torch.tensor([1.0, -1.0], dtype=torch.float64)
BENDS = {L_HIP: (L_KNEE, L_ANKLE, -1.0), L_SHOULDER: (L_ELBOW, L_WRIST, 1.0)}
"""Left bone with a hinge at its end, the hinge, the joint behind it, and where along z that goes as the hinge bends."""
BENT = 0.2
"""Mean share of the bone behind a hinge that is aside of the one before it, from which on bends tell."""
STRAIGHT = math.radians(25.0)
"""Angle at elbows and knees that rest poses have at most."""
MUCH_BENT, ASIDE = 0.35, math.radians(60.0)
"""The same from which on a user is told how far aside of ahead elbows bend, where that is this angle or more."""
AHEAD = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
"""Where thumbs are in our rest pose, whose palms look down, and where forearms go as elbows bend."""


def rests_aligned(skeleton: Skeleton, rest: Tensor) -> dict[int, Tensor]:
    """Rotations (3, 3) from our rest pose, rest (22, 3), to where a skeleton's bones rest; NaN: it does not tell.

    Some programs write bones that all rest along one axis, each rolled in its own way. Nobody rests so: legs are folded
    up beside the trunk. How thighs and upper arms of such are rolled knees and elbows tell, which bend to one side; and
    so of those that rest in the middle of their motion.
    """
    ours, theirs = skeleton.naming.joints, torch.from_numpy(skeleton.file.rest())
    Q = torch.from_numpy(skeleton.R_rest_ours)
    aligned = {j: Q for j in range(BODY_JOINTS)}
    upright = rests_upright(skeleton, rest) and not in_motion(skeleton)
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
        if bool(aligned[ELBOWS[s]].isfinite().all()):
            aligned |= _palm_turned(skeleton, aligned, s, upright)
    return aligned


def in_motion(skeleton: Skeleton) -> bool:
    """Whether a skeleton rests in a pose of its motion, with bent limbs; straight ones are a rest pose all the same."""
    ours, theirs = skeleton.naming.joints, torch.from_numpy(skeleton.file.rest())
    hinges = ((HIPS, KNEES, ANKLES), (SHOULDERS, ELBOWS, WRISTS))
    bent = [
        _angle(theirs[ours[b[s]]] - theirs[ours[a[s]]], theirs[ours[c[s]]] - theirs[ours[b[s]]])
        for a, b, c in hinges
        for s in (0, 1)
    ]
    return skeleton.file.posed and max(bent) > STRAIGHT


def with_doubts(skeletons: Sequence[Skeleton]) -> list[Skeleton]:
    """The same with notes on rest poses that may be taken wrongly.

    Such are one in the middle of the motion; and arms whose elbows bend far aside of ahead, where no finger tells how
    they rest.
    """
    return [replace(each, notes=(*each.notes, *(_posed(each) or _arms_doubted(each)))) for each in skeletons]


def _posed(skeleton: Skeleton) -> list[str]:
    if not in_motion(skeleton):
        return []
    return [
        "its nodes rest as its first frame, which is no rest pose: knees and elbows tell how limbs turn, "
        "and how the trunk leans in that frame is lost; export it with its skin, or standing straight"
    ]


def _arms_doubted(skeleton: Skeleton) -> list[str]:
    ours, rest, Q = (
        skeleton.naming.joints,
        torch.from_numpy(skeleton.file.rest()),
        torch.from_numpy(skeleton.R_rest_ours),
    )
    if not rests_upright(skeleton, STANDS):
        return []
    least = math.pi
    for s in (0, 1):
        a, b = SHOULDERS[s], ELBOWS[s]
        ahead = swing(Q @ (STANDS[b] - STANDS[a]), rest[ours[b]] - rest[ours[a]]) @ Q @ AHEAD
        if palms_rolled(skeleton, s, ahead) is not None:
            return []
        least = min(least, abs(elbow_roll(skeleton, s, ahead, MUCH_BENT)))
    if least < ASIDE:
        return []
    return [
        f"elbows bend {math.degrees(least):.0f} degrees aside of where they would from a rest pose with palms down: if "
        "palms look elsewhere in its rest pose, arms come out rolled; write it from another one, or with fingers"
    ]


def _palm_turned(skeleton: Skeleton, aligned: dict[int, Tensor], s: int, upright: bool) -> dict[int, Tensor]:
    """The arm's rotations where fingers say that a palm rests turned, as in a T pose with palms forward.

    Most turn the forearm alone, which twists along its length: half of it at the elbow. Some roll the whole arm from
    the shoulder, which elbows tell that bend to where that would have them.
    """
    shoulder, elbow, wrist = SHOULDERS[s], ELBOWS[s], WRISTS[s]
    ours, rest = skeleton.naming.joints, torch.from_numpy(skeleton.file.rest())
    roll = palms_rolled(skeleton, s, aligned[elbow] @ AHEAD)
    if not roll:
        return {}
    lower, upper = rest[ours[wrist]] - rest[ours[elbow]], rest[ours[elbow]] - rest[ours[shoulder]]
    turned = {wrist: _rolled(lower, roll) @ aligned[wrist]}
    if not upright:  # nobody's pose: the forearm's own roll is another one
        return turned
    if abs(elbow_roll(skeleton, s, aligned[shoulder] @ AHEAD) - roll) < abs(roll) / 2:
        turned[shoulder] = _rolled(upper, roll) @ aligned[shoulder]
        turned[elbow] = _rolled(lower, roll) @ aligned[elbow]
    else:
        turned[elbow] = _rolled(lower, roll / 2) @ aligned[elbow]
    return turned


def _rolled(axis: Tensor, radians: float) -> Tensor:
    """A turn about a direction (3,). -> (3, 3)"""
    return from_rotvec(radians * torch.nn.functional.normalize(axis, dim=0))


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
    along, bends = bent_aside(skeleton, j, h, b)
    if float(bends.norm()) < BENT:
        return torch.full((3, 3), torch.nan, dtype=rest.dtype)
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
