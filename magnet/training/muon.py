"""Muon for matrices and AdamW for everything else, as one optimizer."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import nn


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
        self.muon = torch.optim.Muon(
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
