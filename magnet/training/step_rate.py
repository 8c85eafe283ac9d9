"""How long a training step takes, and how much of the machine it uses."""

from __future__ import annotations

import statistics
import time
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.utilities import rank_zero_info
from torch import nn

from magnet.motion.scene import Scene
from magnet.motion.tokens import TOKEN_FRAMES

WARM_UP = 3
"""Steps that are not counted: they compile, allocate and choose kernels."""


def matmul_rate(device: torch.device, dtype: torch.dtype = torch.bfloat16, repeats: int = 5) -> float:
    """Operations a second of a large square matrix product, the best of a few."""
    size = 8192 if device.type == "cuda" else 1024
    a, b = (torch.randn(size, size, device=device).to(dtype) for _ in range(2))
    best = float("inf")
    for _ in range(repeats + 1):
        begun = now(device)
        a @ b
        best = min(best, now(device) - begun)
    return 2 * size**3 / best


def step_operations(model: nn.Module, tokens: int) -> float:
    """Operations of forward and backward through trainable matrices: 6 for each of their numbers and each token."""
    return 6.0 * tokens * sum(p.numel() for p in model.parameters() if p.requires_grad and p.dim() > 1)


class StepRate(Callback):
    """Prints and logs the median time of a training step, and its share of what matrix products alone could do.

    The share counts the trainable matrices, forward and backward, over all slots; a low one says that the step waits
    for something else.

    Args:
        every: steps between two lines.
    """

    def __init__(self, every: int = 100) -> None:
        if every < 1:
            raise ValueError(f"every: got {every} steps, expected 1 or more")
        self.every = every
        self.times: list[float] = []
        self.rate = 0.0
        self._begun: float | None = None

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.rate = matmul_rate(pl_module.device)
        gpu, device = pl_module.device.type == "cuda", pl_module.device
        name = torch.cuda.get_device_name(device) if gpu else f"{torch.get_num_threads()} CPU threads"
        rank_zero_info(f"matrix products in bfloat16: {self.rate / 1e12:.2f} TFLOP/s on {name}")

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        self._begun = now(pl_module.device) if self.timed(trainer.global_step, trainer.max_steps) else None

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if self._begun is None:
            return
        self.times.append(now(pl_module.device) - self._begun)
        if trainer.global_step % self.every and trainer.global_step != trainer.max_steps:
            return
        seconds = statistics.median(self.times)
        share = step_operations(pl_module, tokens_of(batch)) / seconds / self.rate
        rank_zero_info(
            f"step {trainer.global_step}: {1000 * seconds:.1f} ms, {100 * share:.1f} % of the rate of matrix products"
        )
        pl_module.log_dict({"step_seconds": seconds, "matmul_share": share})
        self.times.clear()

    def timed(self, step: int, max_steps: int) -> bool:
        """Whether a step is: waiting for the device at every step would itself cost time, so only a few are."""
        ahead = self.every - step % self.every
        return step >= WARM_UP and (ahead <= 10 or 0 <= max_steps - step <= 10)


def tokens_of(batch: Any) -> int:
    """Tokens of a batch of scenes, free slots among them."""
    return batch.scenes * batch.agents * (batch.frames // TOKEN_FRAMES) if isinstance(batch, Scene) else 0


def now(device: torch.device) -> float:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()
