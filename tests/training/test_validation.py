"""Means of a validation are over all that counts, in any batches and processes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
import torch.multiprocessing as mp
from lightning.pytorch import LightningModule, Trainer

from magnet.motion.scene import Scene
from magnet.training.validation import frames_of_people, log_means
from tests.datamodules.fakes import FakeData, couples_and_singles, random_clip
from tests.processes import as_by_torchrun, free_port


class Heights(LightningModule):
    """Logs how high pelvises are."""

    def validation_step(self, batch: Scene, batch_idx: int) -> None:
        assert batch.valid is not None
        counts = batch.present[:, None] & batch.valid[..., None]
        assert frames_of_people(batch) == int(counts.sum())
        log_means(self, {"height": batch.T_world_root[..., 1, 3][counts].mean()}, batch)

    def configure_optimizers(self) -> None:
        return None


def validated(size: int, **where: Any) -> float:
    """The mean height over windows of one and two people, some of them filled up, in batches of `size`."""
    clips = [*couples_and_singles("val"), random_clip("short", 20, 1, split="val")]
    data = FakeData(clips, window_frames=32, max_agents=3, val_batch_size=size)
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False}
    return Trainer(accelerator="cpu", **quiet, **where).validate(Heights(), data, verbose=False)[0]["height"]


def one_of_three(rank: int, port: int, folder: str) -> None:
    """One process of a validation."""
    as_by_torchrun(rank, 3, port)
    torch.save(validated(4, devices=3, strategy="ddp"), Path(folder, f"{rank}.pt"))


def test_who_shares_a_batch_makes_no_difference() -> None:
    assert [validated(size) for size in (4, 100)] == pytest.approx([validated(1)] * 2, rel=1e-5)


@pytest.mark.slow
def test_who_shares_a_process_makes_no_difference(tmp_path: Path) -> None:
    """Three do not divide the 1,268 frames of people evenly."""
    port = free_port()
    mp.spawn(one_of_three, args=(port, str(tmp_path)), nprocs=3)
    found = [torch.load(tmp_path / f"{rank}.pt") for rank in range(3)]
    assert found == pytest.approx([validated(1)] * 3, rel=1e-5)
