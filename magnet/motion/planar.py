"""Turns about the vertical and ground positions (x, z): the algebra of transforms that stand on the ground.

A turn is a yaw in radians, or a unit vector (cos, sin) of it, which has no jump at a half turn.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F


def unit_of(yaw: Tensor) -> Tensor:
    """(cos, sin) of a yaw. (...) -> (..., 2)"""
    return torch.stack([yaw.cos(), yaw.sin()], dim=-1)


def multiply(a: Tensor, b: Tensor) -> Tensor:
    """One turn after another, as unit vectors. (..., 2), (..., 2) -> (..., 2)"""
    real = a[..., 0] * b[..., 0] - a[..., 1] * b[..., 1]
    return torch.stack([real, a[..., 0] * b[..., 1] + a[..., 1] * b[..., 0]], dim=-1)


def conjugate(unit: Tensor) -> Tensor:
    """The turn back. (..., 2) -> same"""
    return torch.stack([unit[..., 0], -unit[..., 1]], dim=-1)


def rotate_by(unit: Tensor, ground: Tensor) -> Tensor:
    """Turn ground vectors (x, z) about the vertical. (..., 2), (..., 2) -> (..., 2)

    >>> rotate_by(unit_of(torch.tensor(torch.pi / 2)), torch.tensor([0.0, 2.0])).round()  # facing z, then facing x
    tensor([2., -0.])
    """
    cos, sin = unit.unbind(-1)
    x, z = ground.unbind(-1)
    return torch.stack([cos * x + sin * z, cos * z - sin * x], dim=-1)


def rotate_ground(yaw: Tensor, ground: Tensor) -> Tensor:
    """Turn ground vectors (x, z) about the vertical by a yaw. (...), (..., 2) -> (..., 2)"""
    return rotate_by(unit_of(yaw), ground)


def unit_ground(nine: Tensor) -> tuple[Tensor, Tensor]:
    """Unit (cos, sin) of the yaw and ground position of a transform in 9-D. (..., 9) -> (..., 2) x 2"""
    unit = torch.stack([nine[..., 0], -nine[..., 2]], dim=-1)
    return F.normalize(unit, dim=-1, eps=1e-6), nine[..., 6:9:2]
