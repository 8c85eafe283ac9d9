import math

import pytest
import torch

from magnet.sampling.noise import LEVELS, add_noise, alpha_bar, ddim_levels, ddim_step


def test_level_zero_is_clean_and_the_last_level_pure_noise_bit_for_bit(generator):
    clean, noise = (torch.randn(50, generator=generator) for _ in range(2))
    assert torch.equal(add_noise(clean, noise, torch.zeros(50, dtype=torch.long)), clean)
    assert torch.equal(add_noise(clean, noise, torch.full((50,), LEVELS)), noise)


def test_the_schedule_is_the_papers_cosine_divided_by_its_first_value():
    for k in (1, 33, 500, 999):
        paper = math.cos((k / LEVELS + 0.008) / 1.008 * math.pi / 2) ** 2
        first = math.cos(0.008 / 1.008 * math.pi / 2) ** 2
        assert alpha_bar(torch.tensor(k)).item() == pytest.approx(paper / first, rel=1e-5)


def test_the_schedule_falls():
    assert (alpha_bar(torch.arange(LEVELS + 1)).diff() < 0).all()


@pytest.mark.parametrize(("steps", "expected"), [(1, [1000, 0]), (3, [1000, 666, 333, 0])])
def test_ddim_levels_are_the_floor_of_even_steps(steps, expected):
    assert ddim_levels(steps).tolist() == expected


def test_thirty_steps_pass_the_papers_levels():
    assert ddim_levels(30).tolist()[-4:] == [100, 66, 33, 0]


def test_no_more_steps_than_levels():
    with pytest.raises(ValueError, match="denoising steps: got 1001"):
        ddim_levels(1001)


def test_with_the_true_clean_value_a_step_keeps_the_noise(generator):
    clean, noise = (torch.randn(20, generator=generator, dtype=torch.float64) for _ in range(2))
    now, after = torch.full((20,), 700), torch.full((20,), 300)
    stepped = ddim_step(add_noise(clean, noise, now), clean, now, after)
    assert torch.allclose(stepped, add_noise(clean, noise, after), atol=1e-6)


def test_what_does_not_move_comes_back_bit_identical(generator):
    noisy, clean = (torch.randn(LEVELS + 1, generator=generator) for _ in range(2))
    levels = torch.arange(LEVELS + 1)
    assert torch.equal(ddim_step(noisy, clean, levels, levels), noisy)


def test_what_reaches_level_zero_is_the_prediction(generator):
    noisy, clean = (torch.randn(LEVELS + 1, generator=generator) for _ in range(2))
    levels = torch.arange(LEVELS + 1)
    after = torch.zeros_like(levels)
    assert torch.equal(ddim_step(noisy, clean, levels, after)[1:], clean[1:])
