"""Curves are numbered by the optimizer's steps, where a run goes on too."""

from __future__ import annotations

from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer


class StepNumbers(Callback):
    """Takes the number of steps that Lightning logs by from its count of the optimizer's steps.

    Lightning counts them twice. The count for loggers gains one where a run goes on from a checkpoint of an epoch's
    end. It must come before callbacks that log.
    """

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        if pl_module.automatic_optimization:  # otherwise a batch may have several steps
            trainer.fit_loop.epoch_loop._batches_that_stepped = trainer.global_step
