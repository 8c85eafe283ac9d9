"""Rotations about axes, smooth signals and closed-form chains of two bones."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from magnet.motion.rotations import vee


def about_x(angle: Tensor) -> Tensor:
    """Rotation about x: positive turns forward (+z) down. (...) radians -> (..., 3, 3)"""
    cos, sin = angle.cos(), angle.sin()
    zero, one = torch.zeros_like(angle), torch.ones_like(angle)
    return torch.stack([one, zero, zero, zero, cos, -sin, zero, sin, cos], dim=-1).unflatten(-1, (3, 3))


def about_z(angle: Tensor) -> Tensor:
    """Rotation about z: positive lifts the left (+x). (...) radians -> (..., 3, 3)"""
    cos, sin = angle.cos(), angle.sin()
    zero, one = torch.zeros_like(angle), torch.ones_like(angle)
    return torch.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], dim=-1).unflatten(-1, (3, 3))


def about(axis: Tensor, angle: Tensor) -> Tensor:
    """Rotation about a unit axis (Rodrigues). (..., 3), (...) radians -> (..., 3, 3)"""
    x, y, z = axis.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    angle = angle[..., None, None]
    return torch.eye(3, dtype=axis.dtype) + angle.sin() * cross + (1 - angle.cos()) * cross @ cross


def fraction(rotation: Tensor, share: float) -> Tensor:
    """Rotation by a fraction of its angle, for angles below pi. (..., 3, 3) -> (..., 3, 3)"""
    axis = vee(rotation)
    twice_sin = axis.norm(dim=-1)
    twice_cos = rotation.diagonal(dim1=-2, dim2=-1).sum(-1) - 1
    angle = torch.atan2(twice_sin, twice_cos)
    return about(axis / twice_sin.clamp_min(1e-12)[..., None], angle * share)


def rotate(rotation: Tensor, vector: Tensor) -> Tensor:
    """(..., 3, 3), (..., 3) -> (..., 3)"""
    return (rotation @ vector[..., None])[..., 0]


def basis(along: Tensor, beside: Tensor) -> Tensor:
    """Right-handed frame with first axis `along` and second axis nearest to `beside`. -> (..., 3, 3)"""
    first = F.normalize(along, dim=-1)
    third = F.normalize(torch.linalg.cross(first, beside.expand_as(first), dim=-1), dim=-1)
    return torch.stack([first, torch.linalg.cross(third, first, dim=-1), third], dim=-1)


def two_bones(
    start: Tensor, target: Tensor, bend: Tensor, rest: tuple[Tensor, Tensor], hinge: Tensor
) -> tuple[Tensor, Tensor]:
    """World rotations of two bones such that the chain from `start` ends at `target`.

    The middle joint lies on the side of `bend`. Out of reach, the chain is stretched toward the target.

    Args:
        start, target, bend: (..., 3) metres; bend is a direction, its length does not matter.
        rest: the two bones at rest, (..., 3) each.
        hinge: the middle joint's axis at rest (3,): positive turns about it fold the chain.

    Returns:
        Rotations (..., 3, 3) of the upper and of the lower bone.
    """
    upper, lower = rest[0].norm(dim=-1), rest[1].norm(dim=-1)
    reach = target - start
    distance = reach.norm(dim=-1)
    along = reach / distance.clamp_min(1e-9)[..., None]
    distance = torch.minimum(distance.clamp_min(1e-3), (upper + lower) * 0.9995)
    distance = torch.maximum(distance, (upper - lower).abs() + 1e-3)
    side = F.normalize(bend - (bend * along).sum(-1, keepdim=True) * along, dim=-1)
    cos = ((upper**2 + distance**2 - lower**2) / (2 * upper * distance)).clamp(-1, 1)
    sin = (1 - cos**2).sqrt()
    first = cos[..., None] * along + sin[..., None] * side
    second = distance[..., None] * along - upper[..., None] * first
    # The chain folds from `first` toward `second`: their cross product is the hinge.
    axis = torch.linalg.cross(along, side, dim=-1) * -1
    R_upper = basis(first, axis) @ basis(rest[0], hinge).transpose(-1, -2)
    R_lower = basis(second, axis) @ basis(rest[1], hinge).transpose(-1, -2)
    return R_upper, R_lower


def ease(u: Tensor) -> Tensor:
    """Minimum-jerk curve from 0 to 1: no speed and no acceleration at either end. Clamped outside [0, 1]."""
    u = u.clamp(0, 1)
    return u**3 * (10 - 15 * u + 6 * u**2)


def smooth(signal: Tensor, sigma: float) -> Tensor:
    """Gaussian filter along the first axis, ends held. (T, ...), frames -> (T, ...)"""
    radius = int(3 * sigma + 0.5)
    if radius == 0:
        return signal
    kernel = torch.exp(-0.5 * (torch.arange(-radius, radius + 1, dtype=signal.dtype) / sigma) ** 2)
    flat = signal.reshape(len(signal), -1).T[:, None]
    flat = F.pad(flat, (radius, radius), mode="replicate")
    return F.conv1d(flat, (kernel / kernel.sum())[None, None])[:, 0].T.reshape(signal.shape)


def under(ceiling: Tensor, radius: int) -> Tensor:
    """A smooth curve that nowhere exceeds `ceiling`. (T, ...), frames -> (T, ...)"""
    flat = -ceiling.reshape(len(ceiling), -1).T[:, None]
    lowest = -F.max_pool1d(F.pad(flat, (radius, radius), mode="replicate"), 2 * radius + 1, stride=1)
    weights = torch.hann_window(2 * radius + 3, periodic=False, dtype=ceiling.dtype)[1:-1]
    lowest = F.pad(lowest, (radius, radius), mode="replicate")
    return F.conv1d(lowest, (weights / weights.sum())[None, None])[:, 0].T.reshape(ceiling.shape)
