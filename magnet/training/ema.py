"""A moving average of the weights, which is what is validated and saved."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import WeightAveraging
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel


class Average(AveragedModel):
    """torch's average whose count of steps stays on the CPU: on a GPU it would be waited for, three times a step."""

    def __init__(self, copied: nn.Module, decay: float) -> None:
        nn.Module.__init__(self)  # torch's would copy the copy
        self.module, self.decay = copied, decay
        self.register_buffer("n_averaged", torch.zeros((), dtype=torch.long))

    @torch.no_grad()
    def update_parameters(self, model: nn.Module) -> None:
        done = float(self.n_averaged)
        decay = min(self.decay, (1 + done) / (10 + done)) if done else 0.0
        pairs = list(zip(self.module.parameters(), model.parameters(), strict=True))
        averaged: list[Tensor] = [own for own, _ in pairs if own.is_floating_point()]
        current: list[Tensor] = [its for _, its in pairs if its.is_floating_point()]
        torch._foreach_lerp_(averaged, current, 1 - decay)
        others = [pair for pair in pairs if not pair[0].is_floating_point()]
        for own, its in [*others, *zip(self.module.buffers(), model.buffers(), strict=True)]:
            own.copy_(its)
        self.n_averaged += 1


class WeightEMA(WeightAveraging):
    """Exponential moving average of the weights; checkpoints hold the averaged ones, and both to go on from.

    Lightning's own EMA multiplies and adds, which moves even frozen weights by rounding; this one leaves
    what does not change bit-identical, so the tokenizer inside a denoiser stays what it was.

    Args:
        decay: share of the average that is kept at each step; less in the first steps, when the average is young.
    """

    def __init__(self, decay: float = 0.999) -> None:
        if not 0 <= decay < 1:
            raise ValueError(f"decay: got {decay}, expected 0 to 1")

        super().__init__(use_buffers=False)
        self.decay = decay
        self._own: dict[str, Tensor] | None = None  # weights of a training that has ended, before the average took over

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        if stage == "fit":
            pl_module.setup(
                stage
            )  # Lightning sets callbacks up first, and a copy would lack what the model makes there
        super().setup(trainer, pl_module, stage)
        if self._average_model is not None:
            # The model is moved only later, and not every model says before where it will be.
            copied = self._average_model.module.to(trainer.strategy.root_device)
            self._average_model = Average(copied, self.decay)

    def _swap_models(self, pl_module: LightningModule) -> None:
        """Exchange the weights and their average.

        Lightning writes into `.data`, of which nobody is told who keeps something made of the weights: what is packed
        for sampling would stay that of other weights. So this and the next replace its own.
        """
        with torch.no_grad():
            for average, current in self._pairs(pl_module):
                held = average.clone()
                average.copy_(current)
                current.copy_(held)

    def _copy_average_to_current(self, pl_module: LightningModule) -> None:
        with torch.no_grad():
            for average, current in self._pairs(pl_module):
                current.copy_(average)

    def _pairs(self, pl_module: LightningModule) -> Iterator[tuple[Tensor, Tensor]]:
        """Parameters and buffers of the average, each beside the model's."""
        assert self._average_model is not None
        module = self._average_model.module
        yield from zip(module.parameters(), pl_module.parameters(), strict=True)
        yield from zip(module.buffers(), pl_module.buffers(), strict=True)

    def on_sanity_check_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Before the first step the average is the model as it is now, with what it has learnt of its data since."""
        if self._average_model is not None and not int(self._average_model.n_averaged):
            with torch.no_grad():
                for average, current in self._pairs(pl_module):
                    average.copy_(current)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._own = None
        super().on_train_start(trainer, pl_module)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._own = {name: value.clone() for name, value in pl_module.state_dict().items()}
        super().on_train_end(trainer, pl_module)

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        super().on_save_checkpoint(trainer, pl_module, checkpoint)
        if self._own is not None and "current_model_state" in checkpoint:
            checkpoint["current_model_state"] = self._own
