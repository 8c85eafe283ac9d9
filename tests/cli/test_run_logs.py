"""Where a training's curves go."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import pytest
from lightning.pytorch.loggers import CSVLogger, WandbLogger

from magnet import cli
from magnet.cli import run_logs
from magnet.cli.errors import CommandError
from tests.toys import ToyModel

FIT = ("fit", "--model", "ToyModel", "--data", "ToyData", "--trainer.max_steps", "4", "--out", "run")
QUIET = ("--trainer.accelerator", "cpu", "--trainer.enable_progress_bar", "false")
LOGGER = ("--trainer.logger", "CSVLogger", "--trainer.logger.save_dir", "mine")


def fit(*words: str) -> list[Any]:
    """The loggers of a training that must succeed."""
    assert cli.main([*FIT, *QUIET, *words]) == 0
    return ToyModel.seen["model"].trainer.loggers


def rows(file: Path) -> list[str]:
    with file.open(encoding="utf-8", newline="") as text:
        return [row["step"] for row in csv.DictReader(text)]


def test_a_chosen_logger_is_added_to_the_curves_in_the_runs_folder(toy: Path) -> None:
    fit(*LOGGER, "--trainer.log_every_n_steps", "1")
    (chosen,) = (toy / "mine").rglob("metrics.csv")
    assert rows(toy / "run" / "metrics.csv") == rows(chosen) != []
    assert "lr-SGD" in (toy / "run" / "metrics.csv").read_text()


def test_wandb_is_used_beside_a_chosen_logger(
    toy: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made: list[dict[str, Any]] = []

    class Stand(WandbLogger):
        def __init__(self, **words: Any) -> None:
            made.append(words)

    monkeypatch.setattr(run_logs, "WandbLogger", Stand)
    monkeypatch.setattr(run_logs, "find_spec", lambda name: name)
    chosen = CSVLogger("mine")
    found = run_logs.loggers(Path("run"), chosen, "offline", fit=True)
    assert [type(logger) for logger in found] == [CSVLogger, Stand, CSVLogger] and found[-1] is chosen
    assert made[0]["offline"] is True
    with pytest.raises(CommandError, match="--wandb offline and a WandbLogger"):
        run_logs.loggers(Path("run"), [Stand()], "offline", fit=True)


def test_wandb_without_loggers_is_refused(toy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*FIT, *QUIET, "--wandb", "offline", "--trainer.logger", "false"]) == 2
    assert "--wandb offline logs and --trainer.logger false does not" in capsys.readouterr().err


def test_a_chosen_logger_of_the_runs_own_file_takes_its_place(toy: Path) -> None:
    own = CSVLogger(".", "", "run")
    assert run_logs.loggers(Path("run"), own, None, fit=True) == [own]
