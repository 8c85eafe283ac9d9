import math
from unittest import mock

import pytest
import torch
from torch.nn import functional as F

from magnet.denoiser import transformer
from magnet.denoiser.options import TransformerOptions
from magnet.denoiser.transformer import Transformer, block_causal, rotate, rotation, skipped
from magnet.motion.tokens import TokenLayout
from magnet.sampling.noise import LEVELS, add_noise, alpha_bar
from tests.counting import Counting

LAYOUT = TokenLayout(latent=8, agents=4)
SMALL = {"width": 32, "layers": 2, "heads": 2, "level_width": 16, "agent_width": 16, "slot_width": 4}


def build(layout: TokenLayout = LAYOUT, **options) -> Transformer:
    torch.manual_seed(0)
    return Transformer(layout, TransformerOptions(**{**SMALL, **options})).eval()


def batch(generator: torch.Generator, layout: TokenLayout = LAYOUT):
    noisy = torch.randn(2, 6, layout.agents, layout.width, generator=generator)
    levels = torch.randint(LEVELS + 1, (2, 6, layout.agents), generator=generator)
    return noisy, levels


def waves(value: float, width: int) -> list[float]:
    angles = [value * 10_000 ** (-2 * k / width) for k in range(width // 2)]
    return [math.sin(angle) for angle in angles] + [math.cos(angle) for angle in angles]


def turned(x: torch.Tensor, time: int) -> torch.Tensor:
    """Numbers d and d + half of them as a complex one, turned by an angle that is smaller the larger d. (D,)"""
    half = len(x) // 2
    pairs = torch.complex(x[:half], x[half:])
    angles = torch.tensor([time * 10_000 ** (-d / half) for d in range(half)], dtype=x.dtype)
    whole = pairs * torch.polar(torch.ones_like(angles), angles)
    return torch.cat([whole.real, whole.imag])


def written_out(model: Transformer, noisy: torch.Tensor, levels: torch.Tensor, cond: torch.Tensor | None):
    """The network token by token and head by head, of one scene of people who are all there. (N, P, D) -> same"""
    o, (N, P) = model.options, levels.shape
    groups = model.layout.group_levels(levels[None])[0]  # (N, P, 1 + slots)
    rows, times = [], []
    for n in range(N):
        for p in range(P):
            own, *pairs = groups[n, p].tolist()
            told = waves(own, o.level_width) + [wave for level in pairs for wave in waves(level, o.slot_width)]
            agent = [] if model.agent is None else [model.agent[p]]
            rows.append(torch.cat([noisy[n, p], torch.tensor(told, dtype=noisy.dtype), *agent]))
            times.append(n)
    x = model.in_proj(torch.stack(rows))
    if o.cond_dim:
        known = [cond is not None and bool(cond[n].isfinite().all()) for n in times]
        x = x + torch.stack(
            [model.cond_proj(cond[n]) if k else model.no_cond for n, k in zip(times, known, strict=True)]
        )
    if o.rope == "hidden":
        x = x + torch.stack([turned(row, n) for row, n in zip(x, times, strict=True)])
    each = o.width // o.heads
    for block in model.blocks:
        query, key, value = block.qkv(x).split(o.width, dim=1)
        made = []
        for head in range(o.heads):
            q, k, v = (part[:, head * each : (head + 1) * each] for part in (query, key, value))
            if o.rope == "heads":
                q, k = (torch.stack([turned(row, n) for row, n in zip(part, times, strict=True)]) for part in (q, k))
            made.append((q @ k.T / math.sqrt(each)).softmax(dim=1) @ v)
        x = block.norm_attention(x + block.out(torch.cat(made, dim=1)))
        x = block.norm_mlp(x + block.mlp(x))
    return model.out_proj(x).view(N, P, -1)


@pytest.mark.parametrize(
    "options",
    [{}, {"rope": "hidden"}, {"rope": "none", "agent_embedding": False}, {"rope": "heads", "cond_dim": 3}],
    ids=str,
)
@torch.no_grad()
def test_the_network_is_what_is_written_out(options, generator):
    """Post-norm encoder blocks over all tokens of a scene; levels and times as waves of 1 to 10,000 over 2 pi."""
    model = build(dropout=0.1, **options).double()
    for weight in model.parameters():
        weight.normal_(std=0.3, generator=generator)
    noisy, levels = batch(generator)
    noisy, cond = noisy.double(), torch.randn(2, 6, 3, generator=generator, dtype=torch.float64)
    cond[0, 2, 1] = cond[1, 4] = torch.nan
    for given in (cond, None) if options.get("cond_dim") else (None,):
        made = model(noisy, levels, torch.ones(2, 4, dtype=torch.bool), given)
        for scene in range(2):
            expected = written_out(model, noisy[scene], levels[scene], None if given is None else given[scene])
            torch.testing.assert_close(made[scene], expected, rtol=1e-4, atol=1e-4)


def test_a_condition_says_nothing_before_it_is_learnt(generator):
    """So training with one begins as the model that it starts from."""
    model, (noisy, levels) = build(cond_dim=3), batch(generator)
    present = torch.ones(2, 4, dtype=torch.bool)
    assert torch.equal(model(noisy, levels, present, torch.ones(2, 3)), model(noisy, levels, present))


@pytest.mark.parametrize("options", [{}, {"causal_block": 2}, {"rope": "hidden"}], ids=["plain", "causal", "hidden"])
def test_all_slots_at_once_are_the_groups_of_equally_many_people(options, generator):
    """As processes with weights in shards run it, each block once; somebody may be alone, or nobody there."""
    model = build(**options)
    noisy, levels = (each.repeat(2, 1, 1, *[1] * (each.ndim - 3)) for each in batch(generator))
    present = torch.tensor([[1, 1, 1, 1], [0, 1, 0, 1], [0, 0, 1, 0], [0, 0, 0, 0]], dtype=torch.bool)
    there = present[:, None].expand(levels.shape)

    def run(in_groups: bool) -> tuple[torch.Tensor, list[torch.Tensor]]:
        model.in_groups = in_groups
        made = model(noisy, levels, present)
        return made, list(torch.autograd.grad(made[there].square().mean(), list(model.parameters())))

    (groups, slopes), (once, same) = run(True), run(False)
    assert once.isfinite().all() and torch.allclose(groups[there], once[there], atol=1e-5)
    assert all(torch.allclose(a, b, atol=1e-5) for a, b in zip(slopes, same, strict=True))


@pytest.mark.parametrize("rope", ["hidden", "heads"])
def test_all_slots_at_once_are_few_operators_however_many_groups_there_are(
    rope: str, generator: torch.Generator
) -> None:
    """Of which a GPU's host starts some fifty thousand a second; the groups would be so many times the layers."""
    noisy, levels = (each.repeat(2, 1, 1, *[1] * (each.ndim - 3)) for each in batch(generator))
    present = torch.tensor([[1, 1, 1, 1], [0, 1, 0, 1], [0, 0, 1, 0], [1, 1, 1, 0]], dtype=torch.bool)

    def operators(layers: int) -> int:
        model = build(rope=rope, layers=layers)
        model.in_groups = False
        with Counting() as counted:
            model(noisy, levels, present)
        assert not counted.waits
        return counted.operators

    one, two = operators(1), operators(2)
    assert two - one <= 56, "operators a layer, views among them"


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


def test_groups_of_any_size_in_one_batch_equal_each_alone(generator):
    """Scenes are run by group size; which others are in the batch, and in which slots, changes nothing."""
    model = build()
    noisy, levels = batch(generator)
    present = torch.tensor([[True, False, True, False], [True, True, True, True]])
    together = model(noisy, levels, present)
    for scene in range(2):
        alone = model(noisy[[scene]], levels[[scene]], present[[scene]])
        assert torch.allclose(together[scene][:, present[scene]], alone[0][:, present[scene]], atol=1e-6)


def test_leaving_absent_agents_out_equals_masking_them(generator):
    """The plain reference: everybody runs, absent agents are masked as keys."""
    model = build()
    noisy, levels = batch(generator)
    present = torch.tensor([[True, False, True, False], [True, True, True, False]])
    mask = present[:, None, :].expand(2, 6, 4).flatten(1)[:, None, None]
    original = torch.nn.functional.scaled_dot_product_attention

    def dense(x: torch.Tensor, _: torch.Tensor) -> torch.Tensor:
        time = torch.arange(6).repeat_interleave(4)
        y = x.flatten(1, 2)
        y = y + rotate(y, time)
        for block in model.blocks:
            y = block(y, *rotation(time, y.shape[-1] // block.heads))
        return y.unflatten(1, (6, 4))

    def masked(query, key, value, attn_mask=None, dropout_p=0.0):
        assert attn_mask is None
        return original(query, key, value, attn_mask=mask)

    packed = model(noisy, levels, present)
    with mock.patch.object(model, "_blocks", dense), mock.patch.object(F, "scaled_dot_product_attention", masked):
        reference = model(noisy, levels, present)
    there = present[:, None, :, None].expand_as(packed)
    assert torch.allclose(packed[there], reference[there], atol=1e-5)


@pytest.mark.parametrize("field", ["rope", "agent_embedding"])
def test_without_an_embedding_the_model_is_blind_to_it(generator, field):
    """Ablations of paper Table A.5: no time means shuffled time gives shuffled output; likewise agents."""
    layout = TokenLayout(latent=8, agents=4, pairwise=False)
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
    for width in (30, 36):
        with pytest.raises(ValueError, match=f"width {width} must be a multiple of twice the 4 heads"):
            build(width=width, heads=4)


# -- attention in causal blocks ------------------------------------------------------------------


@pytest.mark.parametrize("rope", ["hidden", "heads", "none"])
@pytest.mark.parametrize("size", [1, 2, 3, 4])
def test_a_later_token_changes_no_earlier_block_and_everything_from_its_own_on(generator, size, rope):
    model = build(causal_block=size, rope=rope)
    noisy, levels = batch(generator)
    present = torch.tensor([[True, True, False, True], [True, True, True, True]])
    plain = model(noisy, levels, present)
    for step in range(6):
        other_noisy, other_levels = noisy.clone(), levels.clone()
        other_noisy[:, step, 1] += 1.0
        other_levels[:, step, 1] = (levels[:, step, 1] + 500) % LEVELS
        changed = model(other_noisy, other_levels, present)
        first = step // size * size
        assert torch.equal(changed[:, :first], plain[:, :first])
        for scene in range(2):
            moved = (changed[scene] != plain[scene]).any(dim=-1)
            assert moved[first:, present[scene]].all(), (
                "a block sees all of itself, whoever's tokens, and what is before"
            )


def test_blocks_that_hold_everything_are_full_attention(generator):
    noisy, levels = batch(generator)
    present = torch.ones(2, 4, dtype=torch.bool)
    full = build()(noisy, levels, present)
    assert torch.allclose(build(causal_block=6)(noisy, levels, present), full, atol=1e-6)
    assert not torch.allclose(build(causal_block=3)(noisy, levels, present), full, atol=1e-3)


def test_a_block_is_what_the_model_says_of_the_clip_that_ends_with_it(generator):
    """The plain reference: cut off everything behind a block, and what is left is answered alike."""
    model = build(causal_block=2)
    noisy, levels = batch(generator)
    present = torch.ones(2, 4, dtype=torch.bool)
    whole = model(noisy, levels, present)
    for stop in (2, 4, 6):
        prefix = model(noisy[:, :stop], levels[:, :stop], present)
        assert torch.allclose(prefix, whole[:, :stop], atol=1e-6)


def test_whom_a_token_sees_written_out():
    sees = block_causal(torch.tensor([0, 0, 1, 1, 2, 2]), 2)
    assert sees.int().tolist() == [[1, 1, 1, 1, 0, 0]] * 4 + [[1, 1, 1, 1, 1, 1]] * 2


def test_a_block_of_a_negative_size_is_refused():
    with pytest.raises(ValueError, match="causal_block: got -1, expected at least 0"):
        build(causal_block=-1)


def test_with_a_skip_what_is_shown_clean_comes_back_and_what_noise_hides_is_the_networks(generator):
    """The network that tells sqrt(1 - a) x - sqrt(a) noise is right at every level (Salimans and Ho 2022, v)."""
    clean, _ = batch(generator)
    noise = torch.randn(clean.shape, generator=generator)
    levels = torch.tensor([0, 3, 400, LEVELS]).repeat(3)[None, :, None].expand(2, -1, 4)[:, :6]
    spread = LAYOUT.spread(LAYOUT.group_levels(levels))
    signal = alpha_bar(spread)
    shown, told = add_noise(clean, noise, spread), (1 - signal).sqrt() * clean - signal.sqrt() * noise
    assert torch.allclose(skipped(told, shown, levels, LAYOUT), clean, atol=1e-5)
    anything = skipped(noise, shown, levels, LAYOUT)
    assert torch.equal(anything[:, 0], clean[:, 0]) and torch.equal(anything[:, 3], noise[:, 3])


@pytest.mark.parametrize("causal_block", [0, 2])
def test_training_gives_the_gradients_that_flash_attention_gives(generator, causal_block):
    noisy, levels = batch(generator)
    present = torch.tensor([[True, False, True, False], [True, True, True, True]])
    gradients = []
    for training in (True, False):  # without dropout the modes differ in how attention is computed alone
        model = build(dropout=0.0, causal_block=causal_block).train(training)
        with mock.patch.object(transformer, "sdpa_kernel", wraps=transformer.sdpa_kernel) as kernel:
            model(noisy, levels, present).square().mean().backward()
        assert kernel.called == training
        gradients.append([p.grad for p in model.parameters() if p.grad is not None])
    assert len(gradients[0]) == len(gradients[1]) > 0
    for plain, flash in zip(*gradients, strict=True):
        assert torch.allclose(plain, flash, rtol=1e-4, atol=1e-6)
