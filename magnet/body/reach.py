"""Hands and feet brought to a place: the two bones of a limb are turned, and nothing else."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from magnet.body.base import Body
from magnet.body.joints import ANKLES, ELBOWS, HIPS, KNEES, PARENTS, SHOULDERS, WRISTS
from magnet.motion.rotations import from_rotvec

LIMBS: dict[str, tuple[int, int, int]] = {
    "left hand": (SHOULDERS[0], ELBOWS[0], WRISTS[0]),
    "right hand": (SHOULDERS[1], ELBOWS[1], WRISTS[1]),
    "left foot": (HIPS[0], KNEES[0], ANKLES[0]),
    "right foot": (HIPS[1], KNEES[1], ANKLES[1]),
}
"""Joints of each limb from the trunk outwards; its place is that of the last one."""

BENDS = {ELBOWS[0]: (0.0, -1.0, 0.0), ELBOWS[1]: (0.0, 1.0, 0.0), KNEES[0]: (1.0, 0.0, 0.0), KNEES[1]: (1.0, 0.0, 0.0)}
"""Axis at rest about which the middle joint bends, for limbs that are straight."""

STRAIGHT = 0.05
"""Sine of a bend below which a limb does not tell its axis."""

LONGEST = 0.9995
"""Share of its length that a limb is stretched to at most."""


def reach(body: Body, body_rot: Tensor, T_world_root: Tensor, betas: Tensor, limb: str, place: Tensor) -> Tensor:
    """Turn a limb so that its end comes to a place, or toward it as far as the limb is long.

    It keeps the side that it bends to; a foot keeps how it stands in the world, a hand how it is held by the forearm.

    Args:
        body_rot, T_world_root, betas: (..., 21, 3, 3), (..., 4, 4) and (..., 10), as in `Body`.
        limb: a name in `LIMBS`.
        place: (..., 3) in the world, metres.

    Returns:
        body_rot with the limb turned.

    Raises:
        ValueError: no such limb.
    """
    if limb not in LIMBS:
        raise ValueError(f"limb: got {limb!r}, expected {', '.join(LIMBS)}")
    first, middle, end = LIMBS[limb]
    R, t = body.bone_chain(body_rot, T_world_root, body.rest_joints(betas))
    upper, lower, way = (
        t[..., middle, :] - t[..., first, :],
        t[..., end, :] - t[..., middle, :],
        place - t[..., first, :],
    )
    a, b = upper.norm(dim=-1), lower.norm(dim=-1)
    far = torch.minimum(torch.maximum(way.norm(dim=-1), (a - b).abs() + 1e-3), (a + b) * LONGEST)
    axis = torch.linalg.cross(upper, lower, dim=-1)
    hinge = (R[..., first, :, :] @ axis.new_tensor(BENDS[middle])[:, None])[..., 0]
    straight = axis.norm(dim=-1, keepdim=True) < STRAIGHT * (a * b)[..., None]
    axis = torch.where(straight, hinge, F.normalize(axis, dim=-1))
    bend = ((far**2 - a**2 - b**2) / (2 * a * b)).clamp(-1, 1).acos() - _angle(upper, lower, axis)
    folded = from_rotvec(bend[..., None] * axis)
    whole = _arc(upper + (folded @ lower[..., None])[..., 0], way, axis)

    R_first, R_middle = whole @ R[..., first, :, :], whole @ folded @ R[..., middle, :, :]
    turned = body_rot.clone()
    turned[..., first - 1, :, :] = R[..., PARENTS[first], :, :].mT @ R_first
    turned[..., middle - 1, :, :] = R_first.mT @ R_middle
    if end in ANKLES:
        turned[..., end - 1, :, :] = R_middle.mT @ R[..., end, :, :]
    return turned


def _angle(one: Tensor, other: Tensor, axis: Tensor) -> Tensor:
    """From one direction to the other about an axis across both. (..., 3) x 3 -> (...)"""
    return torch.atan2((torch.linalg.cross(one, other, dim=-1) * axis).sum(-1), (one * other).sum(-1))


def _arc(one: Tensor, other: Tensor, otherwise: Tensor) -> Tensor:
    """The shortest rotation that takes one direction to the other, about `otherwise` if they are opposite."""
    across = torch.linalg.cross(one, other, dim=-1)
    length = across.norm(dim=-1, keepdim=True)
    axis = torch.where(length > 1e-9, across / length.clamp_min(1e-9), otherwise)
    return from_rotvec(_angle(one, other, axis)[..., None] * axis)
