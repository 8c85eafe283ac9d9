"""A training that is told to end, by Ctrl+C or SIGTERM, in a step."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch import Callback
from torch import Tensor

from magnet import cli
from tests.toys import ToyData, ToyModel

CPU = ("--trainer.accelerator", "cpu", "--trainer.enable_progress_bar", "false")
FIT = ("fit", "--model", "ToyModel", "--model.lr", "1.0", "--data", "ToyData", "--trainer.log_every_n_steps", "1")
HOW = ("--trainer.max_steps", "6", "--trainer.val_check_interval", "2", "--trainer.num_sanity_val_steps", "0")
CODES = {signal.SIGINT: 130, signal.SIGTERM: 143}


class Numbered:
    """Six batches, each full of its number, that go on where they were, as our data sets do."""

    def __init__(self) -> None:
        self.next = 0

    def __len__(self) -> int:
        return 6

    def __iter__(self) -> Iterator[Tensor]:
        while self.next < len(self):
            self.next += 1
            yield torch.full((2, 2), self.next - 1.0)
        self.next = 0

    def state_dict(self) -> dict[str, int]:
        return {"next": self.next}

    def load_state_dict(self, state: dict[str, int]) -> None:
        self.next = state["next"]


@pytest.fixture(autouse=True)
def numbered(toy: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Six batches of which no two are alike; handlers are put back."""
    monkeypatch.setattr(ToyData, "train_dataloader", lambda self: Numbered())
    before = {number: signal.getsignal(number) for number in CODES}
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def tell(monkeypatch: pytest.MonkeyPatch, number: int, batch: int, times: int = 1) -> list[int]:
    """Send a signal while the loss of a batch is computed; the batches that are trained on from now on."""
    seen: list[int] = []
    plain = ToyModel.training_step

    def training_step(self: ToyModel, rows: Tensor, batch_idx: int) -> Tensor:
        seen.append(int(rows[0, 0]))
        if batch_idx == batch and len(seen) <= batch + 1:
            for _ in range(times):
                os.kill(os.getpid(), number)
        return plain(self, rows, batch_idx)

    monkeypatch.setattr(ToyModel, "training_step", training_step)
    return seen


def weights(run: str) -> Tensor:
    return torch.load(f"{run}/checkpoints/last.ckpt", weights_only=True)["state_dict"]["weight"]


def validated(*runs: str) -> list[int]:
    """Steps after which validation was measured."""
    found = []
    for run in runs:
        with (Path(run) / "metrics.csv").open(newline="") as file:
            found += [int(row["step"]) for row in csv.DictReader(file) if row.get("val/loss")]
    return found


