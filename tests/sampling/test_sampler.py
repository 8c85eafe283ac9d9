import pytest
import torch
from torch import Tensor

from magnet.motion.tokens import TokenLayout
from magnet.sampling.noise import LEVELS, alpha_bar
from magnet.sampling.sampler import sample
from magnet.sampling.schedule import Grid, MaskSchedule, Stage

LAYOUT = TokenLayout(latent=6, agents=3)
PRESENT = torch.ones(2, 3, dtype=torch.bool)


def joint(grid: Grid) -> MaskSchedule:
    return MaskSchedule.full_sequence(grid.past(), ~grid.past(), grid)


def mixing(noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
    """A toy denoiser in which everything depends on everything, and no agent has a name."""
    pooled = (noisy * (1 + levels[..., None] / LEVELS)).mean(dim=(1, 2), keepdim=True)
    return torch.tanh(noisy.roll(1, dims=1) + pooled)


def make_tokens(grid: Grid, generator: torch.Generator) -> Tensor:
    return torch.randn(2, grid.tokens, grid.agents, LAYOUT.width, generator=generator)


def run(grid: Grid, tokens: Tensor, seed: int = 0, denoise=mixing, **options) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return sample(denoise, joint(grid), tokens, PRESENT, LAYOUT, generator, **options)


GRID = Grid(tokens=30, agents=3, context=5, steps=4)


def test_context_tokens_return_bit_identical(generator):
    tokens = make_tokens(GRID, generator)
    assert torch.equal(run(GRID, tokens)[:, :5], tokens[:, :5])


def test_an_oracle_gives_the_truth_back(generator):
    tokens = make_tokens(GRID, generator)
    position = iter([stage for stage in joint(GRID).stages for _ in stage.levels[1:]])

    def oracle(noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
        stage = next(position)
        return tokens[:, stage.start : stage.stop]

    assert torch.equal(run(GRID, tokens, denoise=oracle), tokens)


def test_what_is_not_known_cannot_influence_the_sample(generator):
    tokens = make_tokens(GRID, generator)
    other = tokens.clone()
    other[:, 5:] = torch.randn(other[:, 5:].shape, generator=generator) * 100
    assert torch.equal(run(GRID, tokens), run(GRID, other))


def test_the_future_may_even_be_missing(generator):
    tokens = make_tokens(GRID, generator)
    other = tokens.clone()
    other[:, 5:] = torch.nan
    assert torch.equal(run(GRID, tokens), run(GRID, other))


def test_same_seed_same_sample_other_seed_other_sample(generator):
    tokens = make_tokens(GRID, generator)
    assert torch.equal(run(GRID, tokens, 1), run(GRID, tokens, 1))
    assert not torch.equal(run(GRID, tokens, 1), run(GRID, tokens, 2))


def test_the_denoiser_runs_as_often_as_the_schedule_says(generator):
    calls = []

    def counting(noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
        calls.append(levels)
        return mixing(noisy, levels, present)

    steps = []
    run(GRID, make_tokens(GRID, generator), denoise=counting, progress=steps.append)
    assert len(calls) == joint(GRID).evaluations == sum(steps)


def test_agents_have_no_names_in_the_loop(generator):
    """A denoiser blind to the agents' order gives permuted samples for permuted agents and noise."""
    order = torch.tensor([2, 0, 1])
    layout = TokenLayout(latent=6, agents=3, pairwise=False)
    tokens = torch.randn(2, 30, 3, layout.width, generator=generator)

    noise = torch.randn(2, *tokens.shape, generator=generator)

    class Given:
        eta = 0.0

        def __init__(self, both: Tensor) -> None:
            self.both = both

        def draw(self, count: int) -> tuple[Tensor, Tensor]:
            return self.both[0], self.both[1]

    def run_with(given: Tensor, both: Tensor) -> Tensor:
        return sample(mixing, joint(GRID), given, PRESENT, layout, noise=Given(both))

    plain = run_with(tokens, noise)
    permuted = run_with(tokens[:, :, order], noise[:, :, :, order])
    assert torch.allclose(plain[:, :, order], permuted, atol=1e-6)


def test_relations_to_unknown_agents_are_never_shown(generator):
    """Agent 1 known throughout, agent 0 not: agent 1's slot toward agent 0 must not hold the truth."""
    grid = Grid(tokens=6, agents=3, context=0, steps=3)
    known = grid.mask()
    known[:, 1] = True
    schedule = MaskSchedule.full_sequence(known, ~known, grid)
    tokens = make_tokens(grid, generator)
    seen = []

    def watching(noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
        seen.append(noisy.clone())
        return mixing(noisy, levels, present)

    sample(watching, schedule, tokens, PRESENT, LAYOUT, generator)
    own = LAYOUT.groups() == 0
    toward_unknown = ~own
    assert torch.equal(seen[0][:, :, 1][..., own], tokens[:, :, 1][..., own])
    assert (seen[0][:, :, 1][..., toward_unknown] != tokens[:, :, 1][..., toward_unknown]).all()


def hiding_stage(grid: Grid) -> Stage:
    """Everybody denoises the last step at once, without seeing the others'."""
    levels = torch.zeros(3, grid.tokens, grid.agents, dtype=torch.long)
    levels[:, -1] = torch.tensor([1000, 500, 0])[:, None]
    hidden = torch.zeros(grid.agents, grid.tokens, grid.agents, dtype=torch.bool)
    hidden[:, -1] = ~torch.eye(grid.agents, dtype=torch.bool)
    return Stage(0, levels, ~hidden)


def test_what_a_view_hides_cannot_influence_it(generator):
    """With the others' current tokens hidden, perturbing what the model says of them changes nothing."""
    grid = Grid(tokens=4, agents=3, context=3)
    schedule = MaskSchedule(4, 3, (hiding_stage(grid),), grid.past())
    tokens = make_tokens(grid, generator)

    def run_with(extra: float) -> Tensor:
        def denoise(noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
            clean = mixing(noisy, levels, present)
            clean[:, -1, 2] += extra
            return clean

        return sample(denoise, schedule, tokens, PRESENT, LAYOUT, torch.Generator().manual_seed(0))

    a, b = run_with(0.0), run_with(50.0)
    own = LAYOUT.groups() == 0
    assert torch.equal(a[:, -1, :2], b[:, -1, :2])
    assert not torch.equal(a[:, -1, 2][..., own], b[:, -1, 2][..., own])


def test_grid_and_tokens_must_fit(generator):
    with pytest.raises(ValueError, match="tokens are 7 x 3"):
        run(GRID, torch.zeros(2, 7, 3, LAYOUT.width))


@pytest.mark.parametrize("offset", [0.0, 0.5, 1.0])
def test_in_every_view_numbers_are_as_noisy_as_they_are_said_to_be(offset, generator):
    """The model believes levels; with a model that says 0, what is left at level k has the spread of noise at k."""
    from magnet.tasks.agentic import AgenticAsync

    grid = Grid(tokens=8, agents=3, context=4, steps=8, window=8)
    layout = TokenLayout(latent=4, agents=3)
    plan = AgenticAsync(offset, order=(1, 2, 0), block=2).schedule(grid)

    def nothing(noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
        share = (1 - alpha_bar(layout.group_levels(levels))).sqrt()
        for group in range(3):
            spread = noisy[..., layout.groups() == group].std(dim=(0, -1))
            assert torch.allclose(spread, share[0, ..., group], atol=0.06), f"group {group}"
        return torch.zeros_like(noisy)

    def one_view(noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
        views = levels.flatten(1).unique(dim=0)
        out = torch.zeros_like(noisy)
        for view in views:
            mine = (levels.flatten(1) == view).all(dim=1)
            out[mine] = nothing(noisy[mine], levels[mine], present[mine])
        return out

    tokens = torch.zeros(400, 8, 3, layout.width)
    sample(one_view, plan, tokens, torch.ones(400, 3, dtype=torch.bool), layout, generator)


def test_a_relation_is_denoised_in_the_view_of_whoever_sees_both(generator):
    from magnet.tasks.agentic import AgenticAsync

    grid = Grid(tokens=6, agents=2, context=4, steps=6, window=6)
    layout = TokenLayout(latent=4, agents=2)
    plan = AgenticAsync(0.5).schedule(grid)
    truth = torch.randn(2, 6, 2, layout.width, generator=generator)
    stages = iter([stage for stage in plan.stages for _ in range(len(stage.levels) - 1)])

    def oracle(noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
        stage = next(stages)
        return truth[:, stage.start : stage.stop].repeat_interleave(len(noisy) // 2, dim=0)

    out = sample(oracle, plan, truth, torch.ones(2, 2, dtype=torch.bool), layout, generator)
    assert torch.equal(out, truth), "both pairs too, without anybody putting them right afterwards"
