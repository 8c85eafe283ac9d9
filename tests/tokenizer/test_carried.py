"""A tokenizer that carries state: token by token it is the whole clip, and nothing final is computed twice."""

from __future__ import annotations

import pytest
import torch

from magnet.motion.tokens import by_token, scene_deltas
from magnet.testing.models import random_scene, tiny_tokenizer
from magnet.tokenizer.carried import Carried
from magnet.tokenizer.lean import LEAN, Growing, Taps, decoded, encoded

KINDS = {
    "sees both ways": {},
    "causal": {"causal": True},
    "causal, a token ahead": {"causal": True, "lookahead": 1},
}


@pytest.fixture(scope="module", params=KINDS.values(), ids=KINDS)
def tokenizer(request: pytest.FixtureRequest):
    made = tiny_tokenizer(network={"width": 16, "depth": 2, **request.param}).eval()
    for weight in made.vqvae.parameters():
        torch.nn.init.normal_(weight, std=0.2)
    return made


@pytest.fixture(scope="module")
def clip():
    return random_scene(2, 160, 2, torch.Generator().manual_seed(0))


@torch.no_grad()
@pytest.mark.parametrize("block", [1, 3])
def test_decoding_as_tokens_come_is_the_whole_clip_bit_for_bit(tokenizer, clip, block) -> None:
    """Each from a window of its neighbours, those after the newest one foretold; a frame is asked for twice."""
    latent, deltas = tokenizer.encode_scene(clip, False), by_token(scene_deltas(clip))
    before, after = tokenizer.receptive_field
    carried = Carried(keep=4)
    for first in range(0, 40 - block + 1, block):
        low, near = max(first - 1 - before, 0), first + block
        shown = torch.cat([latent[:, low:near], torch.full_like(latent[:, :after], float(first))], dim=1)
        ways = torch.cat([deltas[:, low:near], deltas[:, :after]], dim=1)
        frames = slice(max(4 * (first - low) - 2, 0), 4 * (near - low))
        made = decoded(tokenizer, shown, clip.betas, ways, frames, Growing(carried, low, near - low))
        assert torch.equal(made, decoded(tokenizer, shown, clip.betas, ways, frames))


@torch.no_grad()
@pytest.mark.parametrize("block", [1, 3])
def test_encoding_as_frames_come_is_the_whole_clip_bit_for_bit(tokenizer, clip, block) -> None:
    """From windows that begin and end with a token that stands in for others."""
    carried, behind = Carried(), tokenizer.receptive_field[0] + 2
    for first in range(0, 40 - block + 1, block):
        low, stop = max(first - behind, 0), first + block
        window = clip.slice(4 * low, 4 * stop).pad_frames(4)
        wanted = slice(first - low + 1, stop - low + 1)
        made = encoded(tokenizer, window, False, wanted, Growing(carried, low, stop - low))
        whole = clip.slice(0, 4 * stop).pad_frames(4)
        assert torch.equal(made, encoded(tokenizer, whole, False, slice(first + 1, stop + 1)))


@torch.no_grad()
def test_what_was_called_final_and_changed_all_the_same_is_seen(tokenizer, clip) -> None:
    latent, deltas = tokenizer.encode_scene(clip, False), by_token(scene_deltas(clip))
    carried = Carried()
    decoded(tokenizer, latent[:, :30], clip.betas, deltas[:, :30], slice(0, 120), Growing(carried, 0, 30))
    other = latent.clone()
    other[:, 25] += 1.0
    frames = slice(120, 160)
    made = decoded(tokenizer, other, clip.betas, deltas, frames, Growing(carried, 0, 40))
    assert torch.equal(made, decoded(tokenizer, other, clip.betas, deltas, frames))


@torch.no_grad()
def test_a_network_that_sees_no_later_steps_computes_each_step_once(monkeypatch) -> None:
    """However long the past: each convolution computes the steps of the new token, and what is kept does not grow."""
    tokenizer = tiny_tokenizer(network={"width": 16, "depth": 2, "causal": True}).eval()
    network, carried, plain = LEAN.of(tokenizer.vqvae.decoder), Carried(), Taps.__call__
    inputs = torch.randn(1, 60, tokenizer.codebook_dim + 46)
    counts: list[int] = []

    def counting(self, x, held, span, *rest, **more):
        counts[-1] += span[1] - span[0]
        return plain(self, x, held, span, *rest, **more)

    monkeypatch.setattr(Taps, "__call__", counting)
    held = []
    for token in range(60):
        low = max(token - sum(tokenizer.receptive_field), 0)
        counts.append(0)
        carried(network, inputs[:, low : token + 1], low, token + 1, (4 * token, 4 * token + 4))
        held.append(sum(each.steps.numel() for each in carried.held if each is not None))
    rates = [1, 1, 1, 2, 2, 2, 4, 4]  # the first convolution, twice two blocks and the one after, the last
    assert counts[1:] == [sum(rates)] * 59
    assert held[10:] == [held[10]] * 50
