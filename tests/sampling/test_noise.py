import math

import pytest
import torch

from magnet.sampling.noise import (
    LEVELS,
    NoiseStream,
    add_noise,
    alpha_bar,
    ddim_levels,
    ddim_step,
    half_log_snr,
    opening_levels,
    shifted,
)


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
    with pytest.raises(ValueError, match="1000 with a shift of 3 would use the same"):
        ddim_levels(1000, 3.0)


def test_shifted_levels_rise_with_the_level_and_keep_both_ends():
    levels = torch.arange(LEVELS + 1)
    assert shifted(levels, 1.0) is levels
    moved = shifted(levels, 3.0)
    assert (moved.diff() >= 0).all() and moved[[0, 500, -1]].tolist() == [0, 750, LEVELS]
    assert (moved >= levels).all()
    assert ddim_levels(4, 3.0).tolist() == [1000, 900, 750, 500, 0]


def test_with_the_true_clean_value_a_step_keeps_the_noise(generator):
    clean, noise = (torch.randn(20, generator=generator, dtype=torch.float64) for _ in range(2))
    now, after = torch.full((20,), 700), torch.full((20,), 300)
    stepped = ddim_step(add_noise(clean, noise, now), clean, now, after)
    assert torch.allclose(stepped, add_noise(clean, noise, after), atol=1e-6)


@pytest.mark.parametrize("eta", [0.3, 1.0])
def test_new_noise_leaves_as_much_noise_as_there_should_be(eta, generator):
    clean, noise, step_noise = (torch.randn(200_000, generator=generator, dtype=torch.float64) for _ in range(3))
    now, after = torch.tensor(700), torch.tensor(300)
    stepped = ddim_step(add_noise(clean, noise, now), clean, now, after, eta, step_noise)
    left = (stepped - alpha_bar(after).double().sqrt() * clean) / (1 - alpha_bar(after).double()).sqrt()
    assert left.std() == pytest.approx(1, abs=0.01)
    assert torch.corrcoef(torch.stack([left, step_noise]))[0, 1] > 0.1


def test_all_noise_of_the_first_ancestral_step_is_new(generator):
    clean, noise, step_noise = (torch.randn(50, generator=generator) for _ in range(3))
    now, after = torch.tensor(LEVELS), torch.tensor(600)
    stepped = ddim_step(noise, clean, now, after, 1.0, step_noise)
    assert torch.allclose(stepped, add_noise(clean, step_noise, after), atol=1e-5)


def test_what_does_not_move_comes_back_bit_identical(generator):
    noisy, clean = (torch.randn(LEVELS + 1, generator=generator) for _ in range(2))
    levels = torch.arange(LEVELS + 1)
    assert torch.equal(ddim_step(noisy, clean, levels, levels), noisy)
    assert torch.equal(ddim_step(noisy, clean, levels, levels, 1.0, clean), noisy)


def test_what_reaches_level_zero_is_the_prediction(generator):
    noisy, clean = (torch.randn(LEVELS + 1, generator=generator) for _ in range(2))
    levels = torch.arange(LEVELS + 1)
    after = torch.zeros_like(levels)
    assert torch.equal(ddim_step(noisy, clean, levels, after)[1:], clean[1:])
    assert torch.equal(ddim_step(noisy, clean, levels, after, 1.0, noisy)[1:], clean[1:])


def seeded(*seeds: int) -> list[torch.Generator]:
    return [torch.Generator().manual_seed(seed) for seed in seeds]


@pytest.mark.parametrize("each", [False, True])
def test_noise_is_the_same_however_many_rows_are_drawn_at_a_time(each):
    def stream() -> NoiseStream:
        return NoiseStream((2, 3, 5), seeded(1, 2) if each else seeded(1)[0])

    whole, parts = stream().draw(7), stream()
    pieces = [parts.draw(count) for count in (1, 0, 4, 2)]
    for kind in (0, 1):
        assert torch.equal(torch.cat([piece[kind] for piece in pieces], dim=1), whole[kind])
    assert whole[0].shape == (2, 7, 3, 5)
    assert not torch.equal(*whole)


