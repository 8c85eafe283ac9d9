"""What the denoiser is trained on (paper Eq. 9-11)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from magnet.motion.frames import partners
from magnet.motion.planar import conjugate, multiply, rotate_by, unit_ground
from magnet.motion.tokens import TOKEN_FRAMES, TokenLayout, by_frame, pairwise_by_frame
from magnet.sampling.noise import alpha_bar
from magnet.tokenizer.losses import masked_mean


def snr_weights(levels: Tensor, gamma: float) -> Tensor:
    """Weight of a predicted clean number by its noise level: min(SNR, gamma), SNR = a / (1 - a) of a = `alpha_bar`.

    The min-SNR weighting for a network that predicts x0 (Hang et al. 2023, Efficient diffusion training via min-SNR
    weighting strategy, Sec. 3.4, with gamma 5): what noise hides cannot be told, and counts nothing at SNR 0.
    levels (...) int -> (...)
    """
    signal = alpha_bar(levels)
    return (signal / (1 - signal).clamp_min(1e-12)).clamp_max(gamma)


def token_losses(
    clean: Tensor,
    truth: Tensor,
    layout: TokenLayout,
    there: Tensor,
    weights: Tensor | None = None,
    huber: float = 1.0,
) -> dict[str, Tensor]:
    """Huber loss of each part of a token, each part averaged by itself (Eq. 9, 10).

    clean, truth (B, N, P, D) normalized; there (B, N, P, 1 + slots) bool, which groups speak of people
    who are there in valid frames; weights (B, N, P, 1 + slots) of each group's error, None: all 1; an error over
    `huber` counts by its length, others by their square. 512 latent numbers against 36 P transforms: in one common mean
    the transforms would hardly count.
    """
    error = F.huber_loss(clean, truth, reduction="none", delta=huber)
    if weights is not None:
        error = error * layout.spread(weights)
    latent, deltas, pairs = layout.unpack(error)
    losses = {"latent": masked_mean(latent, there[..., :1]), "delta": masked_mean(deltas.flatten(-2), there[..., :1])}
    if layout.slots:
        losses["pairwise"] = masked_mean(pairs.flatten(-2), there[..., 1:, None])
    return losses


def consistency_losses(tokens: Tensor, layout: TokenLayout, there: Tensor) -> tuple[Tensor, Tensor]:
    """How far predicted pairwise transforms are from what the predicted deltas make of them (Eq. 11).

    Per frame, across token borders, where it holds exactly on real motion. tokens (B, N, P, D) in real
    units; there as in `token_losses`. -> rotation (1 - cos of the angle), translation (Huber, metres).
    Transforms are turns about the vertical and ground shifts, so they are handled as unit complex
    numbers and ground vectors.
    """
    P = layout.agents
    _, deltas, pairs = layout.unpack(tokens)
    turn, shift = unit_ground(by_frame(deltas))  # (B, T, P, 2) each
    pair_turn, pair_shift = unit_ground(pairwise_by_frame(pairs))  # (B, T, P, P - 1, 2)
    partner = partners(P, tokens.device)
    own_turn, own_shift = turn[:, 1:, :, None], shift[:, 1:, :, None]
    other_turn, other_shift = turn[:, 1:, partner], shift[:, 1:, partner]
    before_turn, before_shift = pair_turn[:, :-1], pair_shift[:, :-1]
    # T' = inverse(dT_self) @ T @ dT_partner
    expected_turn = multiply(conjugate(own_turn), multiply(before_turn, other_turn))
    moved = before_shift + rotate_by(before_turn, other_shift) - own_shift
    expected_shift = rotate_by(conjugate(own_turn), moved)
    rotation = 1 - (expected_turn * pair_turn[:, 1:]).sum(-1)
    translation = F.smooth_l1_loss(expected_shift, pair_shift[:, 1:], reduction="none").sum(-1)
    frames = there[..., 1:].repeat_interleave(deltas.shape[-2], dim=1)
    both = frames[:, 1:] & frames[:, :-1]
    return masked_mean(rotation, both), masked_mean(translation, both)


NEAR = 0.3
"""Metres that are added to a distance before an error is divided by it: nearer people's errors count alike."""

FINE_GROUND, FINE_YAW = 0.02, 0.05
"""Metres and radians below which an error of a pairwise transform counts by its square."""


def near_loss(clean: Tensor, truth: Tensor, layout: TokenLayout, there: Tensor, levels: Tensor) -> Tensor:
    """Error of pairwise transforms where centimetres near a partner count (ours).

    Metres over the ground, divided by `NEAR` + the recorded distance, and the same of radians; each weighted by the
    share of signal that was shown, for what noise hides is a matter of chance.

    clean, truth (B, N, P, D) in real units, there as in `token_losses`, levels (B, N, P, 1 + slots) of the groups -> ()
    """
    turn, shift = unit_ground(layout.unpack(clean)[2])  # (B, N, P, P - 1, 4, 2)
    true_turn, true_shift = unit_ground(layout.unpack(truth)[2])
    away = (shift - true_shift).square().sum(-1)
    apart = multiply(conjugate(true_turn), turn)
    angle = torch.atan2(apart[..., 1], apart[..., 0]).square()
    error = _soft_length(away, FINE_GROUND) + _soft_length(angle, FINE_YAW)
    signal = alpha_bar(levels[..., 1:])[..., None]
    return masked_mean(signal * error / (NEAR + true_shift.norm(dim=-1)), there[..., 1:, None])


SHAKE_GROUND, SHAKE_YAW = 0.002, 0.01
"""Metres and radians a frame by which deltas of recordings change from one frame to the next, roughly."""


def shake_loss(clean: Tensor, truth: Tensor, layout: TokenLayout, there: Tensor, levels: Tensor) -> Tensor:
    """Error of how deltas change from frame to frame, also from token to token (ours).

    A millimetre of noise in a delta is little beside what deltas differ by, and makes people tremble: beside what they
    change by from frame to frame it is much. Huber loss in units of `SHAKE_GROUND` and `SHAKE_YAW`, weighted by the
    share of signal that was shown: where noise hides all, such a loss has its least for people who keep still.

    clean, truth (B, N, P, D) in real units, there as in `token_losses`, levels (B, N, P, 1 + slots) of the groups -> ()
    """
    turn, shift = unit_ground(by_frame(layout.unpack(clean)[1]))  # (B, T, P, 2) each
    true_turn, true_shift = unit_ground(by_frame(layout.unpack(truth)[1]))
    yaw = multiply(conjugate(true_turn), turn)[..., 1:]
    error = torch.cat([(shift - true_shift) / SHAKE_GROUND, yaw / SHAKE_YAW], dim=-1)[:, 1:]  # the first is arbitrary
    counts = there[..., 0].repeat_interleave(TOKEN_FRAMES, dim=1)[:, 1:]
    change = error[:, 1:] - error[:, :-1]
    huber = F.smooth_l1_loss(change, torch.zeros_like(change), reduction="none").mean(-1)
    signal = alpha_bar(levels[..., 0]).repeat_interleave(TOKEN_FRAMES, dim=1)[:, 2:]
    return masked_mean(signal * huber, counts[:, 1:] & counts[:, :-1])


def _soft_length(square: Tensor, fine: float) -> Tensor:
    """Length less a little, about quadratic below `fine`, from its square. (...) -> (...)"""
    return (square + fine**2).sqrt() - fine
