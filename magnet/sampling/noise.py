"""How noise is added and taken away, with a level of its own on every token (paper 3.2, A.3)."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

LEVELS = 1000
"""K: level 0 is clean, level K is pure noise."""

OFFSET = 0.008


def alpha_bar(levels: Tensor, K: int = LEVELS) -> Tensor:
    """Share of the signal's variance left at a noise level: cosine schedule. (...) int in 0..K -> (...) float32

    The paper's formula is 0.99984 at level 0; divided by that, level 0 is clean bit for bit. Level K is
    exactly 0, so nothing of the truth survives in a token at level K.
    """
    return _shares(K, levels.device)[levels]


@functools.cache
def _shares(K: int, device: torch.device) -> Tensor:
    """`alpha_bar` of every level: looking it up is far cheaper than a cosine for every number of a token."""
    angle = (torch.arange(K + 1, dtype=torch.float64) / K + OFFSET) / (1 + OFFSET) * (math.pi / 2)
    share = (angle.cos() / angle[0].cos()) ** 2
    share[K] = 0.0
    return share.float().to(device)


def add_noise(clean: Tensor, noise: Tensor, levels: Tensor, K: int = LEVELS) -> Tensor:
    """Forward process, paper Eq. 7. clean, noise (..., D); levels (..., D) or broadcastable -> (..., D)"""
    alpha = alpha_bar(levels, K)
    return alpha.sqrt() * clean + (1 - alpha).sqrt() * noise


def ddim_step(noisy: Tensor, clean: Tensor, now: Tensor, after: Tensor, K: int = LEVELS) -> Tensor:
    """One deterministic DDIM step (eta 0) from levels `now` down to `after`, given the predicted clean value.

    Elements whose level stays come back bit-identical; those that reach level 0 become `clean` exactly.
    """
    a_now, a_after = alpha_bar(now, K), alpha_bar(after, K)
    # At level 0 there is no noise to extract; the clamp only guards a branch that `where` discards.
    noise = (noisy - a_now.sqrt() * clean) / (1 - a_now).clamp_min(1e-12).sqrt()
    moved = a_after.sqrt() * clean + (1 - a_after).sqrt() * noise
    return torch.where(now == after, noisy, torch.where(after == 0, clean, moved))


def ddim_levels(steps: int, K: int = LEVELS) -> Tensor:
    """The levels a token passes in `steps` denoising steps, from K down to 0. -> (S + 1,) int

    Raises:
        ValueError: fewer than one step, or more steps than levels.
    """
    if not 1 <= steps <= K:
        raise ValueError(f"denoising steps: got {steps}, expected 1 to {K}")
    return torch.tensor([K * (steps - s) // steps for s in range(steps + 1)])


@dataclass
class NoiseStream:
    """Noise of tokens in the order of time: row i is the same however many rows are drawn at a time.

    Args:
        shape: (B, P, D) of a row.
        generator: one for all B scenes; or one for each, and then a scene's noise does not depend on what else
            is in the batch. None: the global one.
        device: of the noise and of the generators.
        dtype: of the noise.

    Raises:
        ValueError: another number of generators than scenes.
    """

    shape: tuple[int, int, int]
    generator: torch.Generator | Sequence[torch.Generator] | None = None
    device: torch.device | str = "cpu"
    dtype: torch.dtype = torch.float32

    def __post_init__(self) -> None:
        if isinstance(self.generator, Sequence) and len(self.generator) != self.shape[0]:
            raise ValueError(f"got {len(self.generator)} generators for {self.shape[0]} scenes, expected one for each")

    def rows(self, count: int) -> tuple[Tensor, Tensor]:
        """The noise of the next `count` token steps, and their veil, which stands in where a view hides them.

        -> (B, count, P, D) each
        """
        B, P, D = self.shape
        both = torch.empty(2, B, count, P, D, device=self.device, dtype=self.dtype)
        for row in range(count):
            both[:, :, row] = self._row()
        return both[0], both[1]

    def _row(self) -> Tensor:
        """(2, B, P, D)"""
        B, P, D = self.shape
        if isinstance(self.generator, Sequence):
            each = [torch.randn(2, P, D, generator=g, device=self.device, dtype=self.dtype) for g in self.generator]
            return torch.stack(each, dim=1)
        return torch.randn(2, B, P, D, generator=self.generator, device=self.device, dtype=self.dtype)
