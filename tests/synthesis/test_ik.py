"""Chains of two bones, smooth curves and footsteps, each against its definition."""

from __future__ import annotations

import math

import pytest
import torch

from magnet.synthesis.gait import plan_feet
from magnet.synthesis.ik import about, about_x, about_z, ease, fraction, smooth, two_bones, under
from magnet.synthesis.people import gather, noise


def random_vectors(generator: torch.Generator, count: int) -> torch.Tensor:
    return torch.randn(count, 3, generator=generator, dtype=torch.float64)


def test_two_bones_reach_their_target_and_bend_to_the_side_asked(generator: torch.Generator) -> None:
    rest = (torch.tensor([0.02, -0.4, 0.01]).double(), torch.tensor([0.0, -0.42, -0.02]).double())
    start = random_vectors(generator, 500)
    aim = random_vectors(generator, 500)
    far = 0.1 + 0.7 * torch.rand(500, 1, generator=generator, dtype=torch.float64)
    target = start + far * aim / aim.norm(dim=-1, keepdim=True)
    bend = random_vectors(generator, 500)
    upper, lower = two_bones(start, target, bend, rest, torch.tensor([1.0, 0.0, 0.0]).double())
    middle = start + upper @ rest[0]
    assert torch.allclose(middle + lower @ rest[1], target, atol=1e-6)
    aside = middle - start - ((middle - start) * aim).sum(-1, keepdim=True) * aim / (aim**2).sum(-1, keepdim=True)
    assert ((aside * bend).sum(-1) > -1e-9).all()
    # Only the hinge turns: the axis at rest is the same for both bones but for the bones' own tilt.
    axis = torch.tensor([1.0, 0.0, 0.0]).double()
    assert ((upper @ axis) * (lower @ axis)).sum(-1).min() > 0.99


def test_two_bones_out_of_reach_stretch_toward_the_target() -> None:
    rest = (torch.tensor([0.3, 0.0, 0.0]).double(), torch.tensor([0.25, 0.0, 0.0]).double())
    zero, aim = torch.zeros(3).double(), torch.tensor([0.0, 2.0, 0.0]).double()
    bend, hinge = torch.tensor([0.0, 0.0, 1.0]).double(), torch.tensor([0.0, -1.0, 0.0]).double()
    upper, lower = two_bones(zero, aim, bend, rest, hinge)
    end = upper @ rest[0] + lower @ rest[1]
    assert torch.allclose(end, torch.tensor([0.0, 0.55, 0.0]).double(), atol=1e-3)


def test_fractions_of_a_turn_add_up(generator: torch.Generator) -> None:
    axis = random_vectors(generator, 50)
    axis = axis / axis.norm(dim=-1, keepdim=True)
    angle = 3 * torch.rand(50, generator=generator, dtype=torch.float64)
    whole = about(axis, angle)
    assert torch.allclose(fraction(whole, 0.3) @ fraction(whole, 0.7), whole, atol=1e-9)
    assert torch.equal(fraction(torch.eye(3).double(), 0.5), torch.eye(3).double())


def test_axes_turn_as_their_names_say() -> None:
    quarter = torch.tensor(math.pi / 2, dtype=torch.float64)
    x, y, z = torch.eye(3).double()
    assert torch.allclose(about_x(quarter) @ z, -y)
    assert torch.allclose(about_z(quarter) @ x, y)
    assert torch.allclose(about(y, quarter) @ z, x)


def test_under_never_exceeds_its_ceiling_and_is_smooth(generator: torch.Generator) -> None:
    ceiling = torch.rand(200, 3, generator=generator, dtype=torch.float64)
    curve = under(ceiling, 4)
    assert curve.shape == ceiling.shape
    assert (curve <= ceiling + 1e-12).all()
    assert curve.diff(n=2, dim=0).abs().max() < 0.3 * ceiling.diff(n=2, dim=0).abs().max()


def test_smooth_keeps_constants_and_ease_rests_at_its_ends() -> None:
    assert torch.allclose(smooth(torch.full((40, 2), 3.0).double(), 2.5), torch.full((40, 2), 3.0).double())
    u = torch.tensor([-1.0, 0.0, 0.5, 1.0, 2.0]).double().requires_grad_()
    value = ease(u)
    assert value.tolist() == pytest.approx([0, 0, 0.5, 1, 1])
    (slope,) = torch.autograd.grad(value.sum(), u)
    assert slope[[0, 1, 3, 4]].abs().max() == 0


def test_noise_has_unit_variance_and_no_fast_part(generator: torch.Generator) -> None:
    signal = noise(generator, 30 * 400, 8)
    assert signal.std(dim=0).mean() == pytest.approx(1, abs=0.1)
    power = torch.fft.rfft(signal, dim=0).abs() ** 2
    hertz = torch.fft.rfftfreq(len(signal), 1 / 30)
    assert power[hertz > 1.0].sum() < 1e-3 * power.sum()


class Stick:
    """A body of one shape, for footsteps."""

    id = "stick"

    def rest_joints(self, betas: torch.Tensor) -> torch.Tensor:
        joints = torch.zeros(22, 3)
        joints[10], joints[11] = torch.tensor([0.1, -0.9, 0.12]), torch.tensor([-0.1, -0.9, 0.12])
        return joints.expand(*betas.shape[:-1], 22, 3)


def test_planted_feet_never_move_and_mirroring_twice_changes_nothing(generator: torch.Generator) -> None:
    people = gather(1, generator, Stick())
    t = torch.arange(300, dtype=torch.float64) / 30
    heading = 0.5 * torch.sin(t)
    ground = torch.stack([0.9 * t, 0.4 * torch.sin(0.7 * t)], dim=-1)
    feet = plan_feet(ground, heading, people, 0)
    both = feet.planted[1:] & feet.planted[:-1]
    moved = feet.ball.diff(dim=0).norm(dim=-1)
    assert (moved[both] == 0).all()
    assert both.float().mean() > 0.4
    assert feet.planted.any(dim=1).all()  # one foot always bears
    assert (feet.ball[..., [0, 2]].mean(dim=1) - ground).norm(dim=-1).max() < 0.6  # and they keep up
    twice = feet.mirrored().mirrored()
    for name, value in vars(feet).items():
        assert torch.allclose(getattr(twice, name).double(), value.double(), atol=1e-12), name


def test_who_stands_still_takes_no_step(generator: torch.Generator) -> None:
    people = gather(1, generator, Stick())
    feet = plan_feet(torch.zeros(90, 2).double(), torch.zeros(90).double(), people, 0)
    assert feet.planted.all()
