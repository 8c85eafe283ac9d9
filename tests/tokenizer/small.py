"""A small tokenizer, four batches of motion, and a trainer that says nothing."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import lightning as L
import torch
from torch.utils.data import DataLoader

from magnet.motion.scene import Scene
from magnet.motion.tokens import by_token, scene_deltas
from magnet.testing import random_scene
from magnet.tokenizer import Tokenizer


def tiny(scene: Scene | None = None, **fields: Any) -> Tokenizer:
    torch.manual_seed(0)
    small = {"network": {"width": 24, "depth": 2}, "quantizer": {"codebook_dim": 16, "codebook_size": 32}}
    groups = {key: {**small[key], **value} if key in small else value for key, value in fields.items()}
    tokenizer = Tokenizer(**{**small, **groups})
    if scene is not None:
        tokenizer.init_codebook([scene])
    return tokenizer


def conditions(scene: Scene) -> tuple[torch.Tensor, torch.Tensor]:
    return scene.betas, by_token(scene_deltas(scene))


class Scenes(L.LightningDataModule):
    """Four fixed batches, in order."""

    def __init__(self) -> None:
        super().__init__()
        self.batches = [random_scene(3, 32, 2, torch.Generator().manual_seed(seed)) for seed in range(4)]

    def statistics_batches(self) -> Iterator[Scene]:
        yield from self.batches

    def train_dataloader(self) -> DataLoader[Scene]:
        return DataLoader(self.batches, batch_size=None)  # type: ignore[arg-type]

    val_dataloader = test_dataloader = predict_dataloader = train_dataloader

    def transfer_batch_to_device(self, batch: Scene, device: torch.device, dataloader_idx: int) -> Scene:
        return batch.to(device)


def trainer(folder: Path, **options: Any) -> L.Trainer:
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False, "accelerator": "cpu"}
    return L.Trainer(default_root_dir=folder, **{**quiet, **options})
