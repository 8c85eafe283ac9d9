"""What the denoiser is trained on (paper Eq. 9-11)."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional as F

from magnet.motion.frames import partners
from magnet.motion.tokens import TokenLayout, by_frame, pairwise_by_frame
from magnet.sampling.noise import alpha_bar

Weighting = Literal["uniform", "min_snr"]


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean over the elements that count, whatever the others hold; 0 where none does. mask broadcasts to values."""
    mask = mask.expand_as(values)
    return torch.where(mask, values, 0.0).sum() / mask.sum().clamp_min(1)


def snr_weights(levels: Tensor, most: float) -> Tensor:
    """Weight of a predicted clean number by its noise level: min(SNR, `most`), SNR = a / (1 - a) of a = `alpha_bar`.

    The min-SNR weighting for a network that predicts x0 (Hang et al. 2023, Efficient diffusion training via min-SNR
    weighting strategy, Sec. 3.4, with `most` 5): what noise has drowned cannot be told, and at SNR 0 counts nothing.
    levels (...) int -> (...)
    """
    signal = alpha_bar(levels)
    return (signal / (1 - signal).clamp_min(1e-12)).clamp_max(most)


def token_losses(
    clean: Tensor, truth: Tensor, layout: TokenLayout, there: Tensor, weights: Tensor | None = None
) -> dict[str, Tensor]:
    """Huber loss of each part of a token, each part averaged by itself (Eq. 9, 10).

    clean, truth (B, N, P, D) normalized; there (B, N, P, 1 + slots) bool, which groups speak of people
    who are there in valid frames; weights (B, N, P, 1 + slots) of each group's error, None: all 1. 512 latent numbers
    against 36 P transforms: one common mean would drown the transforms.
    """
    error = F.smooth_l1_loss(clean, truth, reduction="none")
    if weights is not None:
        error = error * layout.spread(weights)
    latent, steps, pairs = layout.unpack(error)
    losses = {
        "latent": masked_mean(latent, there[..., :1]),
        "step": masked_mean(steps.flatten(-2), there[..., :1]),
    }
    if layout.slots:
        losses["pairwise"] = masked_mean(pairs.flatten(-2), there[..., 1:, None])
    return losses


def consistency_losses(tokens: Tensor, layout: TokenLayout, there: Tensor) -> tuple[Tensor, Tensor]:
    """How far predicted pairwise transforms are from what the predicted steps make of them (Eq. 11).

    Per frame, across token borders, where it holds exactly on real motion. tokens (B, N, P, D) in real
    units; there as in `token_losses`. -> rotation (1 - cos of the angle), translation (Huber, metres).
    Transforms are turns about the vertical and ground shifts, so they are handled as unit complex
    numbers and ground vectors.
    """
    P = layout.agents
    _, steps, pairs = layout.unpack(tokens)
    turn, shift = _planar(by_frame(steps))  # (B, T, P, 2) each
    pair_turn, pair_shift = _planar(pairwise_by_frame(pairs))  # (B, T, P, P - 1, 2)
    partner = partners(P, tokens.device)
    own_turn, own_shift = turn[:, 1:, :, None], shift[:, 1:, :, None]
    other_turn, other_shift = turn[:, 1:, partner], shift[:, 1:, partner]
    before_turn, before_shift = pair_turn[:, :-1], pair_shift[:, :-1]
    # T' = inverse(dT_self) @ T @ dT_partner
    expected_turn = _multiply(_conjugate(own_turn), _multiply(before_turn, other_turn))
    moved = before_shift + _apply(before_turn, other_shift) - own_shift
    expected_shift = _apply(_conjugate(own_turn), moved)
    rotation = 1 - (expected_turn * pair_turn[:, 1:]).sum(-1)
    translation = F.smooth_l1_loss(expected_shift, pair_shift[:, 1:], reduction="none").sum(-1)
    frames = there[..., 1:].repeat_interleave(steps.shape[-2], dim=1)
    both = frames[:, 1:] & frames[:, :-1]
    return masked_mean(rotation, both), masked_mean(translation, both)


NEAR = 0.3
"""Metres that are added to a distance before an error is divided by it: nearer people's errors count alike."""

FINE_GROUND, FINE_YAW = 0.02, 0.05
"""Metres and radians below which an error of a pairwise transform counts by its square."""


def near_loss(clean: Tensor, truth: Tensor, layout: TokenLayout, there: Tensor, levels: Tensor) -> Tensor:
    """Error of pairwise transforms where centimetres near a partner count (ours).

    Metres over the ground, divided by `NEAR` + the recorded distance, and the same of radians; each weighted by the
    share of signal that was shown, for what noise has drowned is a matter of chance.

    clean, truth (B, N, P, D) in real units, there as in `token_losses`, levels (B, N, P, 1 + slots) of the groups -> ()
    """
    turn, shift = _planar(layout.unpack(clean)[2])  # (B, N, P, P - 1, 4, 2)
    true_turn, true_shift = _planar(layout.unpack(truth)[2])
    away = (shift - true_shift).square().sum(-1)
    apart = _multiply(_conjugate(true_turn), turn)
    angle = torch.atan2(apart[..., 1], apart[..., 0]).square()
    error = _soft_length(away, FINE_GROUND) + _soft_length(angle, FINE_YAW)
    signal = alpha_bar(levels[..., 1:])[..., None]
    return masked_mean(signal * error / (NEAR + true_shift.norm(dim=-1)), there[..., 1:, None])


def _soft_length(square: Tensor, fine: float) -> Tensor:
    """Length less a little, about quadratic below `fine`, from its square. (...) -> (...)"""
    return (square + fine**2).sqrt() - fine


def _planar(nine: Tensor) -> tuple[Tensor, Tensor]:
    """Unit (cos, sin) of the yaw and ground shift (x, z) of nine numbers. (..., 9) -> (..., 2) x 2"""
    turn = torch.stack([nine[..., 0], -nine[..., 2]], dim=-1)
    return F.normalize(turn, dim=-1, eps=1e-6), nine[..., [6, 8]]


def _multiply(a: Tensor, b: Tensor) -> Tensor:
    real = a[..., 0] * b[..., 0] - a[..., 1] * b[..., 1]
    return torch.stack([real, a[..., 0] * b[..., 1] + a[..., 1] * b[..., 0]], dim=-1)


def _conjugate(a: Tensor) -> Tensor:
    return torch.stack([a[..., 0], -a[..., 1]], dim=-1)


def _apply(turn: Tensor, shift: Tensor) -> Tensor:
    """Turn a ground vector (x, z) about the vertical."""
    cos, sin = turn.unbind(-1)
    x, z = shift.unbind(-1)
    return torch.stack([cos * x + sin * z, cos * z - sin * x], dim=-1)
