"""Rotations as matrices: the 6-D form of the paper and an angle that is safe to differentiate."""

import torch
from torch import Tensor
from torch.nn import functional as F


def to_6d(rotation: Tensor) -> Tensor:
    """First two *columns* of a rotation matrix, one after the other. (..., 3, 3) -> (..., 6)

    Libraries disagree on this: some use rows. Columns follow Zhou et al. 2019 and the paper (3.1).

    >>> to_6d(torch.eye(3))
    tensor([1., 0., 0., 0., 1., 0.])
    """
    return rotation[..., :2].transpose(-1, -2).flatten(-2)


def from_6d(six: Tensor) -> Tensor:
    """The rotation whose first two columns are nearest in Gram-Schmidt's sense. (..., 6) -> (..., 3, 3)

    >>> from_6d(torch.tensor([2.0, 0, 0, 1, 1, 0]))  # columns neither of length 1 nor square to each other
    tensor([[1., 0., 0.],
            [0., 1., 0.],
            [0., 0., 1.]])
    """
    first, second = six[..., :3], six[..., 3:]
    x = F.normalize(first, dim=-1)
    y = F.normalize(second - (x * second).sum(-1, keepdim=True) * x, dim=-1)
    return torch.stack([x, y, torch.linalg.cross(x, y, dim=-1)], dim=-1)


def geodesic(a: Tensor, b: Tensor) -> Tensor:
    """Angle in radians between two rotations, in [0, pi]. (..., 3, 3) x 2 -> (...)

    The arccos of paper Eq. 4 has an infinite slope at 0 and pi. This is the same angle as
    atan2(sin, cos): exactly 0 with gradient 0 where the rotations agree, finite everywhere.

    >>> geodesic(about_y(torch.tensor(0.2)), about_y(torch.tensor(0.5)))
    tensor(0.3000)
    """
    relative = a.transpose(-1, -2) @ b
    axis = vee(relative)
    square = (axis * axis).sum(-1)
    # The square root's slope is infinite at 0, so that branch must not see the 0 at all.
    apart = square > 0
    twice_sin = torch.where(apart, torch.where(apart, square, 1.0).sqrt(), 0.0)
    twice_cos = relative.diagonal(dim1=-2, dim2=-1).sum(-1) - 1.0
    return torch.atan2(twice_sin, twice_cos)


def vee(rotation: Tensor) -> Tensor:
    """A rotation's axis times twice the sine of its angle. (..., 3, 3) -> (..., 3)"""
    return torch.stack([rotation[..., i, j] - rotation[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], dim=-1)


def about_y(yaw: Tensor) -> Tensor:
    """Rotation about the vertical axis. (...) radians -> (..., 3, 3)"""
    sin, cos, zero, one = yaw.sin(), yaw.cos(), torch.zeros_like(yaw), torch.ones_like(yaw)
    rows = [cos, zero, sin, zero, one, zero, -sin, zero, cos]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def yaw_of(rotation: Tensor) -> Tensor:
    """Angle about the vertical axis of a rotation that is (nearly) about it. (..., 3, 3) -> (...) radians

    Averages what the x and the z column say, the least-squares answer for a noisy prediction.

    >>> yaw_of(about_y(torch.tensor([0.5, -3.0])))
    tensor([ 0.5000, -3.0000])
    """
    sin = rotation[..., 0, 2] - rotation[..., 2, 0]
    cos = rotation[..., 0, 0] + rotation[..., 2, 2]
    return torch.atan2(sin, cos)
