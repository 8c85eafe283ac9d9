"""A model and data sets of next to nothing, for tests of the command line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch import LightningDataModule, LightningModule
from torch import Tensor, nn
from torch.utils.data import DataLoader

from magnet.cli import train
from magnet.datamodules import registry
from magnet.evaluation.evaluator import Evaluator


class ToyModel(LightningModule):
    """One matrix.

    Args:
        max_agents: its rows.
        window: its columns.
        lr: step size.
    """

    seen: dict[str, Any] = {}  # noqa: RUF012  what the last run was given, for tests to look at

    def __init__(self, max_agents: int = 2, window: int = 16, lr: float = 0.1) -> None:
        super().__init__()
        self.save_hyperparameters()
        self.max_agents, self.window, self.lr = max_agents, window, lr
        self.weight = nn.Parameter(torch.ones(max_agents, window))
        ToyModel.seen = {"model": self}

    def _loss(self, batch: Tensor) -> Tensor:
        return (self.weight.mean() - batch.mean()).square()

    def training_step(self, batch: Tensor, batch_idx: int) -> Tensor:
        return self._loss(batch)

    def validation_step(self, batch: Tensor, batch_idx: int) -> None:
        self.log("val/loss", self._loss(batch))

    def test_step(self, batch: Tensor, batch_idx: int) -> None:
        self.log("test/loss", self._loss(batch))

    def predict_step(self, batch: Tensor, batch_idx: int) -> Tensor:
        return batch

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=self.lr)


class ToyEvaluator(Evaluator):
    """Around a toy in place of a denoiser: it keeps what it was given, for tests to look at, and samples nothing."""

    def setup(self, stage: str) -> None:
        ToyModel.seen["evaluator"] = self

    def on_test_start(self) -> None:
        pass

    def test_step(self, batch: Any, batch_idx: int) -> None:
        pass

    def on_test_epoch_end(self) -> None:
        pass

    def on_predict_start(self) -> None:
        pass

    def predict_step(self, batch: Any, batch_idx: int) -> Any:
        return batch


class ToyData(LightningDataModule):
    """Ones.

    Args:
        window_frames: frames of a window.
        max_agents: people.
        root: where nothing lies.
    """

    def __init__(self, window_frames: int = 64, max_agents: int = 2, root: str = "nowhere") -> None:
        super().__init__()
        self.window_frames, self.max_agents, self.root = window_frames, max_agents, root
        ToyModel.seen["data"] = self

    def _loader(self) -> DataLoader[Tensor]:
        return DataLoader(torch.zeros(4, self.max_agents), batch_size=2)  # type: ignore[arg-type]

    train_dataloader = val_dataloader = test_dataloader = predict_dataloader = _loader


class OtherData(ToyData):
    """Ones from elsewhere.

    Args:
        root: where nothing lies either.
        takes: how many.
        window_frames: frames of a window.
        max_agents: people.
    """

    def __init__(self, root: str = "elsewhere", takes: int = 1, window_frames: int = 64, max_agents: int = 2) -> None:
        super().__init__(window_frames, max_agents, root)
        self.takes = takes


def play(monkeypatch: pytest.MonkeyPatch, folder: Path) -> Path:
    """Work in a folder, with toys in place of the real models and data."""
    monkeypatch.chdir(folder)
    monkeypatch.delenv("MAGNET_DEBUG", raising=False)
    monkeypatch.setattr(train, "MODELS", {"ToyModel": "tests.toys"})
    monkeypatch.setattr(registry, "classes", lambda: {"ToyData": ToyData, "OtherData": OtherData})
    return folder
