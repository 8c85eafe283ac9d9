"""The lean form of the tokenizer: the same poses and codes, of any part of a clip alone."""

from __future__ import annotations

import pytest
import torch

from magnet.motion.tokens import by_token, scene_deltas
from magnet.testing.models import random_scene, tiny_tokenizer
from magnet.tokenizer.lean import decoded, encoded
from magnet.tokenizer.raw import RawPose


@pytest.fixture(scope="module", params=[(False, 0), (True, 0), (True, 1)], ids=["sees both ways", "causal", "ahead"])
def tokenizer(request: pytest.FixtureRequest):
    made = tiny_tokenizer(
        network={"width": 16, "depth": 2, "causal": request.param[0], "lookahead": request.param[1]}
    ).eval()
    for weight in made.vqvae.parameters():
        torch.nn.init.normal_(weight, std=0.2)
    return made


@torch.no_grad()
def test_parts_are_those_of_the_whole_clip_bit_for_bit_and_close_to_the_plain_network(tokenizer) -> None:
    scene = random_scene(2, 80, 3, torch.Generator().manual_seed(0))
    latent, deltas = tokenizer.encode_scene(scene, False), by_token(scene_deltas(scene))
    whole = decoded(tokenizer, latent, scene.betas, deltas, slice(0, 80))
    torch.testing.assert_close(whole, tokenizer.decode(latent, scene.betas, deltas), rtol=1e-4, atol=1e-5)
    found = encoded(tokenizer, scene, False, slice(0, 20))
    torch.testing.assert_close(found, latent, rtol=1e-4, atol=1e-5)
    for first, stop in ((0, 1), (7, 9), (19, 20), (0, 20)):
        part = slice(4 * first, 4 * stop)
        assert torch.equal(decoded(tokenizer, latent, scene.betas, deltas, part), whole[:, part])
        assert torch.equal(encoded(tokenizer, scene, False, slice(first, stop)), found[:, first:stop])


@torch.no_grad()
def test_token_by_token_is_the_whole_clip_from_what_is_near_alone(tokenizer) -> None:
    """What a live partner does: each new token from the tokens that it can depend on, however long the past."""
    scene = random_scene(1, 200, 1, torch.Generator().manual_seed(1))
    latent, deltas = tokenizer.encode_scene(scene, False), by_token(scene_deltas(scene))
    before, after = tokenizer.receptive_field
    whole = decoded(tokenizer, latent, scene.betas, deltas, slice(0, 200))
    for token in (0, 3, before + 1, 40):
        low, high = max(token - before, 0), min(token + 1 + after, 50)
        own = slice(4 * (token - low), 4 * (token - low) + 4)
        made = decoded(tokenizer, latent[:, low:high], scene.betas, deltas[:, low:high], own)
        assert torch.equal(made, whole[:, 4 * token : 4 * token + 4])


@torch.no_grad()
def test_changed_weights_and_other_tokenizers_are_seen(tokenizer) -> None:
    scene = random_scene(1, 16, 1, torch.Generator().manual_seed(0))
    latent, deltas = tokenizer.encode_scene(scene, False), by_token(scene_deltas(scene))
    tokenizer.vqvae.decoder.layers[0].conv.bias.add_(0.5)
    expected = tokenizer.decode(latent, scene.betas, deltas)
    torch.testing.assert_close(
        decoded(tokenizer, latent, scene.betas, deltas, slice(0, 16)), expected, atol=1e-5, rtol=1e-4
    )
    raw = RawPose()
    codes = raw.encode_scene(scene)
    assert torch.equal(encoded(raw, scene, True, slice(1, 3)), codes[:, 1:3])
    assert torch.equal(
        decoded(raw, codes, scene.betas, deltas, slice(4, 8)), raw.decode(codes, scene.betas, deltas)[:, 4:8]
    )
