"""Solvers: bit laws of a step, order of convergence, and a memory that belongs to each number of each token."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from magnet.motion.tokens import TokenLayout
from magnet.sampling.guidance import Guidance
from magnet.sampling.noise import LEVELS, NoiseStream, alpha_bar, ddim_levels, ddim_step, half_log_snr, log_snr_levels
from magnet.sampling.planned_stage import Denoising
from magnet.sampling.sampler import begin, run_stages, sample
from magnet.sampling.schedule import Grid, MaskSchedule
from magnet.sampling.solvers import History
from magnet.tasks import registry
from magnet.tasks.agentic import AgenticAsync, AgenticSync
from magnet.tasks.joint import JointFuture
from magnet.testing import mixing
from tests.cases import few
from tests.sampling.plain import solver_step

# -- levels ------------------------------------------------------------------------------------


@pytest.mark.parametrize("steps", [*range(1, 41), 64, 100, 200, 500, 999, 1000])
def test_levels_even_in_log_snr_fall_from_pure_noise_to_clean_and_no_two_are_alike(steps):
    levels = log_snr_levels(steps)
    assert len(levels) == steps + 1 and levels[0] == LEVELS and levels[-1] == 0
    assert (levels.diff() < 0).all()


@pytest.mark.parametrize("steps", [4, 8, 16, 30])
def test_they_are_even_as_far_as_levels_are_fine_enough_and_end_near_0(steps):
    levels = log_snr_levels(steps)[1:-1]
    gaps = half_log_snr(levels).diff()
    rounding = half_log_snr(levels - 1) - half_log_snr(levels)  # from a level to the next
    away = gaps - gaps.mean()
    assert (away.abs() <= rounding[1:] + rounding[:-1]).all()
    assert levels[-1] <= 5 and gaps.mean() > 0


def test_the_log_snr_is_that_of_the_schedule_and_infinite_at_its_ends():
    levels = torch.arange(1, LEVELS)
    share = torch.sigmoid(2 * half_log_snr(levels).double())
    assert torch.allclose(share, alpha_bar(levels).double(), atol=1e-6)
    assert half_log_snr(torch.tensor([0, LEVELS])).tolist() == [torch.inf, -torch.inf]


@pytest.mark.parametrize("steps", [0, 1001])
def test_as_many_levels_as_there_are(steps):
    with pytest.raises(ValueError, match=f"denoising steps: got {steps}, expected 1 to 1000"):
        log_snr_levels(steps)


# -- bit laws ----------------------------------------------------------------------------------


def made(generator: torch.Generator, *levels: int) -> tuple[Tensor, Tensor, History]:
    """Noisy tokens, predictions, and memories of predictions at some levels, one a token step."""
    noisy, clean, before = (torch.randn(2, len(levels), 2, 5, generator=generator) for _ in range(3))
    return noisy, clean, History(before, torch.tensor(levels)[:, None, None].expand(-1, 2, 5).clone())


def spread(*levels: int) -> Tensor:
    return torch.tensor(levels)[:, None, None].expand(-1, 2, 5)


def test_what_does_not_move_comes_back_bit_identical_and_keeps_its_memory(generator):
    noisy, clean, history = made(generator, 900, LEVELS, -1, 300, 700)
    before = history.clean.clone()
    levels = spread(500, 700, 0, 200, LEVELS)
    assert torch.equal(solver_step(noisy, clean, levels, levels, history=history), noisy)
    assert torch.equal(history.clean, before)
    assert history.levels[:, 0, 0].tolist() == [900, LEVELS, -1, 300, 700]


def test_what_reaches_level_zero_is_the_prediction(generator):
    noisy, clean, history = made(generator, 900, LEVELS, -1)
    now = spread(500, 700, LEVELS)
    for eta, step_noise in ((0.0, None), (1.0, torch.randn(noisy.shape, generator=generator))):
        assert torch.equal(solver_step(noisy, clean, now, torch.zeros_like(now), eta, step_noise, history), clean)


@pytest.mark.parametrize("eta", [0.0, 1.0])
def test_the_first_step_is_of_first_order(eta, generator):
    noisy, clean, history = made(generator, -1, -1)
    step_noise = torch.randn(noisy.shape, generator=generator)
    now, after = spread(LEVELS, 500), spread(700, 20)
    stepped = solver_step(noisy, clean, now, after, eta, step_noise, history)
    assert torch.equal(stepped, ddim_step(noisy, clean, now, after, eta, step_noise))
    assert torch.equal(history.clean, clean) and torch.equal(history.levels, now)


def test_a_prediction_that_does_not_change_makes_it_ddim(generator):
    noisy, clean, history = made(generator, 900, 1000)
    history.clean.copy_(clean)
    now, after = spread(500, 700), spread(300, 100)
    assert torch.equal(solver_step(noisy, clean, now, after, history=history), ddim_step(noisy, clean, now, after))


def test_a_step_is_the_papers_formula_in_short_steps(generator):
    """x_t = sigma_t / sigma_s x_s - alpha_t (exp(-h) - 1) ((1 + 1 / 2r) x0_s - 1 / 2r x0_r), h steps of lambda."""
    noisy, clean, history = made(generator, 420)
    before = history.clean.double()
    stepped = solver_step(noisy, clean, spread(400), spread(370), history=history)
    (r, s, t) = (alpha_bar(torch.tensor(level)).double() for level in (420, 400, 370))
    lam = [(share / (1 - share)).log() / 2 for share in (r, s, t)]
    h, ratio = lam[2] - lam[1], (lam[1] - lam[0]) / (lam[2] - lam[1])
    mixed = (1 + 1 / (2 * ratio)) * clean.double() - before / (2 * ratio)
    right = ((1 - t) / (1 - s)).sqrt() * noisy.double() - t.sqrt() * ((-h).exp() - 1) * mixed
    torch.testing.assert_close(stepped.double(), right, atol=1e-5, rtol=0)


@pytest.mark.parametrize("spacing", [ddim_levels, log_snr_levels])
def test_a_plan_of_one_step_is_ddims(spacing):
    assert spacing(1).tolist() == [LEVELS, 0]
    made = [run(JointFuture(), Grid(8, 2, 4, steps=1, window=8), solver) for solver in ("ddim", "dpmpp_2m")]
    assert torch.equal(*made)


# -- order -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("multistep", "factor"), [(False, (1.8, 2.3)), (True, (3.4, 4.8))])
@pytest.mark.parametrize("variance", [1.0, 0.1])
def test_twice_the_steps_leave_a_half_or_a_quarter_of_the_error(multistep, factor, variance):
    """Down the exact flow of a Gaussian, whose spread is known at every level; all in float64."""
    ends = half_log_snr(torch.tensor([900, 15])).double()

    def error(steps: int) -> float:
        wanted = torch.linspace(*ends.tolist(), steps + 1, dtype=torch.float64)
        levels = (half_log_snr(torch.arange(1, LEVELS)).double() - wanted[:, None]).abs().argmin(dim=1) + 1

        def width(level: Tensor) -> Tensor:
            return (alpha_bar(level).double() * (variance - 1) + 1).sqrt()

        x = width(levels[0]).view(1, 1, 1, 1)
        history = History.empty(x) if multistep else None
        for now, after in pairwise(levels):
            share = alpha_bar(now).double()
            clean = x * share.sqrt() * variance / (share * variance + 1 - share)
            x = solver_step(x, clean, now.view(1, 1, 1), after.view(1, 1, 1), history=history)
        return abs(float(x) - float(width(levels[-1])))

    low, high = factor
    for steps in (16, 32):
        assert low < error(steps) / error(2 * steps) < high


# -- every number remembers for itself ---------------------------------------------------------

LAYOUT = {people: TokenLayout(latent=4, agents=people) for people in (2, 3)}


def alone(noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
    """A denoiser that looks at each number by itself, in a bent way."""
    layout = LAYOUT[noisy.shape[2]]
    share = alpha_bar(layout.spread(layout.group_levels(levels)))
    return torch.tanh(1.5 * noisy * share.sqrt()) * (0.3 + share)


def seeded(*seeds: int) -> list[torch.Generator]:
    return [torch.Generator().manual_seed(seed) for seed in seeds]


def run(
    task, grid: Grid, solver: str = "dpmpp_2m", denoise=alone, scenes: Sequence[int] = (1, 2), eta: float = 0.0, **more
) -> Tensor:
    """Scenes of one recording, each with noise of its own by number."""
    layout = LAYOUT[grid.agents]
    tokens = torch.randn(1, grid.tokens, grid.agents, layout.width, generator=seeded(5)[0]).repeat(len(scenes), 1, 1, 1)
    noise = NoiseStream((len(scenes), grid.agents, layout.width), seeded(*scenes), eta=eta)
    present = torch.ones(len(scenes), grid.agents, dtype=torch.bool)
    return sample(denoise, task.schedule(grid), tokens, present, layout, noise=noise, solver=solver, **more)


@pytest.mark.parametrize("spacing", ["even", "log_snr"])
@pytest.mark.parametrize("eta", [0.0, 1.0])
def test_numbers_are_solved_as_if_alone_however_a_plan_is_laid(eta, spacing):
    """Strides, slopes, pyramids, turns and views give each number the same levels at other times: the same sample."""
    grid = {"tokens": 16, "agents": 2, "context": 4, "steps": 6, "spacing": spacing}
    whole = run(JointFuture(), Grid(window=16, stride=16, pyramid_offset=0, **grid), eta=eta)
    assert not torch.equal(
        whole, run(JointFuture(), Grid(window=16, stride=16, pyramid_offset=0, **grid), "ddim", eta=eta)
    )
    for shape in ({"window": 8, "stride": 3}, {"window": 8, "pyramid_offset": 2}, {"window": 8, "pyramid_offset": 1}):
        assert torch.equal(run(JointFuture(), Grid(**grid, **shape), eta=eta), whole)
    for offset in (0.0, 0.5, 1.0):
        turns = run(AgenticAsync(offset, (1, 0), block=2), Grid(window=8, stride=3, **grid), eta=eta)
        assert torch.equal(turns, whole)
    own = LAYOUT[2].groups() == 0
    in_step = run(AgenticSync(block=3), Grid(window=8, stride=3, **grid), eta=eta)
    assert torch.equal(in_step[..., own], whole[..., own])


@pytest.mark.parametrize(
    "guidance", [Guidance(), Guidance("partner"), Guidance(smooth=0.01), Guidance(stabilization_level=50)]
)
@pytest.mark.parametrize("name", few(registry.names(), 3))
def test_a_batch_is_sampled_as_each_scene_alone(name, guidance):
    task = registry.get(name)()
    grid = Grid(
        12, 3, 0 if name == "generation" else 4, steps=4, window=8, stride=3, pyramid_offset=None, spacing="log_snr"
    )
    both = run(task, grid, denoise=mixing, guidance=guidance)
    each = [run(task, grid, denoise=mixing, scenes=[scene], guidance=guidance) for scene in (1, 2)]
    torch.testing.assert_close(both, torch.cat(each), atol=1e-5, rtol=0)


@pytest.mark.parametrize("name", registry.names())
def test_rows_may_come_and_go_between_stages(name):
    """A canvas that is extended and released as a stream does it, a stage at a time."""
    task, layout = registry.get(name)(), LAYOUT[3]
    schedule = task.schedule(
        Grid(14, 3, 0 if name == "generation" else 4, steps=4, window=6, stride=2, spacing="log_snr")
    )
    generator = torch.Generator().manual_seed(4)
    tokens, noise, mask_noise = (torch.randn(2, 14, 3, layout.width, generator=generator) for _ in range(3))
    start = begin(tokens, noise, schedule.known, layout)
    how = Denoising(mixing, torch.ones(2, 3, dtype=torch.bool), layout)
    whole = run_stages(how, schedule.stages, start, mask_noise, history=History.empty(start))

    held, first = start[:, :0], 0
    history, out = History.empty(held), start.clone()
    for stage in schedule.stages:
        gone = max(stage.start - first, 0)
        held, history, first = held[:, gone:], history.release(gone), first + gone
        more = start[:, first + held.shape[1] : stage.stop]
        held, history = torch.cat([held, more], dim=1), history.extend(more)
        moved = type(stage)(stage.start - first, stage.levels, stage.visibility)
        held = run_stages(how, [moved], held, mask_noise[:, first:], history=history)
        out[:, first : first + held.shape[1]] = held
    assert torch.equal(out, whole)


def test_the_loop_is_told_by_name_which_solver(generator):
    grid = Grid(10, 2, 4, steps=5, window=8, spacing="log_snr")
    schedule: MaskSchedule = JointFuture().schedule(grid)
    tokens = torch.randn(2, 10, 2, LAYOUT[2].width, generator=generator)
    present = torch.ones(2, 2, dtype=torch.bool)
    ddim, plain, second = (
        sample(mixing, schedule, tokens, present, LAYOUT[2], torch.Generator().manual_seed(1), **more)
        for more in ({"solver": "ddim"}, {}, {"solver": "dpmpp_2m"})
    )
    assert torch.equal(ddim, plain) and not torch.equal(plain, second)
    assert torch.equal(second[:, :4], tokens[:, :4])
