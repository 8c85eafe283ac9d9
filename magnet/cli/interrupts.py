"""Ctrl+C, SIGTERM or SLURM's signal in a training: what it asks for is done after the step, by all processes."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from types import FrameType
from typing import Any

import torch
from lightning.fabric.plugins.environments import SLURMEnvironment
from lightning.pytorch import Callback, LightningModule, Trainer

from magnet.cli.run_folder import LastCheckpoint

INTERRUPTED, TERMINATED = 130, 143
"""Exit codes of a training that Ctrl+C or SIGTERM ended, as shells count them."""
CODES = {signal.SIGINT: INTERRUPTED, signal.SIGTERM: TERMINATED}
STOPPING = (
    "stopping after this step, and a validation if one is due or runs; Ctrl+C again stops at once, which loses the step"
)
TWICE = 2.0
"""Seconds in which a second Ctrl+C is the first one again: torchrun passes on to its processes what they have got."""


class EndOfStep(Callback):
    """While steps are made, lets the first SIGINT or SIGTERM end the training after the step: no batch is lost by it.

    Of a step of several batches (`accumulate_grad_batches`) the rest is done, for a checkpoint holds no gradients.
    A validation that is due after the step, or runs, is finished, too: a training that goes on would not repeat it.
    Whoever says SIGTERM may not wait for it, so that a checkpoint is written first; a second SIGTERM cuts it short.
    Of several processes any may be told, each in another step: after each step they agree, and end after the same one.
    SLURM's signal that time is up waits for the end of the step, too: Lightning's answer to it, a checkpoint and the
    request to be started again, would lose the batch, and several processes in a step would wait for each other.
    """

    def __init__(self) -> None:
        self.asked = 0  # the signal that this process has got
        self.agreed = 0  # the signal that all know of
        self.time_is_up = 0  # SLURM's signal, which Lightning has not answered yet
        self.since = 0.0
        self.before: dict[int, Any] = {}
        self.steps = self.said = False
        self.step: int | None = None  # the optimizer's, before the batches that it has not seen yet

    @property
    def code(self) -> int:
        """Exit code of a training that was ended after a step."""
        return CODES.get(self.agreed or self.asked, TERMINATED)  # type: ignore[call-overload]

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.steps = True
        if threading.current_thread() is not threading.main_thread():
            return
        process = os.getpid()

        def ask(number: int, frame: FrameType | None) -> None:
            if os.getpid() != process:  # of a process that reads data, which this one ends
                return
            again, self.asked = bool(self.asked), self.asked or number
            if again:
                return self._again(trainer, number, frame)
            self.since = time.monotonic()
            self._say(trainer, number)

        handlers: dict[int, Any] = dict.fromkeys(CODES, ask)
        slurm = trainer._accelerator_connector.cluster_environment
        if isinstance(slurm, SLURMEnvironment) and slurm.auto_requeue and slurm.requeue_signal:
            handlers[slurm.requeue_signal] = self._later
        for number, handler in handlers.items():
            if callable(before := signal.getsignal(number)):
                self.before[number] = before
                signal.signal(number, handler)

    def _later(self, number: int, frame: FrameType | None) -> None:
        self.time_is_up = number

    def _say(self, trainer: Trainer, number: int) -> None:
        """Tell once what happens now to whoever has pressed Ctrl+C."""
        if number == signal.SIGINT and trainer.is_global_zero and not self.said:
            self.said = True
            with contextlib.suppress(RuntimeError, OSError):  # what is being printed now cannot be interrupted
                print(STOPPING, file=sys.stderr, flush=True)

    def _again(self, trainer: Trainer, number: int, frame: FrameType | None) -> None:
        """The second signal."""
        several = trainer.world_size > 1
        if number == signal.SIGTERM:
            if not several:  # several would cut it short in different places, and wait for each other
                _end(trainer)
        elif not several or time.monotonic() - self.since > TWICE:
            before = self.before[number]
            self._leave()
            before(number, frame)

    def _agree(self, trainer: Trainer) -> None:
        """Hear what any of the processes was told; the training ends where one was."""
        told, up = self.asked, self.time_is_up
        if trainer.world_size > 1:
            any_told = torch.tensor([told, up], device=trainer.strategy.root_device)
            torch.distributed.all_reduce(any_told, torch.distributed.ReduceOp.MAX)
            told, up = any_told.tolist()
        if up:
            self.time_is_up = 0
            self.before[up](up, None)
        self.agreed = told
        if told:
            self._say(trainer, told)
            _end(trainer)

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        if self.step is None:
            self.step = trainer.global_step

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        if trainer.accumulate_grad_batches == 1 or trainer.global_step != self.step:
            self.step = None
            self._agree(trainer)

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self.steps and self.agreed:
            _end(trainer, False)
            if self.agreed == signal.SIGTERM:
                _save(trainer)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self.steps and self.step is None:
            self._agree(trainer)

    def _leave(self, *_: Any, **__: Any) -> None:
        for number, before in self.before.items():
            signal.signal(number, before)
        self.before = {}
        self.steps = False

    on_train_end = on_exception = _leave


def _save(trainer: Trainer) -> None:
    for each in trainer.checkpoint_callbacks:
        if isinstance(each, LastCheckpoint):
            each.save(trainer)


def _end(trainer: Trainer, asked: bool = True) -> None:
    """Have Lightning's loops end as after SIGTERM, or not yet."""
    trainer._signal_connector.received_sigterm = asked
