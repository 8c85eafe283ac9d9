"""z-score statistics of tokens, kept inside the checkpoint (paper A.4.1)."""

from __future__ import annotations

import torch
from torch import Tensor

from magnet.motion.tokens import STRIDE, TokenLayout
from magnet.precision import Float32


class Statistics(Float32):
    """Mean and standard deviation of each number of a token.

    Latents share one scale and no shift, so that a distance between codes stays a distance; the nine
    numbers of a step or of a relation are standardised one by one, pooled over the frames of a token
    and over partner slots, so that slots stay exchangeable.

    Args:
        layout: what a token holds.
        floor: smallest standard deviation; six of the nine numbers are nearly constant.
        pairwise_metres: metres that count as one over the ground in pairwise transforms; 0: their standard deviation.
    """

    mean: Tensor
    std: Tensor
    count: Tensor

    def __init__(self, layout: TokenLayout, floor: float = 1e-2, pairwise_metres: float = 0.0) -> None:
        super().__init__()
        self.layout = layout
        self.floor = floor
        self.pairwise_metres = pairwise_metres
        self.register_buffer("mean", torch.zeros(layout.width))
        self.register_buffer("std", torch.ones(layout.width))
        self.register_buffer("count", torch.zeros((), dtype=torch.long))

    @property
    def ready(self) -> bool:
        return bool(self.count > 0)

    def normalise(self, tokens: Tensor) -> Tensor:
        return (tokens - self.mean) / self.std

    def restore(self, tokens: Tensor) -> Tensor:
        """Inverse of `normalise`: tokens in real units."""
        return tokens * self.std + self.mean

    @torch.no_grad()
    def fit(self, tokens: Tensor, there: Tensor) -> None:
        """Set from real tokens. tokens (B, N, P, D) in real units, there (B, N, P, 1 + slots) bool"""
        latent, steps, relations = self.layout.unpack(tokens.double())
        own = there[..., 0]
        latent_scale = latent[own].square().mean().sqrt().clamp_min(1e-6)
        mean = [torch.zeros(self.layout.latent, device=tokens.device)]
        std = [latent_scale.expand(self.layout.latent)]
        for values, repeats in ((steps[own], 1), (relations[there[..., 1:]], self.layout.slots)):
            flat = values.reshape(-1, 9)
            known = len(flat) > 1
            one_mean = flat.mean(0) if known else torch.zeros(9, device=tokens.device)
            one_std = flat.std(0).clamp_min(self.floor) if known else torch.ones(9, device=tokens.device)
            mean.append(one_mean.repeat(STRIDE * repeats))
            std.append(one_std.repeat(STRIDE * repeats))
        self.mean.copy_(torch.cat(mean))
        self.std.copy_(torch.cat(std))
        self.set_pairwise_metres()
        self.count.fill_(int(own.sum()))

    def set_pairwise_metres(self) -> Tensor:
        """Put the wished scale in place of the measured one. -> how many times each number's deviation grew (D,)"""
        before = self.std.clone()
        if self.pairwise_metres:
            self.std[self.pairwise_ground()] = self.pairwise_metres
        return self.std / before

    def pairwise_ground(self) -> Tensor:
        """Which numbers of a token are ground positions of pairwise transforms. (D,) bool"""
        pairs = self.layout.groups(self.std.device) > 0
        place = torch.arange(self.layout.width, device=self.std.device) - self.layout.latent
        return pairs & ((place % 9 == 6) | (place % 9 == 8))
