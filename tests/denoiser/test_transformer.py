import pytest
import torch

from magnet.denoiser.transformer import Transformer
from magnet.motion.tokens import TokenLayout
from magnet.sampling.noise import LEVELS

LAYOUT = TokenLayout(latent=8, agents=4)
SMALL = {"width": 32, "layers": 2, "heads": 2, "level_width": 16, "agent_width": 16, "slot_width": 4}


def build(layout: TokenLayout = LAYOUT, **options) -> Transformer:
    torch.manual_seed(0)
    return Transformer(layout, **{**SMALL, **options}).eval()


def batch(generator: torch.Generator, layout: TokenLayout = LAYOUT):
    noisy = torch.randn(2, 6, layout.agents, layout.width, generator=generator)
    levels = torch.randint(LEVELS + 1, (2, 6, layout.agents), generator=generator)
    return noisy, levels


def test_the_paper_size_has_about_19_million_weights():
    model = Transformer(TokenLayout(512, 2))
    assert 19e6 < sum(p.numel() for p in model.parameters()) < 21e6


@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize("rope", ["hidden", "heads", "none"])
def test_absent_agents_change_nothing(generator, training, rope):
    model = build(rope=rope, dropout=0.0).train(training)
    noisy, levels = batch(generator)
    present = torch.tensor([[True, True, False, False], [True, True, True, False]])
    other_noisy, other_levels = noisy.clone(), levels.clone()
    for scene, first_absent in enumerate((2, 3)):
        other_noisy[scene, :, first_absent:] = 77.0
        other_levels[scene, :, first_absent:] = 5
    slot_of_absent = ~LAYOUT.spread(LAYOUT.group_present(present))[:, None].expand_as(noisy)
    other_noisy = torch.where(slot_of_absent, 99.0, other_noisy)
    a, b = model(noisy, levels, present), model(other_noisy, other_levels, present)
    assert torch.equal(a[0, :, :2], b[0, :, :2])
    assert torch.equal(a[1, :, :3], b[1, :, :3])


def test_unused_slots_need_not_be_computed(generator):
    """In training all slots run, in use only those up to the last one used: same result."""
    model = build(dropout=0.0)
    noisy, levels = batch(generator)
    present = torch.tensor([[True, True, False, False]]).expand(2, 4)
    short = model(noisy, levels, present)
    full = model.train()(noisy, levels, present)
    assert torch.allclose(short[:, :, :2], full[:, :, :2], atol=1e-5)


@pytest.mark.parametrize("field", ["rope", "agent_embedding"])
def test_without_an_embedding_the_model_is_blind_to_it(generator, field):
    """Ablations of paper Table A.5: no time means shuffled time gives shuffled output; likewise agents."""
    layout = TokenLayout(latent=8, agents=4, relations=False)
    present = torch.ones(2, 4, dtype=torch.bool)
    noisy, levels = batch(generator, layout)
    axis, order = (1, torch.tensor([3, 1, 0, 5, 4, 2])) if field == "rope" else (2, torch.tensor([2, 0, 3, 1]))
    blind = build(layout, **{field: "none" if field == "rope" else False})
    seeing = build(layout)
    shuffled = noisy.index_select(axis, order), levels.index_select(axis, order)
    for model, same in ((blind, True), (seeing, False)):
        plain = model(noisy, levels, present).index_select(axis, order)
        assert torch.allclose(plain, model(*shuffled, present), atol=1e-5) == same


def test_each_token_sees_its_own_level(generator):
    model = build()
    noisy, levels = batch(generator)
    present = torch.ones(2, 4, dtype=torch.bool)
    other = levels.clone()
    other[:, 3, 1] = (other[:, 3, 1] + 500) % LEVELS
    assert not torch.equal(model(noisy, levels, present), model(noisy, other, present))


def test_one_person_alone_is_a_scene(generator):
    layout = TokenLayout(latent=8, agents=1)
    model = build(layout)
    noisy, levels = batch(generator, layout)
    assert model(noisy, levels, torch.ones(2, 1, dtype=torch.bool)).shape == noisy.shape


def test_heads_must_divide_the_width():
    with pytest.raises(ValueError, match="width 30 must be a multiple"):
        build(width=30, heads=4)
