"""How far a run is: bars on a terminal, elsewhere a line now and then; sampling is counted in denoising steps."""

from __future__ import annotations

import math
import sys
import time
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import ProgressBar, RichProgressBar
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from magnet.cli.pipes import output_closed

LOOKS = 2.0
"""Seconds between two looks at a loss that a GPU is waited for."""


def progress_bar(sampling: bool = False) -> ProgressBar:
    """A bar on a terminal, now and then a line elsewhere; for sampling it counts denoising steps."""
    if sampling:
        return SamplingProgress()
    return Bars() if sys.stdout.isatty() else ProgressLines()


def clock(seconds: float) -> str:
    """Seconds as h:mm:ss."""
    minutes, second = divmod(round(seconds), 60)
    hour, minute = divmod(minutes, 60)
    return f"{hour}:{minute:02}:{second:02}"


class ShowsLoss(ProgressBar):
    """Shows the loss of a training on a GPU too, for which it is waited for only now and then."""

    looked, loss = -math.inf, math.nan

    def get_metrics(
        self, trainer: Trainer, pl_module: LightningModule
    ) -> dict[str, int | str | float | dict[str, float]]:
        """What Lightning shows, and the loss."""
        shown = super().get_metrics(trainer, pl_module)
        loss = None if "loss" in shown else trainer.callback_metrics.get("loss")
        if loss is None:
            return shown
        if (now := time.monotonic()) >= self.looked + LOOKS:
            self.looked, self.loss = now, float(loss)
        return {**shown, "loss": self.loss}


class Bars(ShowsLoss, RichProgressBar):
    """Lightning's bars."""


class ProgressLines(ShowsLoss):
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
        self.start()

    def disable(self) -> None:
        self.seconds = float("inf")

    def start(self, *_: Any, **__: Any) -> None:
        """Begin with other work."""
        self.said, self.begun = time.monotonic(), {}

    on_test_start = on_predict_start = start

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
        self.start()
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
        self.tasks: dict[str, TaskID] = {}
        self.lines = ProgressLines()

    def disable(self) -> None:
        self.enabled = False

    def _begin(self, what: str, batches: float, trainer: Trainer, model: Any) -> None:
        data = trainer.datamodule  # type: ignore[attr-defined]
        plan = model.schedule(data.test.context_frames, data.test.horizon_frames)
        self.what, self.batches, self.done, self.total = what, int(batches), 0, int(batches) * plan.evaluations
        self.measured = 0
        model.progress, model.measuring = self._advance, self._measured
        self.lines.start()
        reads = f"{what}: reading training windows" if what == "test" and model.baselines else ""
        if self.enabled and trainer.is_global_zero and sys.stdout.isatty():
            columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
            self.bar = Progress(*columns)
            self.bar.start()
            self.reads = self.bar.add_task(reads, total=None) if reads else None
            self.tasks = {f"{what}: denoising step": self.bar.add_task(f"{what}: denoising steps", total=self.total)}
        elif self.enabled and reads:
            self.lines.say(reads)

    def _advance(self, steps: int) -> None:
        self.done += steps
        self._tell(f"{self.what}: denoising step", self.done, self.total)

    def _measured(self, each: int) -> None:
        """each: answers and rows of a batch"""
        self.measured += 1
        self._tell(f"{self.what}: measuring", self.measured, self.batches * each)

    def _tell(self, what: str, done: int, total: int) -> None:
        """Move the bar of what is done, or print a line if it is time."""
        if self.bar is None:
            if self.enabled:
                self.lines.tell(what, done, total)
            return
        if self.reads is not None:  # what is read is read before anything else is done
            self.bar.update(self.reads, total=1, completed=1)
            self.reads = None
        if what not in self.tasks:
            self.tasks[what] = self.bar.add_task(what, total=total)
        self.bar.update(self.tasks[what], completed=done)

    def _end(self, *_: Any, **__: Any) -> None:
        if self.bar is not None:
            self.bar.stop()
            self.bar = None

    on_test_end = on_predict_end = on_exception = _end

    def on_test_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._begin("test", sum(trainer.num_test_batches), trainer, pl_module)

    def on_predict_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._begin("predict", sum(trainer.num_predict_batches), trainer, pl_module)
