"""Dropout whose random numbers cost a fifth: on a CPU they otherwise take longer than what they are multiplied with."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

DRAWS = 2**16
"""A number is dropped by one of so many equally likely draws, four of which are one random integer of 64 bits."""


class Dropout(nn.Module):
    """As `nn.Dropout`, with a share that is rounded to whole draws (0.05 to 0.050003), by which the rest is enlarged.

    Args:
        p: share of numbers that are dropped in training.
    """

    def __init__(self, p: float) -> None:
        super().__init__()
        self.p = p

    def forward(self, x: Tensor) -> Tensor:
        if not self.training or not self.p:
            return x
        dropped = round(self.p * DRAWS)
        if x.device.type != "cpu" or not 0 < dropped < DRAWS or torch.compiler.is_compiling():
            return F.dropout(x, self.p)
        draws = torch.empty(-(-math.prod(x.shape) // 4), dtype=torch.int64).random_(-(2**63), None)
        kept = draws.view(torch.int16)[: x.numel()] >= dropped - DRAWS // 2
        # As bytes, which are turned into numbers several times as fast as truth values are.
        return x * kept.view(torch.uint8).view(x.shape).to(x.dtype).mul_(DRAWS / (DRAWS - dropped))

    def extra_repr(self) -> str:
        return f"p={self.p}"
