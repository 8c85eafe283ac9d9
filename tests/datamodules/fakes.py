"""A data set of random smooth clips in memory, a trainer that says only where it runs, and what is seen of them."""

from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from lightning.pytorch import LightningModule, Trainer
from torch import Tensor, nn

from magnet.datamodules.base import Clip, MotionDataModule, Split
from magnet.datamodules.options import Augmentation
from magnet.motion.scene import Scene, concatenate
from magnet.testing import random_scene


@cache
def random_clip(
    name: str,
    frames: int = 200,
    agents: int = 2,
    source: str = "duets",
    split: Split = "train",
    bad: tuple[int, ...] = (),
) -> Clip:
    """A clip that its arguments alone decide; the frames `bad` are invalid."""
    generator = torch.Generator().manual_seed(sum(map(ord, name)) * 7919 + frames)
    valid = torch.ones(1, frames, dtype=torch.bool)
    valid[:, list(bad)] = False
    return Clip(random_scene(1, frames, agents, generator).replace(valid=valid), name, source, split)


class FakeData(MotionDataModule):
    """Any clips as a data set."""

    def __init__(self, given: list[Clip], **kwargs: Any) -> None:
        super().__init__(**{"batch_size": 16, "epoch_size": 64, **kwargs})
        self.given = given

    def clips(self, split: Split) -> list[Clip]:
        return [clip for clip in self.given if clip.split == split]


NOTHING = Augmentation(mirror=False, shuffle=False, drop=0.0, compose=0.0)
PLAIN: dict[str, Any] = {"augment": NOTHING}
"""No augmentation at all."""


def couples_and_singles(split: Split = "train") -> list[Clip]:
    couples = [random_clip(f"couple{k}", 150 + 40 * k, 2, "couples", split) for k in range(3)]
    return couples + [random_clip(f"single{k}", 120 + 30 * k, 1, "singles", split) for k in range(2)]


@dataclass
class FakeTrainer:
    """Where a process stands among others, as Lightning's trainer says it."""

    global_rank: int = 0
    world_size: int = 1
    overfit_batches: float = 0
    strategy: SimpleNamespace = field(default_factory=lambda: SimpleNamespace(root_device=torch.device("cpu")))


def same(a: Scene, b: Scene) -> bool:
    """Bit for bit, names too."""
    return a.names == b.names and all(torch.equal(value, b.tensors()[name]) for name, value in a.tensors().items())


def one_epoch(data: FakeData) -> Scene:
    return concatenate(list(data.train_dataloader()))


class Recorder(LightningModule):
    """A model that learns one number and remembers what it was shown."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(()))
        self.seen: list[tuple[str, ...]] = []
        self.checked: list[tuple[str, ...]] = []

    def training_step(self, batch: Scene) -> Tensor:
        assert isinstance(batch, Scene)
        self.seen.append(batch.names)
        return (self.weight - batch.T_world_root[..., 0, 3].mean()) ** 2

    def validation_step(self, batch: Scene) -> None:
        self.checked.append(batch.names)

    def test_step(self, batch: Scene) -> None:
        self.checked.append(batch.names)

    def predict_step(self, batch: Scene) -> tuple[str, ...]:
        return batch.names

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=0.1)


def quiet(path: Path, **options: Any) -> Trainer:
    return Trainer(
        accelerator="cpu",
        default_root_dir=path,
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        **options,
    )
