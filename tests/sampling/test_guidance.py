from dataclasses import replace

import pytest
import torch
from torch import Tensor

from magnet.denoiser.options import Sampling
from magnet.motion.tokens import TokenLayout
from magnet.sampling.faint import faint_levels
from magnet.sampling.grid import planning_grid
from magnet.sampling.guidance import Guidance, roughness
from magnet.sampling.noise import LEVELS, add_noise
from magnet.sampling.options import SamplerOptions
from magnet.sampling.planned_stage import Denoising, run_planned_stage
from magnet.sampling.schedule import Stage

PEOPLE = 3
LAYOUT = TokenLayout(latent=4, agents=PEOPLE)


@pytest.fixture
def given(generator):
    tokens = torch.randn(2, 6, PEOPLE, LAYOUT.width, generator=generator)
    mask_noise = torch.randn(tokens.shape, generator=generator)
    levels = torch.zeros(2, 6, PEOPLE, dtype=torch.long)
    levels[:, 4:] = 600
    return tokens, levels, torch.ones(2, PEOPLE, dtype=torch.bool), mask_noise


def model(noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
    pooled = (noisy * (1 + levels[..., None] / LEVELS)).mean(dim=(1, 2), keepdim=True)
    return torch.tanh(noisy.roll(1, dims=1) + pooled)


def with_history(given, whose: list[int]) -> Tensor:
    """Slow reference: one branch, in which only some agents' history is seen."""
    tokens, levels, present, mask_noise = (x.clone() for x in given)
    for agent in range(PEOPLE):
        if agent not in whose:
            levels[:, :4, agent] = LEVELS
    groups = LAYOUT.spread(LAYOUT.group_levels(levels))
    tokens = torch.where((groups == LEVELS), mask_noise, tokens)
    return model(tokens, levels, present)


def run(given, **options) -> Tensor:
    tokens, levels, present, mask_noise = given
    return Guidance(**options).predict(model, tokens, levels, present, mask_noise, LAYOUT)


def step(given, now: Tensor, after: Tensor, guidance: Guidance) -> Tensor:
    """One denoising step. now, after (N, P) int"""
    tokens, _, present, mask_noise = given
    stage = Stage(0, torch.stack([now, after]).short())
    return run_planned_stage(Denoising(model, present, LAYOUT, guidance), stage, tokens, mask_noise)


def test_without_guidance_nothing_changes(given):
    tokens, levels, present, _ = given
    assert torch.equal(run(given), model(tokens, levels, present))


def test_what_is_pure_noise_already_stays_the_noise_that_it_is(given):
    """Where somebody's history is hidden, and where what is clean is shown faintly."""
    tokens, levels, present, mask_noise = given
    levels[:, 5] = LEVELS
    shown: list[Tensor] = []

    def spy(noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
        shown.append(noisy[:, 5])
        return noisy

    for faint in (None, torch.full((6, PEOPLE), 200)):
        Guidance("history").predict(spy, tokens, levels, present, mask_noise, LAYOUT, faint)
        assert torch.equal(shown.pop(), tokens[:, 5].repeat_interleave(2, dim=0))


def test_history_guidance_is_the_papers_formula(given):
    cond, uncond = with_history(given, [0, 1, 2]), with_history(given, [])
    assert torch.allclose(run(given, kind="history", weight=0.7), 1.7 * cond - 0.7 * uncond, atol=1e-6)


@pytest.mark.parametrize(
    ("guide", "whose"), [("self", lambda n: [n]), ("partner", lambda n: [k for k in range(3) if k != n])]
)
@pytest.mark.parametrize("paper_average", [False, True])
def test_self_and_partner_guidance_are_the_papers_formulas(given, guide, whose, paper_average):
    cond, uncond = with_history(given, [0, 1, 2]), with_history(given, [])
    branches = [with_history(given, whose(n)) for n in range(PEOPLE)]
    own = torch.stack([branches[n][:, :, n] for n in range(PEOPLE)], dim=2)
    special = sum(branches) / PEOPLE if paper_average else own
    guided = run(given, kind=guide, paper_average=paper_average)
    assert torch.allclose(guided, cond + special - uncond, atol=1e-6)


def test_read_literally_self_and_partner_coincide_for_two_people(generator):
    layout = TokenLayout(latent=4, agents=2)
    tokens, mask_noise = (torch.randn(1, 6, 2, layout.width, generator=generator) for _ in range(2))
    levels = torch.zeros(1, 6, 2, dtype=torch.long)
    levels[:, 4:] = 600
    present = torch.ones(1, 2, dtype=torch.bool)

    def guided(guide: str, paper_average: bool) -> Tensor:
        return Guidance(guide, paper_average=paper_average).predict(model, tokens, levels, present, mask_noise, layout)

    assert torch.allclose(guided("self", True), guided("partner", True), atol=1e-6)
    assert not torch.allclose(guided("self", False), guided("partner", False), atol=1e-3)


@pytest.mark.parametrize("guide", ["self", "partner"])
def test_by_default_each_is_read_from_its_own_branch_at_the_papers_weight(given, guide):
    asked = run(given, kind=guide, paper_average=False, weight=1.0, smooth=0.0)
    assert torch.equal(run(given, kind=guide), asked)


@pytest.mark.parametrize(
    ("option", "value", "said"),
    [
        ("kind", "past", "got 'past', expected none or history or self or partner"),
        ("weight", -1.0, "got -1"),
        ("smooth", -0.1, "got -0.1"),
        ("cond_weight", -0.5, "got -0.5"),
        ("stabilization_level", LEVELS, "got 1000"),
        ("stabilization_beside", -1, "got -1"),
        ("stabilization_unseen", 0.5, "got 0.5"),
        ("stabilization_after", -1, "got -1"),
    ],
)
def test_a_guidance_that_means_nothing_is_refused_by_its_name(option, value, said):
    with pytest.raises(ValueError, match=f"{option}: {said}"):
        Guidance(**{option: value})


@pytest.mark.parametrize(("guide", "count"), [("none", 1), ("history", 2), ("self", 5), ("partner", 5)])
def test_all_branches_are_one_batch_and_none_runs_twice(given, guide, count):
    sizes = []

    def counting(noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
        sizes.append(len(noisy))
        return model(noisy, levels, present)

    tokens, levels, present, mask_noise = given
    Guidance(guide).predict(counting, tokens, levels, present, mask_noise, LAYOUT)
    assert sizes == [2 * count]
    assert len(Guidance(guide).branches(torch.ones(2, dtype=torch.bool))) == min(count, 4)
    assert len(Guidance(guide).branches(torch.tensor([True, True, False, False]))) == min(count, 4)


# -- what is finished, shown faintly -----------------------------------------------------------


def shown_at_level_40(tokens: Tensor, levels: Tensor, present: Tensor, mask_noise: Tensor) -> tuple[Tensor, Tensor]:
    """What the model sees first: tokens and levels."""
    seen = []

    def spy(noisy: Tensor, shown: Tensor, present: Tensor) -> Tensor:
        seen.append((noisy, shown))
        return model(noisy, shown, present)

    faint = torch.full(levels.shape[1:], 40)
    Guidance().predict(spy, tokens, levels, present, mask_noise, LAYOUT, faint)
    return seen[0]


def test_finished_tokens_are_shown_at_the_context_level_and_others_as_they_are(given):
    tokens, levels, present, mask_noise = given
    noisy, shown = shown_at_level_40(tokens, levels, present, mask_noise)
    assert (shown[:, :4] == 40).all() and (shown[:, 4:] == 600).all()
    assert torch.equal(noisy[:, 4:], tokens[:, 4:])
    expected = add_noise(tokens[:, :4], mask_noise[:, :4], torch.tensor(40))
    assert torch.allclose(noisy[:, :4], expected, atol=1e-6)
    with pytest.raises(ValueError, match="kind: got 'histry', expected none or history or self or partner"):
        Guidance("histry")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="stabilization_level: got 1000"):
        Guidance(stabilization_level=1000)
    with pytest.raises(ValueError, match=r"stabilization_after: got 10+, expected 0 to 1000000"):
        Guidance(stabilization_after=10**30)


def test_given_tokens_are_shown_clean_beside_finished_ones_that_are_not(given):
    """Agent 0's first two tokens were given; a model that is told less of what is sure would go on from it worse."""
    tokens, levels, present, mask_noise = given
    known = torch.zeros(levels.shape[1:], dtype=torch.bool)
    known[:2, 0] = True
    guidance = Guidance(stabilization_level=40)
    seen = []

    def spy(noisy: Tensor, shown: Tensor, present: Tensor) -> Tensor:
        seen.append((noisy, shown))
        return model(noisy, shown, present)

    guidance.predict(
        spy, tokens, levels, present, mask_noise, LAYOUT, faint_levels(guidance, known, changing(4, 5, known))
    )
    (noisy, shown), own = seen[0], LAYOUT.groups() == 0
    assert (shown[:, :2, 0] == 0).all() and torch.equal(noisy[:, :2, 0, own], tokens[:, :2, 0, own])
    assert (shown[:, 2:4, 0] == 40).all() and (shown[:, :4, 1] == 40).all()


def changing(first: int, stop: int, known: Tensor) -> Stage:
    """A stage of one step that makes these rows."""
    levels = torch.where(known, 0, LEVELS).repeat(2, 1, 1)
    levels[:, :first] = 0
    levels[1, first:stop] = 0
    return Stage(0, levels)


def test_people_beside_somebody_given_are_shown_faintly_and_nobody_else():
    """Agent 1 is given throughout, agents 0 and 2 from the fourth row on are made; agent 3 is nobody."""
    known = torch.zeros(8, 4, dtype=torch.bool)
    known[:, 1] = known[:3, 0] = known[:3, 2] = True
    beside = Guidance(stabilization_level=40, stabilization_after=2, stabilization_beside=700)
    levels = faint_levels(beside, known, changing(5, 8, known))
    assert levels is not None
    assert (levels[known] == 0).all() and (levels[3:, [0, 2, 3]] == 700).all()
    assert faint_levels(beside, known, changing(5, 8, known), live=True).max() == 40  # there continuity matters more
    assert faint_levels(Guidance(), known, changing(5, 8, known)) is None
    known[6, 1] = False  # not given throughout the window, so nobody is beside somebody who is
    assert faint_levels(beside, known, changing(7, 8, known))[:, 0].tolist() == [0] * 5 + [40] * 3
    only = Guidance(stabilization_beside=9)
    between = torch.ones(8, 2, dtype=torch.bool)
    between[3:, 1] = between[3:6, 0] = False
    assert not faint_levels(only, between, changing(6, 7, between)).any()  # keyframes alone
    alone = torch.zeros(8, 2, dtype=torch.bool)
    alone[:, 0] = True
    levels = faint_levels(only, alone, changing(0, 8, alone))
    assert (levels[:, 0] == 0).all() and (levels[:, 1] == 9).all()  # nobody is beside oneself
    with pytest.raises(ValueError, match="stabilization_beside: got 1000"):
        Guidance(stabilization_beside=1000)


def test_a_level_left_open_is_the_model_s_and_a_level_that_is_named_stays():
    model, plain = Sampling(stride=8, stabilization_level=60), Sampling()
    assert SamplerOptions().filled(model).guidance == Guidance(stabilization_level=60)
    assert SamplerOptions(guidance=Guidance("self")).filled(model).guidance == Guidance("self", stabilization_level=60)
    assert SamplerOptions(guidance=Guidance(stabilization_level=0)).filled(model).guidance.stabilization_level == 0
    assert SamplerOptions().filled(plain).guidance.stabilization_level is None
    assert SamplerOptions.preset("paper").filled(model).guidance.stabilization_level == 0
    both = Sampling(stabilization_level=60, stabilization_beside=700)
    assert SamplerOptions().filled(both).guidance == Guidance(stabilization_level=60, stabilization_beside=700)
    less = Guidance(stabilization_beside=0)
    assert SamplerOptions(guidance=less).filled(both).guidance == replace(less, stabilization_level=60)
    clean = Guidance(stabilization_level=0)
    assert SamplerOptions(guidance=clean).filled(both).guidance == clean
    assert not SamplerOptions.preset("paper").filled(both).guidance.stabilization_beside
    unseen = Sampling(stabilization_level=60, stabilization_unseen=90)
    assert SamplerOptions().filled(unseen).guidance == Guidance(stabilization_level=60, stabilization_unseen=90)
    assert SamplerOptions(guidance=clean).filled(unseen).guidance == clean
    assert not SamplerOptions.preset("paper").filled(unseen).guidance.stabilization_unseen


def test_new_noise_is_scaled_as_the_model_says_where_there_is_any():
    assert SamplerOptions().filled(Sampling(turn=2)).turn == 2
    assert SamplerOptions().filled(Sampling(opening=5)).opening == 5
    assert SamplerOptions().filled(Sampling(pairwise_weight=0.05)).weight_of_pairs == 0.05
    assert SamplerOptions(pairwise_weight=0.0).filled(Sampling(pairwise_weight=0.05)).weight_of_pairs == 0
    assert SamplerOptions().filled(Sampling()).weight_of_pairs == SamplerOptions().weight_of_pairs == 0.02
    for preset in ("paper", "steady"):
        assert SamplerOptions.preset(preset).filled(Sampling(opening=5)).opening == 0
    assert SamplerOptions(turn=1).filled(Sampling(turn=2)).turn == 1
    assert planning_grid(12, 2, 4, 16, SamplerOptions(turn=2)).turn == 2
    assert planning_grid(12, 2, 4, 16, SamplerOptions()).turn == 1
    model = Sampling(noise_scale=1.1)
    assert SamplerOptions().filled(model).noise_scale == 1.1
    assert SamplerOptions(noise_scale=1.0).filled(model).noise_scale == 1
    assert SamplerOptions.preset("paper").filled(model).noise_scale == 1
    assert SamplerOptions(eta=0.0).filled(model).noise_scale is None
    for scale in (0.0, 2.5):
        with pytest.raises(ValueError, match="noise_scale: got"):
            Sampling(noise_scale=scale)
    with pytest.raises(ValueError, match=r"noise_scale: got 1\.1, but with eta 0 there is no new noise"):
        SamplerOptions(eta=0.0, noise_scale=1.1)


def test_a_forgotten_history_is_pure_noise_at_any_context_level(given):
    tokens, levels, present, mask_noise = given
    shown = []

    def spy(noisy: Tensor, seen: Tensor, present: Tensor) -> Tensor:
        shown.append(seen)
        return model(noisy, seen, present)

    faint = torch.full(levels.shape[1:], 40)
    Guidance("history").predict(spy, tokens, levels, present, mask_noise, LAYOUT, faint)
    assert set(shown[0][:, :4].unique().tolist()) == {40, LEVELS}


# -- smoothing (paper A.8) ---------------------------------------------------------------------


def test_roughness_is_nothing_for_steady_motion_and_counts_kinks(generator):
    steady = torch.arange(6.0)[None, :, None, None].expand(1, 6, 2, 3)
    there = torch.ones(1, 2, dtype=torch.bool)
    assert roughness(steady, there) == 0
    kinked = steady.clone()
    kinked[0, 3, 1, 2] += 1  # second differences 1, -2, 1
    assert roughness(kinked, there) == 6
    assert roughness(kinked, torch.tensor([[True, False]])) == 0, "absent agents do not count"


def test_smoothing_follows_the_slope_through_the_denoiser(given):
    """Against finite differences in float64."""
    tokens, levels, present, mask_noise = given
    tokens = tokens.double()
    moved, clean = Guidance(smooth=0.1).apply(model, tokens, levels, present, mask_noise, LAYOUT)
    assert torch.equal(clean, model(tokens, levels, present))
    for place in ((0, 4, 0, 0), (1, 5, 2, 3), (0, 5, 1, -1)):
        shift = torch.zeros_like(tokens)
        shift[place] = 1e-5
        up, down = (roughness(model(tokens + sign * shift, levels, present), present) for sign in (1, -1))
        slope = (up - down) / 2e-5
        assert (tokens - moved)[place] == pytest.approx(0.1 * float(slope), rel=1e-4, abs=1e-8)


@pytest.mark.parametrize("kind", ["none", "history", "self", "partner"])
def test_smoothing_goes_with_every_guidance_and_leaves_known_numbers_alone(given, kind):
    tokens, levels, present, mask_noise = given
    guidance = Guidance(kind, smooth=0.3)
    moved, clean = guidance.apply(model, tokens, levels, present, mask_noise, LAYOUT)
    known = LAYOUT.spread(LAYOUT.group_levels(levels)) == 0
    assert not torch.allclose(moved[~known], tokens[~known])
    assert torch.equal(clean, Guidance(kind).predict(model, tokens, levels, present, mask_noise, LAYOUT))
    stepped, plain = (step(given, levels[0], levels[0] // 2, each) for each in (guidance, Guidance(kind)))
    assert torch.equal(stepped[known], tokens[known])
    assert not torch.allclose(stepped[~known], plain[~known])


def test_smoothing_works_in_inference_mode(given):
    with torch.inference_mode():
        inside = tuple(x + 0 for x in given)
        moved, _ = Guidance(smooth=0.3).apply(model, inside[0], *inside[1:], LAYOUT)
    assert torch.equal(moved, Guidance(smooth=0.3).apply(model, given[0], *given[1:], LAYOUT)[0])


def test_smoothing_makes_samples_smoother(generator):
    """A denoiser that believes what it sees: what it is shown decides how rough its samples are."""
    from magnet.sampling.sampler import sample
    from magnet.sampling.schedule import Grid
    from magnet.tasks.joint import JointFuture

    layout = TokenLayout(latent=4, agents=2)
    grid = Grid(12, 2, 4, steps=10, window=12, pyramid_offset=0, spacing="even")
    tokens = torch.randn(3, 12, 2, layout.width, generator=generator)
    there = torch.ones(3, 2, dtype=torch.bool)

    def rough(smooth: float) -> float:
        seed = torch.Generator().manual_seed(3)
        plan = JointFuture().schedule(grid)
        out = sample(model, plan, tokens, there, layout, seed, guidance=Guidance(smooth=smooth))
        assert torch.equal(out[:, :4], tokens[:, :4])
        return float(roughness(out[:, 4:], there))

    assert rough(0.05) < 0.9 * rough(0.0)


def test_smoothing_leaves_alone_what_the_step_does_not_denoise(given):
    """A token that stays at pure noise must stay noise, however many steps go by."""
    tokens, levels, _, _ = given
    after = levels[0] // 2
    after[5] = levels[0, 5]
    moved = step(given, levels[0], after, Guidance(smooth=0.3))
    assert torch.equal(moved[:, 5], tokens[:, 5])
    assert not torch.equal(moved[:, 4], step(given, levels[0], after, Guidance())[:, 4])


def test_half_denoised_tokens_below_the_context_level_keep_their_own(given):
    tokens, levels, present, mask_noise = given
    levels = levels.clone()
    levels[:, 4:] = 20
    noisy, shown = shown_at_level_40(tokens, levels, present, mask_noise)
    assert (shown[:, 4:] == 20).all()
    assert torch.equal(noisy[:, 4:], tokens[:, 4:])


# -- free slots --------------------------------------------------------------------------------


@pytest.mark.parametrize("paper_average", [False, True])
@pytest.mark.parametrize("kind", ["history", "self", "partner"])
def test_free_slots_change_nothing_in_guidance(kind, paper_average, generator):
    """Two people in two slots, and the same two in four: a model that looks at those present alone."""
    layout = TokenLayout(latent=4, agents=4, pairwise=False)

    def blind(noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
        there = present[:, None, :, None]
        seen = torch.where(there, noisy * (1 + levels[..., None] / LEVELS), 0.0)
        return torch.tanh(noisy + seen.sum(dim=(1, 2), keepdim=True) / present.sum(dim=1).view(-1, 1, 1, 1))

    tokens, mask_noise = (torch.randn(3, 6, 4, layout.width, generator=generator) for _ in range(2))
    levels = torch.zeros(3, 6, 4, dtype=torch.long)
    levels[:, 4:] = 600
    there = torch.tensor([True, True, False, False]).expand(3, 4)
    few = TokenLayout(latent=4, agents=2, pairwise=False)
    guidance = Guidance(kind, paper_average=paper_average)
    wide = guidance.predict(blind, tokens, levels, there, mask_noise, layout)
    narrow = guidance.predict(blind, tokens[:, :, :2], levels[:, :, :2], there[:, :2], mask_noise[:, :, :2], few)
    assert torch.allclose(wide[:, :, :2], narrow, atol=1e-5)
