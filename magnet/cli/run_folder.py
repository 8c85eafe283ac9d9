"""The folder of a run: configuration, logs and checkpoints."""

from __future__ import annotations

import contextlib
import os
import shlex
import sys
from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.utilities.exceptions import SIGTERMException

from magnet.checkpoints import FOLDER
from magnet.cli.errors import CommandError
from magnet.files import require_place

MONITOR = "val/loss"
LATEST = "latest"


def started_by_lightning() -> bool:
    """Whether this is a process that Lightning has started beside the first one, and not torchrun or SLURM."""
    return "RANK" not in os.environ and os.environ.get("LOCAL_RANK", "0") != "0"


def first_process() -> bool:
    """Whether this is the only process, or the first of all; told by what torchrun, SLURM and Lightning say."""
    said = ("RANK",) if "RANK" in os.environ else ("SLURM_PROCID", "LOCAL_RANK")
    return all(os.environ.get(name, "0") == "0" for name in said)


@contextlib.contextmanager
def claimed(folder: Path) -> Iterator[Path]:
    """The folder, made so that no run that begins in the same second takes it, too; gone if nothing came into it."""
    above = [each for each in (folder.parent, folder.parent.parent) if not each.exists()]
    number, name = 1, folder.name
    with contextlib.suppress(OSError):  # where nothing may be written, that is said once something is to be
        folder.parent.mkdir(parents=True, exist_ok=True)
        while True:
            try:
                folder.mkdir()
                break
            except FileExistsError:
                number += 1
                folder = folder.with_name(f"{name}-v{number}")
    try:
        yield folder
    finally:
        for each in (folder, *above):
            with contextlib.suppress(OSError):
                each.rmdir()


def run_folder(root: Path, out: str | None) -> Path:
    """Folder of this run: `out`, else one under `root` named by the time, to be `claimed`.

    `Record` tells it to other processes.
    """
    folder = Path(out) if out else root / datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    if folder.is_file():
        raise CommandError(
            f"--out {out}: got a file, expected a folder for what the run leaves behind; of files to predict from, the "
            "first comes first: magnet predict FILE ... --out FILE"
        )
    return folder


def with_checkpoint(settings: Any, command: str, checkpoint: Path | None) -> Any:
    """A run's settings as config.yaml holds them: with what was sampled or measured, so that it can be run again.

    settings: jsonargparse's, which stay as they are. A training's go on from nothing, as it did at first.
    """
    if command == "fit" or checkpoint is None:
        return settings
    changed = settings.clone()
    shipped = checkpoint.parent == FOLDER
    changed["ckpt_path"] = checkpoint.name if shipped else str(checkpoint.resolve())
    return changed


def require_folder(folder: Path) -> None:
    """Refuse a run's folder that cannot be made or written, before loggers, which say less of it, begin."""
    if first_process():
        require_place(folder / "run.json")


def checkpoints(folder: Path, model: LightningModule, callbacks: Sequence[Callback] = ()) -> list[Callback]:
    """`last.ckpt` after every epoch or validation, also when training is interrupted, and `best.ckpt`.

    Beside checkpoints that a user's own callbacks keep, ours stay; but for best.ckpt where one of these writes it. The
    model says what is best, by `monitor` and `monitor_mode`.
    """
    place = folder / "checkpoints"
    last = LastCheckpoint(place, "last", save_top_k=1, save_on_exception=True, enable_version_counter=False)
    own = [each for each in callbacks if isinstance(each, ModelCheckpoint)]
    if any(each.filename == "best" and Path(each.dirpath or place).resolve() == place.resolve() for each in own):
        return [last]
    kind = BestCheckpoint if own else ModelCheckpoint
    monitor = getattr(model, "monitor", MONITOR)
    mode = getattr(model, "monitor_mode", "min")
    return [last, kind(place, "best", monitor=monitor, mode=mode, save_top_k=1, enable_version_counter=False)]


def what_is_left(folder: Path, trainer: Trainer, model: LightningModule) -> str:
    """Where a training that is over is, in words, its checkpoint, and why that is not the best one."""
    files = {name: folder / "checkpoints" / f"{name}.ckpt" for name in ("best", "last")}
    name = next((name for name, file in files.items() if file.exists()), None)
    if name is None:
        return f"the run is in {folder}"
    monitor = getattr(model, "monitor", MONITOR)
    none = name == "last" and monitor not in trainer.callback_metrics
    why = f"; there is no best.ckpt, because no validation measured {monitor}" if none else ""
    return f"the run is in {folder}; its {name} checkpoint: {files[name]}{why}"


class BestCheckpoint(ModelCheckpoint):
    """Stands beside a user's own, which may measure the same; writes nothing where a model does not log its measure.

    Lightning tells the states of callbacks apart by their class and options.
    """

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self.monitor in trainer.callback_metrics:
            super().on_validation_end(trainer, pl_module)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self.monitor in trainer.callback_metrics:
            super().on_train_epoch_end(trainer, pl_module)


class LastCheckpoint(ModelCheckpoint):
    """Also saves when training ends between two validations, which Lightning's does not.

    Args:
        place: where, as messages name it: Lightning's `dirpath` is absolute.
        options: Lightning's.
    """

    def __init__(self, place: Path, *options: Any, **more: Any) -> None:
        super().__init__(place, *options, **more)
        self.place = place

    def save(self, trainer: Trainer) -> None:
        """Save the last checkpoint as it is now; all processes of a training do so together."""
        if not trainer.fast_dev_run:  # type: ignore[attr-defined]
            trainer.save_checkpoint(Path(str(self.dirpath)) / "last.ckpt")

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.save(trainer)

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Save, but not where a run was refused before its first step; say how an interrupted training goes on."""
        if isinstance(exception, CommandError):
            return
        super().on_exception(trainer, pl_module, exception)
        last = self.place / "last.ckpt"
        stopped = isinstance(exception, KeyboardInterrupt | SIGTERMException)
        if stopped and trainer.is_global_zero and last.exists():
            print(f"interrupted; the same command with --ckpt_path {shlex.quote(str(last))} goes on", file=sys.stderr)
