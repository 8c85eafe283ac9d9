"""Finite scalar quantization: what is known of it on paper, and that both models train on it."""

import itertools
import math

import pytest
import torch

from magnet import cli
from magnet.denoiser.module import Denoiser
from magnet.motion.scene import Scene
from magnet.testing import random_scene, tiny_denoiser, tiny_tokenizer
from magnet.tokenizer.base import PoseTokenizer
from magnet.tokenizer.core import TokenizerCore
from magnet.tokenizer.fsq import FSQ
from magnet.tokenizer.module import Tokenizer
from magnet.tokenizer.options import QuantizerOptions
from magnet.tokenizer.raw import RawPose

LEVELS = [(3,), (2, 2), (8, 5, 4), (8, 8, 8, 5, 5, 5)]
FAR = 100.0  # beyond any bound


def values(level: int) -> list[float]:
    """The levels of a number: half of them on each side of 0, one more below where their number is even."""
    return [(i - level // 2) / (level // 2) for i in range(level)]


@pytest.mark.parametrize("levels", LEVELS, ids=str)
def test_each_number_takes_all_of_its_levels_and_no_other(levels, generator):
    fsq = FSQ(levels)
    codes = fsq.nearest(fsq.continuous(4 * torch.randn(20_000, len(levels), generator=generator)))
    for number, level in enumerate(levels):
        assert torch.allclose(codes[:, number].unique(), torch.tensor(values(level)))
    ends = fsq.nearest(fsq.continuous(torch.tensor([[-FAR], [FAR]]).expand(2, len(levels))))
    assert torch.allclose(ends, torch.tensor([[values(level)[i] for level in levels] for i in (0, -1)]))


@pytest.mark.parametrize("levels", LEVELS[:3], ids=str)
def test_codes_come_back_from_their_numbers_and_none_has_two(levels):
    fsq = FSQ(levels)
    every = torch.tensor(list(itertools.product(*(values(level) for level in levels))))
    assert fsq.size == math.prod(levels) == len(every)
    assert sorted(fsq.index_of(every).tolist()) == list(range(fsq.size))
    assert torch.equal(fsq.nearest(every), every), "a code is its own nearest one"


def test_the_nearest_code_is_the_nearest_of_all(generator):
    fsq = FSQ((5, 4))
    every = torch.tensor(list(itertools.product(*(values(level) for level in (5, 4)))))
    latents = 3 * torch.randn(300, 2, generator=generator)
    nearest = every[torch.cdist(latents.double(), every.double()).argmin(dim=1)]
    assert torch.equal(fsq.nearest(latents), nearest)


def test_nothing_stays_nothing():
    """A vector of 0 is in the middle, also where the number of levels is even."""
    fsq = FSQ((8, 5))
    assert torch.allclose(fsq.continuous(torch.zeros(1, 2)), torch.zeros(1, 2), atol=1e-6)


def test_gradients_pass_straight_through_the_rounding(generator):
    fsq = FSQ((8, 5, 5)).train()
    vectors = torch.randn(7, 3, generator=generator, requires_grad=True)
    slope = torch.randn(7, 3, generator=generator)
    (through,) = torch.autograd.grad((fsq(vectors).latent * slope).sum(), vectors)
    (smooth,) = torch.autograd.grad((fsq.continuous(vectors) * slope).sum(), vectors)
    assert torch.equal(through, smooth) and (through != 0).all()


def test_what_is_masked_out_is_not_counted(generator):
    fsq = FSQ((3, 3)).train()
    vectors, mask = torch.randn(4, 5, 2, generator=generator), torch.rand(4, 5, generator=generator) < 0.5
    made = fsq(vectors, mask)
    assert made.counts.shape == (1, 9) and made.counts.sum() == mask.sum()
    assert ((made.index[..., 0] >= 0) == mask).all() and made.commitment == 0


@pytest.mark.parametrize("levels", [(), (1,), (2.5,)], ids=str)
def test_levels_that_mean_nothing_are_refused(levels):
    with pytest.raises(ValueError, match="levels: got"):
        QuantizerOptions(kind="fsq", levels=levels)


# -- in the models -----------------------------------------------------------------------------

SMALL = {"kind": "fsq", "levels": [5, 5, 4]}


@pytest.fixture(scope="module")
def tokenizer() -> Tokenizer:
    return tiny_tokenizer(quantizer=SMALL).eval()


def test_the_tokenizers_of_this_package_keep_the_protocol(tokenizer):
    for each in (tokenizer, tiny_tokenizer(), RawPose()):
        assert isinstance(each, PoseTokenizer), type(each)


def test_its_tokens_are_codes_of_as_many_numbers_as_levels(tokenizer, generator):
    scene = random_scene(2, 32, 2, generator)
    latent = tokenizer.encode_scene(scene)
    assert latent.shape == (2, 8, 2, 3) and tokenizer.codebook_dim == 3
    assert torch.equal(tokenizer.requantize(latent), latent)
    plain = tokenizer.encode_scene(scene, quantize=False)
    assert torch.equal(tokenizer.requantize(plain), latent) and not torch.equal(plain, latent)
    made = tokenizer.reconstruct(scene)
    assert isinstance(made, Scene) and made.T_world_root.isfinite().all()


def test_a_denoiser_learns_on_its_tokens(tokenizer, generator):
    model, scene = tiny_denoiser(max_agents=2), random_scene(2, 32, 2, generator)
    model.build(tokenizer)
    model.fit_normalizer(*model.tokenize(scene))
    model.losses(scene, generator)["loss"].backward()
    gradients = [parameter.grad for parameter in model.transformer.parameters()]
    assert all(gradient is not None and gradient.isfinite().all() for gradient in gradients)
    assert not [parameter for parameter in tokenizer.parameters() if parameter.grad is not None]


@pytest.mark.slow
def test_both_models_train_on_it_by_flags_and_a_checkpoint_brings_it_back(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data = ("--data.train_clips", "2", "--data.val_clips", "1", "--data.people", "[2]", "--data.batch_size", "2")
    two = ("--data.epoch_size", "4", "--trainer.max_steps", "2", "--trainer.accelerator", "cpu")
    small = ("--model.network.width", "16", "--model.network.depth", "1", "--model.quantizer.levels", "[5,5,4]")
    kind = ("--model", "Tokenizer", "--model.quantizer.kind", "fsq")
    assert cli.main(["fit", *kind, *small, *data, *two, "--out", "tok"]) == 0
    small = ("--model.network.width", "16", "--model.network.layers", "1", "--model.network.heads", "2")
    kind = ("--model", "Denoiser", "--model.tokenizer", "tok/checkpoints/last.ckpt")
    assert cli.main(["fit", *kind, *small, *data, *two, "--out", "den"]) == 0
    trained, loaded = Tokenizer.load("tok/checkpoints/last.ckpt"), Denoiser.load("den/checkpoints/last.ckpt")
    assert isinstance(loaded.tokenizer, TokenizerCore) and isinstance(loaded.tokenizer.quantizer, FSQ)
    assert loaded.tokenizer.quantizer.levels == (5, 5, 4) and loaded.layout.latent == 3
    for name, value in trained.state_dict().items():
        assert torch.equal(loaded.tokenizer.state_dict()[name], value), name
