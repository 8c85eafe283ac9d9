"""Finite scalar quantization: each number of a code is rounded to one of a few levels; nothing is learned.

Mentzer et al. 2023, Finite scalar quantization: VQ-VAE made simple, Sec. 3.1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from magnet.precision import Float32
from magnet.tokenizer.base import Quantized
from magnet.tokenizer.quantizer import sum_over_processes

MARGIN = 1e-3
"""Share by which the range of numbers is wider than their levels, so that the outermost can be reached."""


class FSQ(Float32):
    """Rounds each number to one of L levels between -1 and 1, after a tanh that bounds it.

    There is no codebook, so no codes die and no commitment is needed: the loss's `commitment` is 0.

    Args:
        levels: how many values each of the C numbers of a code can have, at least 2.
    """

    unit_input = False
    num_quantizers = 1
    initialized = True
    waits = False
    half_range: Tensor  # (C,) how far a bounded number reaches to either side, in steps between levels
    offset: Tensor  # (C,) 0.5 where the number of levels is even
    shift: Tensor  # (C,) what a vector of 0 must be moved by to stay 0
    step: Tensor  # (C,) levels on either side of 0
    basis: Tensor  # (C,) int, place values of a code's index

    def __init__(self, levels: Sequence[int] = (8, 8, 8, 5, 5, 5)) -> None:
        super().__init__()
        self.levels = tuple(levels)
        self.dim, self.size = len(self.levels), math.prod(self.levels)
        self.frozen = False
        counts = torch.tensor(self.levels)
        half = (counts - 1) * (1 + MARGIN) / 2
        offset = torch.where(counts % 2 == 0, 0.5, 0.0)
        places = torch.cat([torch.ones(1, dtype=torch.long), counts.cumprod(0)[:-1]])
        parts = {
            "half_range": half,
            "offset": offset,
            "shift": torch.atanh(offset / half),
            "step": counts // 2,
            "basis": places,
        }
        for name, value in parts.items():
            self.register_buffer(name, value, persistent=False)

    def forward(
        self, vectors: Tensor, mask: Tensor | None = None, generator: torch.Generator | None = None
    ) -> Quantized:
        """Codes of vectors (..., C); gradients pass straight through the rounding. Nothing is drawn."""
        with torch.autocast(vectors.device.type, enabled=False):
            latents = self.continuous(vectors.float())
            codes = self.nearest(latents.detach())
            index = self.index_of(codes)
            if mask is not None:
                index = torch.where(mask, index, -1)
            counts = torch.bincount(index[index >= 0].flatten(), minlength=self.size).float()
            if self.training and not self.frozen:
                counts = sum_over_processes(counts)
            if latents.requires_grad:
                codes = latents + (codes - latents).detach()
            return Quantized(codes, index[..., None], latents.new_zeros(()), counts[None])

    def continuous(self, vectors: Tensor) -> Tensor:
        """Each number bounded to the range of its levels. (..., C) -> (..., C) in about -1 to 1"""
        bounded = torch.tanh(vectors.float() + self.shift) * self.half_range - self.offset
        return bounded / self.step

    @torch.no_grad()
    def nearest(self, latents: Tensor) -> Tensor:
        """Each number at its nearest level. (..., C) -> (..., C) float32"""
        low = -self.step.float()
        high = low + torch.tensor(self.levels, device=low.device) - 1
        rounded = (latents.float() * self.step).round()
        return torch.minimum(torch.maximum(rounded, low), high) / self.step

    def index_of(self, codes: Tensor) -> Tensor:
        """Number of each code, 0 to size - 1. (..., C) -> (...) int"""
        places = (codes * self.step + self.step).round().long()
        return (places * self.basis).sum(-1)

    def kmeans_init(self, vectors: Tensor, generator: torch.Generator | None = None) -> None:
        """There is nothing to start."""
