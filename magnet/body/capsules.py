"""Thirteen capsules that stand for a body where people might run through each other (docs/metrics.md)."""

from typing import NamedTuple

import torch
from torch import Tensor


class Capsule(NamedTuple):
    """All points within `radius` metres of the line between two joints."""

    joint_a: int
    joint_b: int
    radius: float
    name: str


CAPSULES: tuple[Capsule, ...] = (
    Capsule(0, 3, 0.12, "lower torso"),
    Capsule(3, 6, 0.11, "middle torso"),
    Capsule(6, 9, 0.10, "upper torso"),
    Capsule(9, 12, 0.06, "neck"),
    Capsule(12, 15, 0.09, "head"),
    Capsule(16, 18, 0.05, "left upper arm"),
    Capsule(17, 19, 0.05, "right upper arm"),
    Capsule(18, 20, 0.04, "left forearm"),
    Capsule(19, 21, 0.04, "right forearm"),
    Capsule(1, 4, 0.07, "left thigh"),
    Capsule(2, 5, 0.07, "right thigh"),
    Capsule(4, 7, 0.06, "left shin"),
    Capsule(5, 8, 0.06, "right shin"),
)
"""Hands and feet have none, so that holding hands is not a collision."""


def capsule_segments(joints: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Ends of the 13 capsules. (..., 22, 3) -> (..., 13, 3), (..., 13, 3), radii (13,) in metres"""
    radius = torch.tensor([capsule.radius for capsule in CAPSULES], dtype=joints.dtype, device=joints.device)
    a = joints[..., [capsule.joint_a for capsule in CAPSULES], :]
    b = joints[..., [capsule.joint_b for capsule in CAPSULES], :]
    return a, b, radius
