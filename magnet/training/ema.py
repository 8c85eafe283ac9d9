"""A moving average of the weights, which is what is validated and saved."""

from __future__ import annotations

from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import WeightAveraging
from torch import Tensor
from torch.optim.swa_utils import get_ema_multi_avg_fn


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

        def average(averaged: list[Tensor], current: list[Tensor], steps: Tensor | int) -> None:
            """All weights at once: on a GPU, one by one would wait for `steps` each time."""
            done = float(steps)
            get_ema_multi_avg_fn(min(decay, (1 + done) / (10 + done)))(averaged, current, steps)

        super().__init__(use_buffers=False, multi_avg_fn=average)
        self._own: dict[str, Tensor] | None = None  # weights of a training that has ended, before the average took over

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        if stage == "fit":
            pl_module.setup(
                stage
            )  # Lightning sets callbacks up first, and a copy would lack what the model makes there
        super().setup(trainer, pl_module, stage)

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
