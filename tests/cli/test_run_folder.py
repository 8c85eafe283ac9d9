"""The folder of a run."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from magnet.cli import run_folder

FLAGS = {
    "data.train_clips": 4, "data.val_clips": 2, "data.batch_size": 2, "data.epoch_size": 8, "data.window_frames": 16,
    "model.network.width": 8, "model.network.depth": 1, "model.quantizer.codebook_dim": 8,
    "model.quantizer.codebook_size": 8, "trainer.accelerator": "cpu", "trainer.devices": 2, "trainer.strategy": "ddp",
    "trainer.max_steps": 2, "trainer.enable_progress_bar": "false",
}  # fmt: skip


@pytest.mark.slow
def test_two_processes_share_the_folder_that_the_first_one_names(tmp_path: Path) -> None:
    """Each would name one by its own clock."""
    words = [word for name, value in FLAGS.items() for word in (f"--{name}", str(value))]
    command = [sys.executable, "-m", "magnet", "fit", "--model", "Tokenizer", "--data", "Synthetic", *words]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    (folder,) = [path for path in (tmp_path / "runs" / "fit").iterdir() if not path.is_symlink()]
    names = {path.name for path in folder.rglob("*") if path.is_file()}
    assert {"config.yaml", "run.json", "metrics.csv", "last.ckpt", "best.ckpt"} <= names
    assert done.stdout.count("the run is in ") == 1


def test_what_is_left_is_reckoned_from_the_second_step_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first step waited 40 seconds for data; 2 seconds each are what is to come."""
    now = iter([0.0, 40.0, 42.0, 80.0])
    monkeypatch.setattr(run_folder.time, "monotonic", lambda: next(now))
    lines = run_folder.ProgressLines(seconds=30.0)
    for done in (1, 2, 21):
        lines.tell("test: denoising step", done, 64)
    said = capsys.readouterr().out.splitlines()
    assert said == ["test: denoising step 1/64", "test: denoising step 21/64, 0:01:26 left"]
