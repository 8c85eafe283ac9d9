"""Thirteen capsules that approximate a body, to measure how deep people are in each other (docs/metrics.md)."""

from typing import NamedTuple

import torch
from torch import Tensor

from magnet.body.indices import picked
from magnet.waiting import constant

from magnet.body.joints import (  # isort: skip
    HEAD, L_ANKLE, L_ELBOW, L_HIP, L_KNEE, L_SHOULDER, L_WRIST, NECK, PELVIS, R_ANKLE, R_ELBOW, R_HIP, R_KNEE,
    R_SHOULDER, R_WRIST, SPINE1, SPINE2, SPINE3,
)  # fmt: skip


class Capsule(NamedTuple):
    """All points within `radius` metres of the line between two joints."""

    joint_a: int
    joint_b: int
    radius: float
    name: str


CAPSULES: tuple[Capsule, ...] = (
    Capsule(PELVIS, SPINE1, 0.12, "lower torso"),
    Capsule(SPINE1, SPINE2, 0.11, "middle torso"),
    Capsule(SPINE2, SPINE3, 0.10, "upper torso"),
    Capsule(SPINE3, NECK, 0.06, "neck"),
    Capsule(NECK, HEAD, 0.09, "head"),
    Capsule(L_SHOULDER, L_ELBOW, 0.05, "left upper arm"),
    Capsule(R_SHOULDER, R_ELBOW, 0.05, "right upper arm"),
    Capsule(L_ELBOW, L_WRIST, 0.04, "left forearm"),
    Capsule(R_ELBOW, R_WRIST, 0.04, "right forearm"),
    Capsule(L_HIP, L_KNEE, 0.07, "left thigh"),
    Capsule(R_HIP, R_KNEE, 0.07, "right thigh"),
    Capsule(L_KNEE, L_ANKLE, 0.06, "left shin"),
    Capsule(R_KNEE, R_ANKLE, 0.06, "right shin"),
)
"""Hands and feet have none, so that holding hands is not a collision."""
FROM, TO, RADII, _ = zip(*CAPSULES, strict=True)


def capsule_segments(joints: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Ends of the 13 capsules. (..., 22, 3) -> (..., 13, 3), (..., 13, 3), radii (13,) in metres"""
    return picked(joints, FROM), picked(joints, TO), constant(RADII, joints)


def nearest_points(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
    """The points of the segments a-b and c-d that are nearest to each other. (..., 3) x 4 -> (..., 3) x 2

    >>> a, b = torch.tensor([0.0, 0.0, 0.0]), torch.tensor([1.0, 0.0, 0.0])
    >>> c, d = torch.tensor([2.0, 1.0, 0.0]), torch.tensor([2.0, 3.0, 0.0])
    >>> nearest_points(a, b, c, d)
    (tensor([1., 0., 0.]), tensor([2., 1., 0.]))
    """
    u, v, w = b - a, d - c, a - c
    uu, vv, uv = (u * u).sum(-1), (v * v).sum(-1), (u * v).sum(-1)
    uw, vw = (u * w).sum(-1), (v * w).sum(-1)
    determinant = uu * vv - uv * uv
    crossing = determinant > 1e-9 * uu * vv
    s = torch.where(crossing, (uv * vw - vv * uw) / torch.where(crossing, determinant, 1.0), 0.0).clamp(0, 1)
    t = ((uv * s + vw) / vv.clamp_min(1e-12)).clamp(0, 1)
    s = ((uv * t - uw) / uu.clamp_min(1e-12)).clamp(0, 1)
    return a + s[..., None] * u, c + t[..., None] * v