@pytest.mark.parametrize("hook", ["on_fit_start", "on_test_start"])
def test_ctrl_c_while_no_steps_are_made_ends_a_run_at_once_as_of_every_command(
    hook: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """And not as a failure, nor with Ctrl+C ignored by whatever runs next in the process."""
    command = "test" if hook == "on_test_start" else "fit"
    assert cli.main([*FIT, *CPU, "--trainer.max_steps", "1", "--out", "before"]) == 0
    words = ["--ckpt_path", "before/checkpoints/last.ckpt", *CPU, "--out", "told"]

    def ctrl_c(self: Callback, trainer: Any, pl_module: Any) -> None:
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(Callback, hook, ctrl_c)
    assert cli.main([command, *words]) == 130
    assert capsys.readouterr().err.splitlines()[-1] == f"magnet {command}: error: interrupted"
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize("batch", [1, 2, 3])
@pytest.mark.parametrize("number", CODES)
def test_a_training_that_is_told_to_end_ends_after_the_step_and_goes_on_as_if_it_had_not(
    number: int, batch: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """After batches 1 and 3 a validation is due."""
    assert cli.main([*FIT, *HOW, *CPU, "--out", "whole"]) == 0
    seen = tell(monkeypatch, number, batch)
    assert cli.main([*FIT, *HOW, *CPU, "--out", "told"]) == CODES[number]  # type: ignore[index]
    assert seen == [*range(batch + 1)]
    said = capsys.readouterr().err.splitlines()
    assert "interrupted; the same command with --ckpt_path told/checkpoints/last.ckpt goes on" in said
    assert sum(line.startswith("stopping after this step") for line in said) == (number == signal.SIGINT)
    assert cli.main(["fit", "--ckpt_path", "told/checkpoints/last.ckpt", "--out", "on", *HOW, *CPU]) == 0
    assert seen == [*range(6)]
    assert torch.equal(weights("on"), weights("whole"))
    assert validated("whole") == [1, 3, 5] == validated("told", "on")


@pytest.mark.parametrize("batch", [0, 1, 2])
@pytest.mark.parametrize("number", CODES)
def test_of_a_step_of_several_batches_all_are_seen_before_a_training_ends(
    number: int, batch: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A checkpoint holds no gradients: those of batches that no step has seen would be lost."""
    rates = {"accumulate_grad_batches": 3, "max_steps": 2, "val_check_interval": 2}
    several = [part for name, value in rates.items() for part in (f"--trainer.{name}", str(value))]
    how = (*several, *CPU)
    assert cli.main([*FIT, *how, "--out", "whole"]) == 0
    seen = tell(monkeypatch, number, batch)
    assert cli.main([*FIT, *how, "--out", "told"]) == CODES[number]  # type: ignore[index]
    assert seen == [0, 1, 2]
    assert cli.main(["fit", "--ckpt_path", "told/checkpoints/last.ckpt", "--out", "on", *how]) == 0
    assert seen == [*range(6)]
    assert torch.equal(weights("on"), weights("whole"))


def tell_in_validation(monkeypatch: pytest.MonkeyPatch, number: int, times: int = 1) -> list[int]:
    """Send a signal in the first batch of the first validation; the batches that are validated on from now on."""
    seen: list[int] = []
    plain = ToyModel.validation_step

    def step(self: ToyModel, rows: Tensor, batch_idx: int) -> None:
        seen.append(batch_idx)
        plain(self, rows, batch_idx)
        if len(seen) == 1:
            for _ in range(times):
                os.kill(os.getpid(), number)

    monkeypatch.setattr(ToyModel, "validation_step", step)
    return seen


@pytest.mark.parametrize("number", CODES)
def test_a_validation_that_runs_is_finished_first(number: int, toy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = tell_in_validation(monkeypatch, number)
    assert cli.main([*FIT, *HOW, *CPU, "--out", "told"]) == CODES[number]  # type: ignore[index]
    assert seen == [0, 1]
    assert validated("told") == [1]
    assert (toy / "told/checkpoints/best.ckpt").exists()


def test_the_second_sigterm_cuts_a_validation_short(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = tell_in_validation(monkeypatch, signal.SIGTERM, times=2)
    assert cli.main([*FIT, *HOW, *CPU, "--out", "told"]) == 143
    assert seen == [0]
    assert torch.load("told/checkpoints/last.ckpt", weights_only=True)["global_step"] == 2


def test_before_a_validation_that_is_due_after_sigterm_a_checkpoint_is_written_that_goes_on(
    toy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever has said it may kill the training in the validation."""
    assert cli.main([*FIT, *HOW, *CPU, "--out", "whole"]) == 0
    seen = tell(monkeypatch, signal.SIGTERM, 1)
    plain = ToyModel.validation_step

    def step(self: ToyModel, rows: Tensor, batch_idx: int) -> None:
        plain(self, rows, batch_idx)
        if not (toy / "left").exists():
            shutil.copytree(toy / "told", toy / "left")

    monkeypatch.setattr(ToyModel, "validation_step", step)
    assert cli.main([*FIT, *HOW, *CPU, "--out", "told"]) == 143
    assert torch.load("left/checkpoints/last.ckpt", weights_only=True)["global_step"] == 2
    assert cli.main(["fit", "--ckpt_path", "left/checkpoints/last.ckpt", "--out", "on", *HOW, *CPU]) == 0
    assert seen == [*range(6)]
    assert torch.equal(weights("on"), weights("whole"))


def test_the_second_ctrl_c_stops_at_once(
    toy: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    seen = tell(monkeypatch, signal.SIGINT, 2, times=2)
    assert cli.main([*FIT, *HOW, *CPU, "--out", "told"]) == 130
    assert seen == [0, 1, 2]
    assert torch.load("told/checkpoints/last.ckpt", weights_only=True)["global_step"] == 2
    assert "stopping after this step" in capsys.readouterr().err


def test_a_training_that_ends_by_itself_leaves_ctrl_c_as_it_was() -> None:
    before = signal.getsignal(signal.SIGINT)
    assert cli.main([*FIT, *HOW, *CPU, "--out", "whole"]) == 0
    assert signal.getsignal(signal.SIGINT) is before


def test_where_ctrl_c_is_ignored_it_stays_so(monkeypatch: pytest.MonkeyPatch) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    seen = tell(monkeypatch, signal.SIGINT, 2)
    assert cli.main([*FIT, *HOW, *CPU, "--out", "whole"]) == 0
    assert seen == [*range(6)]


@pytest.mark.parametrize("command", ["test", "validate", "predict"])
def test_other_commands_end_at_once_by_ctrl_c(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert cli.main([*FIT, *HOW, *CPU, "--out", "whole"]) == 0
    seen: list[Any] = []

    def step(self: ToyModel, batch: Tensor, batch_idx: int) -> None:
        seen.append(signal.getsignal(signal.SIGINT))
        os.kill(os.getpid(), signal.SIGINT)
        seen.append("went on")

    name = {"test": "test_step", "validate": "validation_step", "predict": "predict_step"}[command]
    monkeypatch.setattr(ToyModel, name, step)
    assert cli.main([command, "--ckpt_path", "whole/checkpoints/last.ckpt", *CPU]) == 130
    assert seen == [signal.default_int_handler]


@pytest.fixture(scope="module")
def several(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of `tests.cli.stop_runs`."""
    folder = tmp_path_factory.mktemp("several")
    words = [sys.executable, "-m", "tests.cli.stop_runs", str(folder)]
    root = Path(__file__).parents[2]
    subprocess.run(words, cwd=root, env={**os.environ, "OMP_NUM_THREADS": "1"}, check=True, timeout=550)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "steps", "code"),
    [
        ("one", 2, 130),
        ("both", 1, 130),
        ("passed on", 2, 130),
        ("before a validation", 3, 130),
        ("in a validation", 3, 130),
        ("ended", 4, 143),
        ("ended in a validation", 3, 143),
    ],
)
def test_several_processes_of_which_any_is_told_end_after_one_step_and_go_on_as_if_they_had_not(
    name: str, steps: int, code: int, several: Path
) -> None:
    codes = json.loads((several / "codes.json").read_text())
    assert (codes["whole"], codes[name], codes[f"{name}, on"]) == ([0, 0], [code, code], [0, 0])

    def last(run: str) -> dict[str, Any]:
        found: dict[str, Any] = torch.load(several / run / "checkpoints/last.ckpt", weights_only=False)
        return found

    assert last(name)["global_step"] == steps
    whole, gone_on = last("whole")["state_dict"], last(f"{name}, on")["state_dict"]
    assert all(torch.equal(whole[key], gone_on[key]) for key in whole)
    assert validated(str(several / name)) == ([2] if steps >= 3 else [])
    said = (several / f"{name}.0.log").read_text()
    assert said.count("stopping after this step") == (code == 130) and "goes on" in said
    assert "stopping" not in (several / f"{name}.1.log").read_text()


SLURM = {"NTASKS": "1", "PROCID": "0", "LOCALID": "0", "NODEID": "0", "JOB_ID": "7", "JOB_NAME": "big"}
"""What SLURM tells a job of one process, behind SLURM_."""


@pytest.mark.parametrize("accumulated", [1, 3])
@pytest.mark.parametrize("batch", [0, 1, 2])
def test_a_job_whose_time_is_up_goes_on_as_if_it_had_not_been(
    batch: int, accumulated: int, toy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SLURM's signal has Lightning write a checkpoint, and ask that the job is started again."""
    rates = ("--trainer.max_epochs", "1", "--trainer.accumulate_grad_batches", str(accumulated))
    words = (*FIT, *HOW, *CPU, *rates)
    assert cli.main([*words, "--out", "whole"]) == 0
    (toy / "scontrol").write_text("#!/bin/sh\n")
    (toy / "scontrol").chmod(0o755)
    for name, value in {**{f"SLURM_{name}": value for name, value in SLURM.items()}, "PATH": f"{toy}:/bin"}.items():
        monkeypatch.setenv(name, value)
    seen = tell(monkeypatch, signal.SIGUSR1, batch)
    assert cli.main([*words, "--out", "told"]) == 0
    (toy / "on").mkdir()
    shutil.copy("told/hpc_ckpt_1.ckpt", "on")
    monkeypatch.setenv("SLURM_RESTART_COUNT", "1")
    assert cli.main([*words, "--out", "on"]) == 0
    assert seen == [*range(6), *range((batch // accumulated + 1) * accumulated, 6)]
    assert torch.equal(weights("on"), weights("whole"))
