"""Means and standard deviations by which tokens are normalized (paper A.4.1)."""

from __future__ import annotations

import torch
from torch import Tensor

from magnet.motion.tokens import TOKEN_FRAMES, TokenLayout
from magnet.tokenizer.normalizer import FLOOR


@torch.no_grad()
def token_statistics(
    layout: TokenLayout, tokens: Tensor, there: Tensor, pairwise_metres: float = 0.0, narrow: bool = False
) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation (D,) of each number of a token.

    Latents share one scale and have mean 0, so that a distance between codes stays a distance. Those of
    narrow codes, whose numbers say different things, are standardized one by one. The nine numbers of a
    delta or of a pairwise transform are standardized one by one. They are pooled over the frames of a token and over
    partner slots, so that slots stay exchangeable.

    Args:
        layout: of the tokens.
        tokens: (B, N, P, D) in real units.
        there: (B, N, P, 1 + slots) bool, which groups count.
        pairwise_metres: metres that count as one over the ground in pairwise transforms; 0: their standard deviation.
        narrow: whether latents are narrow codes, as `magnet.tokenizer.narrow` makes them.
    """
    latent, deltas, pairs = layout.unpack(tokens.double())
    own = there[..., 0]
    coded = latent[own]
    if narrow and len(coded) > 1:
        means, stds = [coded.mean(0)], [coded.std(0).clamp_min(1e-6)]
    else:
        means = [torch.zeros(layout.latent, device=tokens.device)]
        stds = [coded.square().mean().sqrt().clamp_min(1e-6).expand(layout.latent)]
    for values, repeats in ((deltas[own], 1), (pairs[there[..., 1:]], layout.slots)):
        flat = values.reshape(-1, 9)
        known = len(flat) > 1
        mean = flat.mean(0) if known else torch.zeros(9, device=tokens.device)
        std = flat.std(0).clamp_min(FLOOR) if known else torch.ones(9, device=tokens.device)
        means.append(mean.repeat(TOKEN_FRAMES * repeats))
        stds.append(std.repeat(TOKEN_FRAMES * repeats))
    return torch.cat(means), with_pairwise_metres(layout, torch.cat(stds), pairwise_metres)


def with_pairwise_metres(layout: TokenLayout, std: Tensor, metres: float) -> Tensor:
    """Standard deviations (D,) in which pairwise positions have that of `metres`; 0 changes nothing."""
    return torch.where(pairwise_ground(layout, std.device), metres, std) if metres else std


def pairwise_ground(layout: TokenLayout, device: torch.device | None = None) -> Tensor:
    """Which numbers of a token are ground positions of pairwise transforms. (D,) bool"""
    pairs = layout.groups(device) > 0
    place = torch.arange(layout.width, device=device) - layout.latent
    return pairs & ((place % 9 == 6) | (place % 9 == 8))
