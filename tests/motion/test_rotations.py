import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from magnet.motion.rotations import about_y, from_6d, geodesic, to_6d, yaw_of


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
