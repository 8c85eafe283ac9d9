"""What a denoiser shows its network, and what it makes of the answer."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from magnet.denoiser.core import DenoiserCore
from magnet.sampling.noise import alpha_bar
from magnet.testing import random_scene, tiny_denoiser


def asked(model: DenoiserCore) -> tuple[Tensor, Tensor, Tensor]:
    """Tokens (2, 8, 3, D) in real units, levels and who is there."""
    generator = torch.Generator().manual_seed(4)
    scene = random_scene(2, 32, 3, generator)
    return model.tokenize(scene)[0], torch.randint(1, 1000, (2, 8, 3), generator=generator), scene.present


@torch.no_grad()
def test_the_first_step_of_a_window_is_shown_as_standing_still_whatever_it_is() -> None:
    """A window does not know what came before it. Of the first token only its first delta, nine numbers, is hidden."""
    model = tiny_denoiser()
    tokens, levels, present = asked(model)
    normal = model.normalizer.normalize
    latent, deltas, pairs = (part.clone() for part in model.layout.unpack(tokens))
    deltas[:, 0, :, 0] = torch.tensor([1.0, 0, 0, 0, 1, 0, 0, 0, 0])
    still = normal(model.layout.pack(latent, deltas, pairs))
    plain = model.transformer(still, levels, present)
    given = normal(tokens)
    kept = given.clone()
    torch.testing.assert_close(model.denoise(given, levels, present), plain)
    assert torch.equal(given, kept), "what is asked stays as it is"
    for token, delta, hidden in ((0, 0, True), (0, 1, False), (1, 0, False)):
        other = deltas.clone()
        other[:, token, :, delta, 6:] += 1.0
        answer = model.denoise(normal(model.layout.pack(latent, other, pairs)), levels, present)
        assert torch.allclose(answer, plain, atol=1e-6) == hidden


@torch.no_grad()
def test_a_network_that_tells_what_noise_hides_is_added_to_what_is_shown() -> None:
    model = tiny_denoiser(network={"skip": True})
    tokens, levels, present = asked(model)
    noisy = model.normalizer.normalize(tokens)
    lead = slice(model.layout.latent, model.layout.latent + 9)
    still = torch.tensor([1.0, 0, 0, 0, 1, 0, 0, 0, 0])
    noisy[:, 0, :, lead] = (still - model.normalizer.mean[lead]) / (model.normalizer.std[lead])
    signal = alpha_bar(model.layout.spread(model.layout.group_levels(levels)))
    expected = signal.sqrt() * noisy + (1 - signal).sqrt() * model.transformer(noisy, levels, present)
    torch.testing.assert_close(model.denoise(noisy, levels, present), expected)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [({"max_agents": 0}, "max_agents"), ({"window": 0}, "window"), ({"target": "both"}, "target")],
)
def test_sizes_that_cannot_be_are_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DenoiserCore(**wrong)


def test_one_alone_and_a_network_without_pairs_have_no_posterior() -> None:
    assert tiny_denoiser(network={"pairwise_posterior": True}).posterior is not None
    assert tiny_denoiser(max_agents=1, network={"pairwise_posterior": True}).posterior is None
