"""Muon for matrices and AdamW for everything else, as one optimizer."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn

from magnet.precision import quick_bf16

FASTEST = (3.4445, -4.7750, 2.0315)
"""Jordan's coefficients of the iteration, with which singular values come near 1 in five steps."""


class Float32Muon(torch.optim.Muon):
    """torch's Muon with its iteration in float32: torch's is in bfloat16, which a CPU without AVX-512 only emulates."""

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> Any:
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            for matrix in group["params"]:
                if matrix.grad is None:
                    continue
                state = self.state[matrix]
                if not state:
                    state["momentum_buffer"] = torch.zeros_like(matrix)
                mean = state["momentum_buffer"].lerp_(matrix.grad, 1 - group["momentum"])
                ahead = matrix.grad.lerp(mean, group["momentum"])
                matrix.mul_(1 - group["lr"] * group["weight_decay"])
                length = 0.2 * max(matrix.shape) ** 0.5  # as long as AdamW's steps are
                matrix.sub_(orthogonal(ahead), alpha=group["lr"] * length)
        return loss


def orthogonal(matrix: Tensor, steps: int = 5) -> Tensor:
    """The matrix with all singular values near 1, by the Newton-Schulz iteration of Jordan 2024. (m, n) -> (m, n)"""
    a, b, c = FASTEST
    wide = matrix.shape[0] <= matrix.shape[1]
    x = matrix if wide else matrix.T
    x = x / x.norm().clamp_min(1e-7)
    for _ in range(steps):
        gram = x @ x.T
        x = a * x + (b * gram + c * gram @ gram) @ x
    return x if wide else x.T


class MuonAdamW(torch.optim.Optimizer):
    """Steps of matrices are made orthogonal (Jordan 2024, Muon); vectors and single numbers step by AdamW.

    Steps of matrices are as long as AdamW's, times `faster` (Liu et al. 2025, Muon is scalable for LLM training, 2.2).

    Args:
        parameters: what is trained.
        lr: learning rate.
        weight_decay: of both.
        faster: how many times as far matrices step.
    """

    def __init__(
        self, parameters: Iterable[nn.Parameter], lr: float = 5e-4, weight_decay: float = 0.01, faster: float = 1.0
    ) -> None:
        trained = list(parameters)
        matrices = [parameter for parameter in trained if parameter.ndim == 2]
        others = [parameter for parameter in trained if parameter.ndim != 2]
        quick = all(quick_bf16(matrix.device) for matrix in matrices)
        self.muon = (torch.optim.Muon if quick else Float32Muon)(
            matrices, lr=faster * lr, weight_decay=weight_decay / faster, adjust_lr_fn="match_rms_adamw"
        )
        self.adamw = torch.optim.AdamW(others, lr=lr, weight_decay=weight_decay)
        super().__init__([*self.muon.param_groups, *self.adamw.param_groups], {})

    def step(self, closure: Callable[[], float] | None = None) -> Any:
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for optimizer, group in zip((self.muon, self.adamw), self.param_groups, strict=True):
            optimizer.state, optimizer.param_groups = self.state, [group]  # as loaded, and with the schedule's rates
            optimizer.step()
        return loss
