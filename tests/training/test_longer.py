"""A run that had come to its end goes on for more steps."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import pytest

from magnet import cli

FLAGS = {
    "data.train_clips": 4, "data.val_clips": 2, "data.batch_size": 2, "data.epoch_size": 8, "data.window_frames": 16,
    "model.network.width": 8, "model.network.depth": 1, "model.quantizer.codebook_dim": 8,
    "model.quantizer.codebook_size": 8, "trainer.accelerator": "cpu", "trainer.enable_progress_bar": "false",
    "trainer.log_every_n_steps": 1,
}  # fmt: skip


def rates(out: str, steps: int, *words: str) -> dict[int, float]:
    """The logged rates of a training, by its steps."""
    flags = [word for name, value in FLAGS.items() for word in (f"--{name}", str(value))]
    run = ["fit", "--model", "Tokenizer", "--data", "Synthetic", "--out", out, "--trainer.max_steps", str(steps)]
    assert cli.main([*run, *flags, *words]) == 0
    with Path(out, "metrics.csv").open(encoding="utf-8", newline="") as rows:
        return {int(row["step"]): float(row["lr-AdamW"]) for row in csv.DictReader(rows) if row["lr-AdamW"]}


def test_steps_and_rates_go_on_where_the_run_is_made_longer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From the end of an epoch, after which Lightning would leave out a number, and from a rate of zero."""
    monkeypatch.chdir(tmp_path)
    short = rates("short", 4)
    assert list(short) == [0, 1, 2, 3]
    longer = rates("longer", 6, "--ckpt_path", "short/checkpoints/last.ckpt")
    assert list(longer) == [4, 5]
    wanted = [short[0] * 0.5 * (1 + math.cos(math.pi * step / 6)) for step in (4, 5)]
    assert list(longer.values()) == pytest.approx(wanted)
