"""A person's own frame, read off joints, and what is seen from it."""

from __future__ import annotations

import torch
from torch import Tensor

from magnet.body.joints import L_HIP, PELVIS, R_HIP
from magnet.motion.frames import from_planar, inverse


def joint_canonical_frame(joints: Tensor) -> Tensor:
    """Frame on the ground under the pelvis, its x axis along the line through the hips. (..., 22, 3) -> (..., 4, 4)

    Joints alone do not give the pelvis's rotation, so this is near `magnet.motion`'s frame, not equal to it.
    """
    left = joints[..., L_HIP, :] - joints[..., R_HIP, :]
    return from_planar(torch.atan2(-left[..., 2], left[..., 0]), joints[..., PELVIS, [0, 2]])


def seen_from(T_world_self: Tensor, joints: Tensor) -> Tensor:
    """World joints in another frame. (..., 4, 4), (..., J, 3) -> (..., J, 3)"""
    T_self_world = inverse(T_world_self)
    return joints @ T_self_world[..., :3, :3].transpose(-1, -2) + T_self_world[..., None, :3, 3]
