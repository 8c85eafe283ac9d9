"""The folder of a run."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import ModelCheckpoint

from magnet import cli
from magnet.cli import run_folder
from tests.toys import ToyData, ToyModel

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


def test_a_run_that_begins_in_the_same_second_gets_a_folder_of_its_own(tmp_path: Path) -> None:
    folder = tmp_path / "runs" / "quick" / "2026-01-01_00-00-00"
    with run_folder.claimed(folder) as one, run_folder.claimed(folder) as other:
        assert (one.name, other.name) == (folder.name, f"{folder.name}-v2")
        (one / "last.ckpt").touch()
    assert one.is_dir() and not other.exists()
    with run_folder.claimed(tmp_path / "never" / "quick" / "began"):
        pass
    assert not (tmp_path / "never").exists()


@pytest.mark.parametrize(
    ("said", "first"),
    [
        ({}, True),
        ({"LOCAL_RANK": "1"}, False),  # started by Lightning
        ({"RANK": "0", "LOCAL_RANK": "0"}, True),  # by torchrun
        ({"RANK": "8", "LOCAL_RANK": "0"}, False),  # on the second machine
        ({"SLURM_PROCID": "3"}, False),
        ({"SLURM_PROCID": "0", "LOCAL_RANK": "1"}, False),  # by Lightning, in an interactive job
    ],
)
def test_the_first_process_is_known_whoever_started_it(
    said: dict[str, str], first: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("RANK", "LOCAL_RANK", "SLURM_PROCID"):
        monkeypatch.delenv(name, raising=False)
    for name, value in said.items():
        monkeypatch.setenv(name, value)
    assert run_folder.first_process() == first


def test_the_best_checkpoint_stays_beside_a_users_own(tmp_path: Path) -> None:
    """Also beside one that measures the same, whose state Lightning must tell apart, but not beside its best.ckpt."""
    model = ToyModel()
    own = ModelCheckpoint(filename="mine", monitor="val/loss")
    kept = [own, *run_folder.checkpoints(tmp_path, model, [own])]
    assert [
        each.filename for each in Trainer(callbacks=kept, logger=False, accelerator="cpu").checkpoint_callbacks
    ] == [
        "mine",
        "last",
        "best",
    ]
    there = ModelCheckpoint(tmp_path / "checkpoints", "best", monitor="other")
    assert len(run_folder.checkpoints(tmp_path, model, [there])) == 1
    assert len(run_folder.checkpoints(tmp_path, model, [ModelCheckpoint(tmp_path, "best")])) == 2


def test_beside_a_users_own_a_measure_that_is_not_logged_stops_no_training(tmp_path: Path) -> None:
    model, own = ToyModel(), ModelCheckpoint(tmp_path, "mine")
    model.monitor = "val/else"
    callbacks = [own, *run_folder.checkpoints(tmp_path, model, [own])]
    words = {"logger": False, "accelerator": "cpu", "enable_progress_bar": False}
    Trainer(max_epochs=1, callbacks=callbacks, **words).fit(model, ToyData())
    assert {path.name for path in tmp_path.rglob("*.ckpt")} == {"mine.ckpt", "last.ckpt"}


@pytest.mark.parametrize("more", [(), ("--trainer.enable_checkpointing", "false")])
def test_a_training_whose_folder_cannot_be_made_says_so(
    toy: Path, capsys: pytest.CaptureFixture[str], more: tuple[str, ...]
) -> None:
    if not Path("/proc/self").exists():
        pytest.skip("no /proc here")
    words = ("--model", "ToyModel", "--data", "ToyData", "--trainer.accelerator", "cpu", "--out", "/proc/store")
    assert cli.main(["fit", *words, *more]) == 2
    said = capsys.readouterr().err
    assert "/proc/store/run.json: /proc/store cannot be made" in said and "choose another place" in said
    assert "Errno" not in said


def test_a_training_without_a_validation_says_why_it_has_no_best_checkpoint(
    toy: Path, capsys: pytest.CaptureFixture[str], recwarn: pytest.WarningsRecorder
) -> None:
    words = ("--model", "ToyModel", "--data", "ToyData", "--trainer.accelerator", "cpu", "--out", "run")
    assert cli.main(["fit", *words, "--trainer.max_steps", "1", "--trainer.limit_val_batches", "0"]) == 0
    said = capsys.readouterr()
    last = Path("run/checkpoints/last.ckpt")
    why = "there is no best.ckpt, because no validation measured val/loss"
    assert last.exists() and f"the run is in run; its last checkpoint: {last}; {why}\n" in said.out
    assert not any("monitored key" in str(each.message) for each in recwarn)
    assert cli.main(["fit", *words[:-1], "other", "--trainer.max_steps", "3"]) == 0
    said = capsys.readouterr()
    assert "its best checkpoint: " in said.out and "no best.ckpt" not in said.out
