"""Rotations as matrices: their other forms, and an angle that is safe to differentiate.

Rotation vectors and quaternions are here, and not roma's, because roma imports torch's compiler: whoever samples would
wait for it, two seconds, for nothing. Tests compare them with SciPy's.
"""

import torch
from torch import Tensor
from torch.nn import functional as F


def to_6d(rotation: Tensor) -> Tensor:
    """First two *columns* of a rotation matrix, one after the other. (..., 3, 3) -> (..., 6)

    Libraries disagree on this: some use rows. Columns follow Zhou et al. 2019; the paper (3.1) does not say.

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


def from_rotvec(rotvec: Tensor) -> Tensor:
    """The rotation about an axis by its length in radians (Rodrigues). (..., 3) -> (..., 3, 3)

    >>> from_rotvec(torch.tensor([0.0, torch.pi, 0.0])).round().diagonal()
    tensor([-1.,  1., -1.])
    """
    x, y, z = rotvec.unbind(-1)
    square = x * x + y * y + z * z
    angle = square.clamp_min(torch.finfo(rotvec.dtype).tiny).sqrt()  # whose slope is finite at 0
    half = torch.sinc(angle / (2 * torch.pi))
    a, b = torch.sinc(angle / torch.pi), half * half / 2  # sin(angle) / angle, (1 - cos(angle)) / angle^2
    bx, by, bz, c = b * x, b * y, b * z, 1 - b * square
    ax, ay, az = a * x, a * y, a * z
    rows = [
        bx * x + c,
        bx * y - az,
        bx * z + ay,
        bx * y + az,
        by * y + c,
        by * z - ax,
        bx * z - ay,
        by * z + ax,
        bz * z + c,
    ]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def to_quat(rotation: Tensor) -> Tensor:
    """Unit quaternion x, y, z, w of a rotation, one of the two. (..., 3, 3) -> (..., 4)

    4 q q^T is linear in the rotation; its row with the largest diagonal is q times a number that is not small.
    """
    R = rotation
    trace = R.diagonal(dim1=-2, dim2=-1).sum(-1)
    twice = R + R.mT
    x, y, z = vee(R).unbind(-1)
    rows = [
        [1 - trace + twice[..., 0, 0], twice[..., 0, 1], twice[..., 0, 2], x],
        [twice[..., 0, 1], 1 - trace + twice[..., 1, 1], twice[..., 1, 2], y],
        [twice[..., 0, 2], twice[..., 1, 2], 1 - trace + twice[..., 2, 2], z],
        [x, y, z, 1 + trace],
    ]
    square = torch.stack([number for row in rows for number in row], dim=-1).unflatten(-1, (4, 4))
    largest = square.diagonal(dim1=-2, dim2=-1).argmax(-1)
    row = square.gather(-2, largest[..., None, None].expand(*largest.shape, 1, 4))[..., 0, :]
    return F.normalize(row, dim=-1)


def from_quat(quat: Tensor) -> Tensor:
    """The rotation of a unit quaternion x, y, z, w. (..., 4) -> (..., 3, 3)"""
    x, y, z, w = quat.unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
        2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
        2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def to_rotvec(rotation: Tensor) -> Tensor:
    """A rotation's axis times its angle, which is at most pi. (..., 3, 3) -> (..., 3)

    >>> to_rotvec(about_y(torch.tensor(0.25)))
    tensor([0.0000, 0.2500, 0.0000])
    """
    return quat_to_rotvec(to_quat(rotation))


def quat_to_rotvec(quat: Tensor) -> Tensor:
    """As `to_rotvec`, of a unit quaternion x, y, z, w. (..., 4) -> (..., 3)"""
    axis, w = quat[..., :3], quat[..., 3:]
    axis, w = torch.where(w < 0, -axis, axis), w.abs()
    sine = (axis * axis).sum(-1, keepdim=True).clamp_min(torch.finfo(quat.dtype).tiny).sqrt()
    return axis * (2 * torch.atan2(sine, w) / sine)


def quat_from_rotvec(rotvec: Tensor) -> Tensor:
    """The unit quaternion x, y, z, w of an axis times an angle. (..., 3) -> (..., 4)"""
    half = rotvec.norm(dim=-1, keepdim=True) / 2
    return torch.cat([rotvec * torch.sinc(half / torch.pi) / 2, half.cos()], dim=-1)


def quat_product(a: Tensor, b: Tensor) -> Tensor:
    """The rotation b and then a, as quaternions x, y, z, w. (..., 4) x 2 -> (..., 4)"""
    v, u = a[..., :3], b[..., :3]
    vector = a[..., 3:] * u + b[..., 3:] * v + torch.linalg.cross(v, u, dim=-1)
    return torch.cat([vector, a[..., 3:] * b[..., 3:] - (v * u).sum(-1, keepdim=True)], dim=-1)


def quat_inverse(quat: Tensor) -> Tensor:
    """The inverse of a unit quaternion x, y, z, w. (..., 4) -> (..., 4)"""
    return torch.cat([-quat[..., :3], quat[..., 3:]], dim=-1)


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