def test_with_a_generator_each_a_scenes_noise_does_not_depend_on_the_batch():
    both = NoiseStream((2, 3, 5), seeded(1, 2)).draw(4)
    alone = NoiseStream((1, 3, 5), seeded(2)).draw(4)
    assert torch.equal(both[0][1:], alone[0])
    assert torch.equal(both[1][1:], alone[1])


def test_generators_are_one_for_each_scene():
    for count in (1, 3):
        with pytest.raises(ValueError, match=f"got {count} generators for 2 scenes"):
            NoiseStream((2, 3, 5), seeded(*range(count)))


@pytest.mark.parametrize("each", [False, True])
def test_the_noise_of_a_step_hangs_on_its_place_alone(each):
    def stream() -> NoiseStream:
        return NoiseStream((2, 3, 5), seeded(1, 2) if each else seeded(1)[0], eta=1.0)

    levels = torch.tensor([1000, 1000, 500, 0])[:, None, None].expand(4, 3, 5).clone()
    levels[2, 1] = 250
    draws = [(0, 1000, None), (1, 1000, None), (2, 500, levels[2] == 500), (2, 250, levels[2] == 250)]
    whole, parts = stream(), stream()
    parts.draw(6)
    noise = whole.drawn(10, 4, draws)
    assert noise.shape == (2, 4, 3, 5)
    assert torch.equal(noise[:, 1:], parts.drawn(11, 3, [(row - 1, level, where) for row, level, where in draws[1:]]))
    assert (noise[:, 3] == 0).all()
    others = [noise[0, 0], noise[1, 0], noise[0, 1], noise[0, 2]]
    assert not any(torch.equal(a, b) for i, a in enumerate(others) for b in others[:i])
    again = stream().drawn(12, 1, [(0, 500, None)])
    assert torch.equal(noise[:, 2, 0], again[:, 0, 0])


def test_with_a_generator_each_a_steps_noise_does_not_depend_on_the_batch():
    draws = [(0, 700, None), (1, 700, None)]
    both = NoiseStream((2, 3, 5), seeded(1, 2), eta=1.0).drawn(0, 2, draws)
    alone = NoiseStream((1, 3, 5), seeded(2), eta=1.0).drawn(0, 2, draws)
    assert torch.equal(both[1:], alone)


def test_each_step_of_a_token_has_noise_of_its_own():
    stream = NoiseStream((1, 2, 50), seeded(1)[0], eta=1.0)
    drawn = [stream.drawn(first, 1, [(0, level, None)]) for first, level in ((3, 800), (3, 600), (4, 800))]
    flat = torch.stack(drawn).flatten(1)
    assert float((torch.corrcoef(flat) - torch.eye(3)).abs().max()) < 0.4


def test_a_scale_is_that_of_new_noise_alone():
    draws = [(0, 700, None), (1, 700, None)]
    plain, scaled = (NoiseStream((2, 3, 5), seeded(1, 2), eta=1.0, scale=scale) for scale in (1.0, 1.25))
    assert all(torch.equal(one, other) for one, other in zip(plain.draw(4), scaled.draw(4), strict=True))
    assert torch.equal(scaled.drawn(0, 2, draws), 1.25 * plain.drawn(0, 2, draws))
    unsaid = NoiseStream((2, 3, 5), seeded(1, 2), eta=1.0)
    assert torch.equal(unsaid.drawn(0, 2, draws), plain.drawn(0, 2, draws))
    with pytest.raises(ValueError, match="scale: got 0, expected"):
        NoiseStream((1, 1, 1), scale=0.0)


def test_eta_is_a_share():
    with pytest.raises(ValueError, match="eta: got 2, expected 0"):
        NoiseStream((1, 1, 1), eta=2.0)


def test_an_opening_before_a_level_of_much_noise_has_all_its_steps_above_it():
    levels = opening_levels(975, 3)
    assert len(levels) == 3 and (levels > 975).all() and (levels < LEVELS).all()


@pytest.mark.parametrize("first", [0, 1, 70, 634, 947, 990, 998, 999])
def test_an_opening_is_at_high_noise_in_steps_of_one_length(first):
    levels = opening_levels(first, 6)
    assert len(levels) <= 6 and (levels > first).all() and (levels < LEVELS).all() and (levels.diff() < 0).all()
    if first < 950:
        steps = half_log_snr(levels).diff()
        assert len(levels) == 6 and levels.min() > 950 and steps.max() < 1.6 * steps.min()
