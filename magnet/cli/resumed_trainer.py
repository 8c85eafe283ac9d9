"""How a training goes on: with the options of the Trainer and the callbacks that its run was trained with."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import WeightAveraging
from lightning.pytorch.utilities import rank_zero_warn

from magnet.cli.arguments import Arguments
from magnet.cli.class_names import chosen, class_paths
from magnet.cli.config_files import read_layers
from magnet.cli.errors import CommandError

LIMITS = ("max_steps", "max_epochs", "max_time")
"""Options of the Trainer of which the first that is reached ends a training."""
BY_OPTIONS = ("ModelCheckpoint", "Timer")
"""Callbacks that options of the Trainer alone ask for."""
AVERAGE = "current_model_state"
"""Key of a checkpoint whose weights are an average: the weights that training goes on with."""


def trained_with(checkpoint: Path, given: Arguments) -> dict[str, Any]:
    """Options of the Trainer, and a chosen optimizer, of the run that a checkpoint is of, by its config.yaml.

    Whoever says how long it is to train now, or names callbacks, says all of that.
    """
    file, said = _run_of(checkpoint)
    if not said:
        return {}
    known = inspect.signature(Trainer.__init__).parameters
    trainer = {key: value for key, value in (said.get("trainer") or {}).items() if key in known and value is not None}
    files = [config.get("trainer") or {} for config in given.configs]
    for group in (LIMITS, ("callbacks",)):
        flags = tuple(f"--trainer.{name}" for name in group)
        in_files = any(options.get(name) is not None for options in files for name in group)
        if in_files or any(flag.startswith(flags) for flag in given.flags):
            trainer = {key: value for key, value in trainer.items() if key not in group}
    layer = {"trainer": trainer} | {key: said[key] for key in ("optimizer", "lr_scheduler") if said.get(key)}
    for name in class_paths(layer):
        if not chosen(name):
            raise CommandError(
                f"{file} names {name}, which is not part of magnet: if you trust it, say --config {file}"
            )
    return layer


def _run_of(checkpoint: Path) -> tuple[Path, dict[str, Any]]:
    """Where the options of the run lie that a checkpoint is of, and what they are; of a checkpoint alone nothing."""
    file = checkpoint.parent.parent / "config.yaml"
    there = file.is_file() and file.with_name("run.json").is_file()
    return file, read_layers(str(file))[-1].options if there else {}


class SameCallbacks(Callback):
    """Says which callbacks a training goes on without, and refuses to go on from an average of weights.

    Args:
        checkpoint: the file that it goes on from; None: it begins.
    """

    def __init__(self, checkpoint: Path | None) -> None:
        self.checkpoint = checkpoint
        options = {} if checkpoint is None else _run_of(checkpoint)[1]  # now, for a run that goes on writes its own
        said = (options.get("trainer") or {}).get("callbacks") or []
        asked = said if isinstance(said, list) else [said]
        paths = [each.get("class_path", "") if isinstance(each, dict) else str(each) for each in asked]
        self.asked = {path.rpartition(".")[2] for path in paths}  # those without a state, too

    def on_load_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        present: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
        states = (checkpoint.get("callbacks", {}), [each.state_key for each in present])
        had, has = ({key.partition("{")[0] for key in keys} for keys in states)
        here = has | {type(each).__name__ for each in present}
        lost = sorted((had | self.asked) - here - set(BY_OPTIONS))
        if AVERAGE in checkpoint and not any(isinstance(each, WeightAveraging) for each in present):
            raise CommandError(
                f"{self.checkpoint} is of a run that averages its weights ({', '.join(lost)}), and would go on from "
                "the average: name its callbacks among --trainer.callbacks too, or begin a new run from the average, "
                f"with --model.start_from {self.checkpoint} in place of --ckpt_path"
            )
        if lost:
            rank_zero_warn(
                f"the run goes on without {', '.join(lost)}, with which {self.checkpoint} was trained: to keep them, "
                "name them among --trainer.callbacks too"
            )
