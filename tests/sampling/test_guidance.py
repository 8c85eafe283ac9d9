import pytest
import torch
from torch import Tensor

from magnet.motion.tokens import TokenLayout
from magnet.sampling.guidance import Guidance
from magnet.sampling.noise import LEVELS

PEOPLE = 3
LAYOUT = TokenLayout(latent=4, agents=PEOPLE)


@pytest.fixture
def given(generator):
    tokens = torch.randn(2, 6, PEOPLE, LAYOUT.width, generator=generator)
    veil = torch.randn(tokens.shape, generator=generator)
    levels = torch.zeros(2, 6, PEOPLE, dtype=torch.long)
    levels[:, 4:] = 600
    return tokens, levels, torch.ones(2, PEOPLE, dtype=torch.bool), veil


def model(noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
    pooled = (noisy * (1 + levels[..., None] / LEVELS)).mean(dim=(1, 2), keepdim=True)
    return torch.tanh(noisy.roll(1, dims=1) + pooled)


def with_history(given, whose: list[int]) -> Tensor:
    """Slow reference: one branch, in which only some agents' history is seen."""
    tokens, levels, present, veil = (x.clone() for x in given)
    for agent in range(PEOPLE):
        if agent not in whose:
            levels[:, :4, agent] = LEVELS
    groups = LAYOUT.spread(LAYOUT.group_levels(levels))
    tokens = torch.where((groups == LEVELS), veil, tokens)
    return model(tokens, levels, present)


def run(given, **options) -> Tensor:
    tokens, levels, present, veil = given
    return Guidance(**options).apply(model, tokens, levels, present, veil, LAYOUT)


def test_without_guidance_nothing_changes(given):
    tokens, levels, present, _ = given
    assert torch.equal(run(given), model(tokens, levels, present))


def test_history_guidance_is_the_papers_formula(given):
    cond, uncond = with_history(given, [0, 1, 2]), with_history(given, [])
    assert torch.allclose(run(given, kind="history", weight=0.7), 1.7 * cond - 0.7 * uncond, atol=1e-6)


@pytest.mark.parametrize(
    ("guide", "whose"), [("self", lambda n: [n]), ("partner", lambda n: [k for k in range(3) if k != n])]
)
@pytest.mark.parametrize("literal", [False, True])
def test_self_and_partner_guidance_are_the_papers_formulas(given, guide, whose, literal):
    cond, uncond = with_history(given, [0, 1, 2]), with_history(given, [])
    branches = [with_history(given, whose(n)) for n in range(PEOPLE)]
    own = torch.stack([branches[n][:, :, n] for n in range(PEOPLE)], dim=2)
    special = sum(branches) / PEOPLE if literal else own
    guided = run(given, kind=guide, literal=literal)
    assert torch.allclose(guided, cond + special - uncond, atol=1e-6)


def test_read_literally_self_and_partner_coincide_for_two_people(generator):
    layout = TokenLayout(latent=4, agents=2)
    tokens, veil = (torch.randn(1, 6, 2, layout.width, generator=generator) for _ in range(2))
    levels = torch.zeros(1, 6, 2, dtype=torch.long)
    levels[:, 4:] = 600
    present = torch.ones(1, 2, dtype=torch.bool)

    def guided(guide: str, literal: bool) -> Tensor:
        return Guidance(guide, literal=literal).apply(model, tokens, levels, present, veil, layout)

    assert torch.allclose(guided("self", True), guided("partner", True), atol=1e-6)
    assert not torch.allclose(guided("self", False), guided("partner", False), atol=1e-3)


@pytest.mark.parametrize(("guide", "count"), [("none", 1), ("history", 2), ("self", 5), ("partner", 5)])
def test_all_branches_are_one_batch_and_none_runs_twice(given, guide, count):
    sizes = []

    def counting(noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
        sizes.append(len(noisy))
        return model(noisy, levels, present)

    tokens, levels, present, veil = given
    Guidance(guide).apply(counting, tokens, levels, present, veil, LAYOUT)
    assert sizes == [2 * count]
    assert len(Guidance(guide).branches(2)) == min(count, 4)
