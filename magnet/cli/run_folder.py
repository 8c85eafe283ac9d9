"""The folder of a run: configuration, logs and checkpoints."""

from __future__ import annotations

import contextlib
import os
import shlex
import sys
import time
from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint, ProgressBar, RichProgressBar
from lightning.pytorch.utilities.exceptions import SIGTERMException
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from magnet.checkpoints import FOLDER
from magnet.cli.errors import CommandError
from magnet.cli.pipes import output_closed
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

    Raises:
        CommandError: `out` is a file.
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
    """Refuse a run's folder that cannot be made or written, before loggers, which say less of it, begin.

    Raises:
        CannotWrite: it is such a one.
    """
    if first_process():
        require_place(folder / "run.json")


def checkpoints(folder: Path, model: LightningModule, callbacks: Sequence[Callback] = ()) -> list[Callback]:
    """`last.ckpt` after every epoch or validation, also when training is interrupted, and `best.ckpt`.

    Beside checkpoints that a user keeps, ours stay; but for best.ckpt where the user's own writes it.

    Args:
        folder: of the run.
        model: says what is best, by `monitor` and `monitor_mode`.
        callbacks: the user's.
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


def progress_bar(sampling: bool = False) -> ProgressBar:
    """A bar on a terminal, now and then a line elsewhere; for sampling it counts denoising steps."""
    if sampling:
        return SamplingProgress()
    return RichProgressBar() if sys.stdout.isatty() else ProgressLines()


class ProgressLines(ProgressBar):
    """Progress for logs: a line every `seconds`, with what is left of that work, reckoned from its second step on.

    What the first step waits for, such as data that are read and weights that are packed, no other waits for.

    Args:
        seconds: at least so much time between two lines.
    """

    begun: dict[str, tuple[float, int]]
    """By what is done: when its first step ended, and how many were done then."""

    def __init__(self, seconds: float = 30.0) -> None:
        super().__init__()
        self.seconds = seconds
        self._start()

    def disable(self) -> None:
        self.seconds = float("inf")

    def _start(self, *_: Any, **__: Any) -> None:
        self.said, self.begun = time.monotonic(), {}

    on_test_start = on_predict_start = _start

    def tell(self, what: str, done: int, total: float, more: str = "") -> None:
        """Print a line if it is time."""
        now = time.monotonic()
        if done:
            self.begun.setdefault(what, (now, done))
        if now - self.said < self.seconds or not done:
            return
        self.said, left = now, ""
        begun, first = self.begun[what]
        if done > first and total != float("inf"):
            left = f", {clock((now - begun) * (total - done) / (done - first))} left"
        self.say(f"{what} {done}/{total:g}{left}{more}")

    def say(self, line: str) -> None:
        """Print a line."""
        try:
            print(line, flush=True)
        except BrokenPipeError:
            if not output_closed():
                raise
            self.disable()  # nobody reads on, and the run is worth more than its lines

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._start()
        self.first = trainer.global_step

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        total = float(trainer.estimated_stepping_batches) - self.first
        numbers = {key: value for key, value in self.get_metrics(trainer, pl_module).items() if key != "v_num"}
        more = "".join(f", {key} {value:.4g}" for key, value in numbers.items() if isinstance(value, float))
        self.tell("train: step", trainer.global_step - self.first, total, more)

    def on_test_batch_end(self, trainer: Trainer, pl_module: LightningModule, *args: Any) -> None:
        self.tell("test: batch", args[2] + 1, float(sum(trainer.num_test_batches)))

    def on_predict_batch_end(self, trainer: Trainer, pl_module: LightningModule, *args: Any) -> None:
        self.tell("predict: batch", args[2] + 1, float(sum(trainer.num_predict_batches)))


class SamplingProgress(ProgressBar):
    """Progress of `test` and `predict` in denoising steps, and of what `test` measures then, beside baselines.

    One batch of scenes can take minutes with either. What baselines learn from is read first, which takes seconds.
    """

    def __init__(self) -> None:
        super().__init__()
        self.enabled = True
        self.bar: Progress | None = None
        self.reads: TaskID | None = None
        self.measures: TaskID | None = None
        self.lines = ProgressLines()

    def disable(self) -> None:
        self.enabled = False

    def _begin(self, what: str, batches: float, trainer: Trainer, model: Any) -> None:
        data = trainer.datamodule  # type: ignore[attr-defined]
        plan = model.schedule(data.test.context_frames, data.test.horizon_frames)
        self.what, self.batches, self.done, self.total = what, int(batches), 0, int(batches) * plan.evaluations
        self.measured, self.measures = 0, None
        model.progress, model.measuring = self._advance, self._measured
        self.lines._start()
        reads = f"{what}: reading training windows" if what == "test" and model.baselines else ""
        if self.enabled and trainer.is_global_zero and sys.stdout.isatty():
            columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
            self.bar = Progress(*columns)
            self.bar.start()
            self.reads = self.bar.add_task(reads, total=None) if reads else None
            self.task = self.bar.add_task(f"{what}: denoising steps", total=self.total)
        elif self.enabled and reads:
            self.lines.say(reads)

    def _advance(self, steps: int) -> None:
        self.done += steps
        if self.bar is not None:
            self._have_read(self.bar)
            self.bar.advance(self.task, steps)
        elif self.enabled:
            self.lines.tell(f"{self.what}: denoising step", self.done, self.total)

    def _measured(self, each: int) -> None:
        """each: answers and rows of a batch"""
        self.measured += 1
        what, total = f"{self.what}: measuring", self.batches * each
        if self.bar is not None:
            self._have_read(self.bar)
            if self.measures is None:
                self.measures = self.bar.add_task(what, total=total)
            self.bar.advance(self.measures)
        elif self.enabled:
            self.lines.tell(what, self.measured, total)

    def _have_read(self, bar: Progress) -> None:
        if self.reads is not None:
            bar.update(self.reads, total=1, completed=1)
            self.reads = None

    def _end(self, *_: Any, **__: Any) -> None:
        if self.bar is not None:
            self.bar.stop()
            self.bar = None

    on_test_end = on_predict_end = on_exception = _end

    def on_test_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._begin("test", sum(trainer.num_test_batches), trainer, pl_module)

    def on_predict_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._begin("predict", sum(trainer.num_predict_batches), trainer, pl_module)


def clock(seconds: float) -> str:
    """Seconds as h:mm:ss."""
    minutes, second = divmod(round(seconds), 60)
    hour, minute = divmod(minutes, 60)
    return f"{hour}:{minute:02}:{second:02}"
