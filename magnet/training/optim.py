"""The optimizer that both networks use (paper A.3)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable
from typing import Any

import torch
from lightning.pytorch import LightningModule
from torch import Tensor, nn

from magnet.training.duration import share_of_time
from magnet.training.muon import MuonAdamW
from magnet.training.options import OptimizerOptions
from magnet.waiting import may_look


def warmup_cosine(
    module: LightningModule, parameters: Iterable[nn.Parameter], options: OptimizerOptions
) -> dict[str, Any]:
    """AdamW, or Muon for matrices, whose rate rises over a warm-up and falls to zero on a cosine by the end of the run.

    The end is that of its steps or of its time (`max_time`), whichever comes first. In a run without an end the rate is
    constant after the warm-up.
    """
    lr, decay = options.learning_rate, options.weight_decay
    optimizer: torch.optim.Optimizer
    if options.muon:
        optimizer = MuonAdamW(parameters, lr, decay, options.muon)
    else:
        # Not fused: Lightning clips no gradients of a fused optimizer in mixed precision.
        optimizer = torch.optim.AdamW(parameters, lr, weight_decay=decay)
    total, warmup = module.trainer.estimated_stepping_batches, options.warmup_steps

    def rate(step: int) -> float:
        rise = min(1.0, (step + 1) / (warmup + 1))
        done = min(1.0, max(0.0, (step - warmup) / max(total - warmup, 1), share_of_time(module.trainer)))
        return rise * 0.5 * (1 + math.cos(math.pi * done))

    schedule = Rates(optimizer, rate)
    return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


class Trained(LightningModule):
    """What all trainings share: how one begins, and a learning rate that Lightning's `Tuner.lr_find` finds and sets."""

    optimizer: OptimizerOptions

    @property
    def learning_rate(self) -> float:
        """The highest of a training, `optimizer.learning_rate`."""
        return self.optimizer.learning_rate

    @learning_rate.setter
    def learning_rate(self, rate: float) -> None:
        self.optimizer = dataclasses.replace(self.optimizer, learning_rate=rate)
        self.hparams["optimizer"] = dataclasses.asdict(self.optimizer)

    def log_loss(self, loss: Tensor, **said: Any) -> None:
        """Log what a step is trained on; bars show it by themselves where nobody waits for a GPU to know it."""
        self.log("loss", loss.detach(), prog_bar=may_look(loss.device), sync_dist=True, **said)

    def begin(self) -> None:
        """Make ready what a first step needs, such as statistics of the data; called again, it changes nothing."""
        raise NotImplementedError(f"{type(self).__name__} must implement begin()")

    def on_fit_start(self) -> None:
        self.begin()

    def on_train_start(self) -> None:
        self.begin()  # a `Tuner` tries steps before `on_fit_start`


class Rates(torch.optim.lr_scheduler.LambdaLR):
    """Where a run goes on, its next step has this run's learning rate and weight decay, and the rate of its length.

    torch would take over the last run's options, whatever is asked for now. A run that had reached its end left a rate
    of zero, which torch changes only after a step.
    """

    def __init__(self, optimizer: torch.optim.Optimizer, rate: Callable[[int], float]) -> None:
        self.decays = [group["weight_decay"] for group in optimizer.param_groups]
        super().__init__(optimizer, rate)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        own = {"base_lrs": self.base_lrs, "decays": self.decays}
        super().load_state_dict({**state_dict, **own})
        groups = zip(self.optimizer.param_groups, self.base_lrs, self.decays, self.lr_lambdas, strict=True)
        for group, full, decay, rate in groups:
            group |= {"initial_lr": full, "lr": full * rate(self.last_epoch), "weight_decay": decay}
        self._last_lr = [group["lr"] for group in self.optimizer.param_groups]
