"""Ctrl+C in a training: the first one ends it after the step that it is in, as SIGTERM does; the second one at once."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from types import FrameType
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer

INTERRUPTED, TERMINATED = 130, 143
"""Exit codes of a training that Ctrl+C or SIGTERM ended, as shells count them."""
STOPPING = (
    "stopping after this step, and a validation if one is due or runs; Ctrl+C again stops at once, which loses the step"
)


class EndOfStep(Callback):
    """While steps are made in one process, lets the first SIGINT do what SIGTERM does: no batch is lost by it.

    A validation that is due after the step, or runs, is finished, too: a training that goes on would not repeat it.
    Several processes get Ctrl+C each for itself, in different steps, so that it stops them at once.
    """

    def __init__(self) -> None:
        self.asked = False
        self.before: Any = None

    @property
    def code(self) -> int:
        """Exit code of a training that was ended after a step."""
        return INTERRUPTED if self.asked else TERMINATED

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        before, process = signal.getsignal(signal.SIGINT), os.getpid()
        if not callable(before) or trainer.world_size > 1 or threading.current_thread() is not threading.main_thread():
            return

        def ask(number: int, frame: FrameType | None) -> None:
            if os.getpid() != process:  # of a process that reads data, which this one ends
                return
            self.asked = True
            self._leave()
            if not trainer.validating:
                _end(trainer)
            with contextlib.suppress(RuntimeError, OSError):  # what is being printed just now cannot be interrupted
                print(STOPPING, file=sys.stderr, flush=True)

        self.before = before
        signal.signal(signal.SIGINT, ask)

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self.asked:
            _end(trainer, False)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self.asked:
            _end(trainer)

    def _leave(self, *_: Any, **__: Any) -> None:
        if self.before is not None:
            signal.signal(signal.SIGINT, self.before)
            self.before = None

    on_train_end = on_exception = _leave


def _end(trainer: Trainer, asked: bool = True) -> None:
    """Have Lightning's loops end as after SIGTERM, or not yet."""
    trainer._signal_connector.received_sigterm = asked
