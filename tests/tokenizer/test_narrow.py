"""The same tokenizer with codes of few numbers."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from magnet import checkpoints
from magnet.motion.scene import Scene
from magnet.motion.tokens import by_token, scene_deltas
from magnet.testing import random_scene, tiny_denoiser, tiny_tokenizer
from magnet.tokenizer.lean import encoded, encoded_plainly
from magnet.tokenizer.module import Tokenizer
from magnet.tokenizer.narrow import coordinates, narrowed

WIDE = 16


@pytest.fixture
def scene(generator: torch.Generator) -> Scene:
    return random_scene(6, 64, 2, generator)


@pytest.fixture
def whole(scene: Scene) -> tuple[Tokenizer, Tokenizer]:
    """A tokenizer, and the same in all 15 coordinates that vectors of mean 0 can differ in."""
    tokenizer = tiny_tokenizer()
    made, lost = narrowed(tokenizer, [scene], WIDE - 1)
    assert abs(lost) < 1e-9
    return tokenizer, made


def test_nothing_is_lost_where_all_coordinates_stay(whole, scene: Scene) -> None:
    tokenizer, made = whole
    deltas = by_token(scene_deltas(scene))
    with torch.no_grad():
        wide, narrow = tokenizer.encode_scene(scene), made.encode_scene(scene)
        assert narrow.shape == (*wide.shape[:-1], WIDE - 1) and made.codebook_dim == WIDE - 1
        assert torch.allclose(
            torch.cdist(narrow[0, :, 0], narrow[0, :, 0]), torch.cdist(wide[0, :, 0], wide[0, :, 0]), atol=1e-4
        )
        assert torch.equal(made.requantize(narrow), narrow)
        shown = tokenizer.decode(wide, scene.betas, deltas)
        assert torch.allclose(made.decode(narrow, scene.betas, deltas), shown, atol=1e-4)


def test_numbers_of_codes_say_different_things_most_first(whole, scene: Scene) -> None:
    codes = whole[1].encode_scene(scene).flatten(0, 2).detach()
    spread = torch.cov(codes.T)
    assert torch.allclose(spread, torch.diag(spread.diag()), atol=1e-3 * float(spread.max()))
    assert (spread.diag().diff() <= 1e-6).all()


def test_few_coordinates_keep_more_variance_than_as_many_numbers(generator: torch.Generator) -> None:
    mixed = torch.randn(500, 3, generator=generator).double() @ torch.randn(3, WIDE, generator=generator).double() + 2.0
    basis, lost = coordinates(mixed, 4)
    assert torch.allclose(basis.T @ basis, torch.eye(4).double(), atol=1e-9) and abs(lost) < 1e-9
    assert torch.allclose(mixed @ basis @ basis.T, mixed, atol=1e-9)
    kept = mixed[:, :3].var(0).sum() / mixed.var(0).sum()
    assert coordinates(mixed, 3)[1] < 1 - kept


def test_packed_networks_are_the_plain_ones(whole, scene: Scene) -> None:
    for quantized in (True, False):
        plain = encoded_plainly(whole[1], scene, quantized, slice(3, 9))
        assert torch.allclose(encoded(whole[1], scene, quantized, slice(3, 9)), plain, atol=1e-4)


def test_it_is_saved_as_any_tokenizer_and_a_denoiser_lives_on_it(whole, scene: Scene, tmp_path: Path) -> None:
    made = whole[1]
    path = tmp_path / "narrow.ckpt"
    checkpoints.save({"state_dict": made.state_dict(), "hyper_parameters": dict(made.hparams)}, path)
    again = Tokenizer.load(path)
    assert torch.equal(again.encode_scene(scene), made.encode_scene(scene))
    model = tiny_denoiser()
    model.build(again)
    tokens, there = model.tokenize(scene)
    model.fit_normalizer(tokens, there)
    seen = model.normalizer.normalize(tokens)[there[..., 0]][:, : WIDE - 1]
    assert seen.mean(0).abs().max() < 1e-4 and (seen.std(0) - 1).abs().max() < 1e-4


def test_what_cannot_be_narrowed_is_said(whole, scene: Scene) -> None:
    with pytest.raises(ValueError, match="few numbers already"):
        narrowed(whole[1], [scene], 4)
    with pytest.raises(ValueError, match="size: got 16, expected 2 to 15"):
        narrowed(whole[0], [scene], WIDE)
