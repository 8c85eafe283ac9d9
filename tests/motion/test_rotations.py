import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from magnet.motion.rotations import (
    about_y,
    from_6d,
    from_quat,
    from_rotvec,
    geodesic,
    quat_from_rotvec,
    quat_inverse,
    quat_product,
    quat_to_rotvec,
    to_6d,
    to_quat,
    to_rotvec,
    yaw_of,
)


def random_rotations(n: int) -> torch.Tensor:
    return torch.from_numpy(Rotation.random(n, random_state=0).as_matrix())


def test_6d_is_the_first_two_columns():
    R = random_rotations(1)[0]
    assert torch.equal(to_6d(R), torch.cat([R[:, 0], R[:, 1]]))


def test_6d_round_trip_is_exact():
    R = random_rotations(100)
    assert torch.allclose(from_6d(to_6d(R)), R, atol=1e-12)


def test_any_six_numbers_give_a_proper_rotation():
    R = from_6d(torch.randn(100, 6, dtype=torch.float64))
    assert torch.allclose(R.transpose(-1, -2) @ R, torch.eye(3, dtype=torch.float64).expand(100, 3, 3), atol=1e-9)
    assert torch.allclose(torch.linalg.det(R), torch.ones(100, dtype=torch.float64), atol=1e-9)


def test_geodesic_equals_scipys_angle():
    a, b = random_rotations(200)[:100], random_rotations(200)[100:]
    expected = (Rotation.from_matrix(a.numpy()).inv() * Rotation.from_matrix(b.numpy())).magnitude()
    assert np.allclose(geodesic(a, b).numpy(), expected, atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-7, 1e-4, 1e-2, 1.0, 3.0, torch.pi - 1e-3, torch.pi])
@pytest.mark.parametrize("axis", [[1.0, 0, 0], [0, 0.6, 0.8]])
def test_geodesic_is_right_and_its_gradient_finite_everywhere(angle: float, axis: list[float]):
    vector = (angle * torch.tensor(axis, dtype=torch.float64)).numpy()
    b = torch.from_numpy(Rotation.from_rotvec(vector).as_matrix()).requires_grad_()
    distance = geodesic(torch.eye(3, dtype=torch.float64), b)
    (gradient,) = torch.autograd.grad(distance, b)
    assert distance.item() == pytest.approx(angle, abs=1e-7)
    assert gradient.isfinite().all()


def test_geodesic_of_a_rotation_with_itself_is_zero_with_zero_gradient():
    a = random_rotations(50).float().requires_grad_()
    distance = geodesic(a, a.detach())
    (gradient,) = torch.autograd.grad(distance.sum(), a)
    assert distance.max() < 1e-6
    assert gradient.isfinite().all()


def test_yaw_round_trip():
    yaw = torch.linspace(-3.1, 3.1, 50)
    assert torch.allclose(yaw_of(about_y(yaw)), yaw, atol=1e-6)


def rotvecs(n: int = 3000) -> torch.Tensor:
    """Turns of all sizes: none, tiny ones, half turns about each axis and nearly, and any between."""
    axes = torch.from_numpy(Rotation.random(n, random_state=1).as_rotvec())
    axes = axes / axes.norm(dim=-1, keepdim=True)
    angles = torch.linspace(0, 1, n, dtype=torch.float64) * (torch.pi - 1e-6)
    angles[:100] = torch.logspace(-12, -3, 100, dtype=torch.float64)
    ends = torch.cat([torch.zeros(1, 3), torch.eye(3) * (torch.pi - 1e-6), torch.eye(3) * 1e-30]).double()
    return torch.cat([axes * angles[:, None], ends])


@pytest.mark.parametrize(("dtype", "near"), [(torch.float64, 1e-12), (torch.float32, 2e-6)])
def test_rotation_vectors_and_quaternions_are_scipys(dtype: torch.dtype, near: float) -> None:
    vectors = rotvecs()
    reference = Rotation.from_rotvec(vectors.numpy())
    matrices, quats = torch.from_numpy(reference.as_matrix()), torch.from_numpy(reference.as_quat())
    assert (from_rotvec(vectors.to(dtype)) - matrices).abs().max() < near
    assert (from_quat(quats.to(dtype)) - matrices).abs().max() < near
    assert (geodesic(from_rotvec(to_rotvec(matrices.to(dtype))).double(), matrices)).max() < 2 * near
    for got in (to_quat(matrices.to(dtype)), quat_from_rotvec(vectors.to(dtype))):
        assert ((got * quats).sum(-1).abs() - 1).abs().max() < near and got.dtype == dtype
    there = vectors.norm(dim=-1) < 3.1  # at half a turn both ways round are right
    assert (to_rotvec(matrices.to(dtype)) - vectors)[there].abs().max() < near
    assert (quat_to_rotvec(-quats.to(dtype)) - vectors)[there].abs().max() < near
    first, second = reference[:1500], reference[1500:3000]
    product = quat_product(quats[:1500].to(dtype), quat_inverse(quats[1500:3000].to(dtype)))
    assert (from_quat(product) - torch.from_numpy((first * second.inv()).as_matrix())).abs().max() < near


def test_a_rotation_vectors_slope_is_finite_and_right_at_nothing() -> None:
    some = torch.cat(
        [torch.randn(5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)), torch.zeros(1, 3)]
    )
    assert torch.autograd.gradcheck(from_rotvec, (some.requires_grad_(),), atol=1e-6)


@pytest.mark.parametrize("shape", [(0, 3), (2, 0, 3), (3,), (2, 5, 3)])
def test_rotation_vectors_of_any_shape(shape: tuple[int, ...]) -> None:
    turns = torch.rand(shape)
    assert from_rotvec(turns).shape == (*shape, 3) and to_quat(from_rotvec(turns)).shape == (*shape[:-1], 4)
    assert torch.allclose(to_rotvec(from_rotvec(turns)), turns, atol=1e-6)
