"""Codes of few numbers, written when a tokenizer's training is over."""

from __future__ import annotations

from pathlib import Path

import torch
from lightning.pytorch.callbacks import ModelCheckpoint

from magnet import checkpoints
from magnet.callbacks import NarrowCodes
from magnet.callbacks.narrow_codes import NAME
from magnet.testing import random_scene, tiny_denoiser, tiny_tokenizer
from magnet.tokenizer.module import Tokenizer
from magnet.training import origins
from tests.denoiser.test_module import data, trainer


def trained(folder: Path, steps: int, **limits: object) -> Tokenizer:
    """A small tokenizer after so many steps, with the callback."""
    tokenizer = tiny_tokenizer()
    tokenizer.origin = {origins.STARTED: [{"name": "first.ckpt"}], "data": [{"class_path": "Mine"}]}
    kept = ModelCheckpoint(dirpath=folder, save_last=True)
    run = trainer(steps, callbacks=[kept, NarrowCodes(size=15)], enable_checkpointing=True, **limits)
    run.fit(tokenizer, datamodule=data())
    return tokenizer


def test_the_tokenizer_that_is_written_says_what_the_trained_one_says(tmp_path: Path, generator) -> None:
    tokenizer = trained(tmp_path, 2).eval()
    narrow = Tokenizer.load(tmp_path / NAME)
    scene = random_scene(2, 32, 2, generator)
    with torch.no_grad():
        error = tokenizer.reconstruct(scene).T_world_root - narrow.reconstruct(scene).T_world_root
    assert narrow.codebook_dim == 15 and error.abs().max() < 1e-3
    model = tiny_denoiser()
    model.build(Tokenizer.load(tmp_path / NAME))
    assert model.layout.latent == 15


def test_the_tokenizer_that_is_written_says_where_its_weights_come_from(tmp_path: Path) -> None:
    origin = trained(tmp_path, 1).origin
    assert checkpoints.read(tmp_path / NAME)[origins.KEY] == {**origin, "body": "open-1"}


def test_a_training_that_was_stopped_writes_none(tmp_path: Path) -> None:
    trained(tmp_path, 4, max_time={"seconds": 0})
    assert not (tmp_path / NAME).exists()
