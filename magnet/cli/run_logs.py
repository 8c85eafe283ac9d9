"""Where a run's curves go: metrics.csv in its folder, TensorBoard, Weights & Biases and loggers that a user chooses."""

from __future__ import annotations

import csv
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger, WandbLogger
from lightning.pytorch.loggers.logger import rank_zero_experiment

from magnet.cli.errors import CommandError
from magnet.extras import installing


class Curves(CSVLogger):
    """metrics.csv; where a training goes on in its own folder, so does the file, which Lightning's would delete."""

    @property
    @rank_zero_experiment
    def experiment(self) -> Any:
        if self._experiment is None:
            file = Path(self.log_dir) / "metrics.csv"
            before = file.with_suffix(".part")
            if file.is_file():
                file.replace(before)
            writer: Any = super().experiment
            if before.is_file():
                before.replace(file)
                with file.open(newline="", encoding="utf-8") as rows:
                    writer.metrics_keys = next(csv.reader(rows), [])
        return self._experiment


def loggers(folder: Path, chosen: Any, wandb: str | None, fit: bool, goes_on: bool = False) -> list[Logger]:
    """The loggers of a run; only training is logged by default.

    A training always keeps metrics.csv in its folder; TensorBoard is beside it where it is installed and nothing else
    is chosen.

    Args:
        folder: of the run.
        chosen: the Trainer's option: False for none at all, None or True for the default ones, or loggers, which are
            added to metrics.csv.
        wandb: online or offline, to log to Weights & Biases too.
        fit: this is a training.
        goes_on: in the folder of the training that it goes on with.
    """
    if chosen is False:
        if wandb is not None:
            raise CommandError(f"--wandb {wandb} logs and --trainer.logger false does not: leave out one of them")
        return []
    own: list[Logger] = []
    if chosen is not None and chosen is not True:
        own = list(chosen) if isinstance(chosen, (list, tuple)) else [chosen]
    if wandb is not None and any(isinstance(logger, WandbLogger) for logger in own):
        raise CommandError(f"--wandb {wandb} and a WandbLogger in --trainer.logger: leave out one of them")
    found: list[Logger] = []
    if fit and not own and (find_spec("tensorboard") or find_spec("tensorboardX")):
        found.append(TensorBoardLogger(str(folder.parent), "", folder.name, default_hp_metric=False))
    if fit and not any(isinstance(logger, CSVLogger) and Path(logger.log_dir) == folder for logger in own):
        found.append((Curves if goes_on else CSVLogger)(str(folder.parent), "", folder.name))
    if wandb is not None:
        found.append(_wandb(folder, offline=wandb == "offline"))
    return [*found, *own]


def _wandb(folder: Path, offline: bool) -> Logger:
    if find_spec("wandb") is None:
        raise CommandError(f"--wandb needs the package wandb: {installing('wandb')}")
    folder.mkdir(parents=True, exist_ok=True)
    label = f"{folder.parent.name}/{folder.name}"
    return WandbLogger(project="magnet", name=label, save_dir=str(folder), offline=offline)
