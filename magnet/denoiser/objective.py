"""The loss of a training batch: what is shown noisy, what is predicted, and what each error costs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from magnet.denoiser.body_losses import BODY_LOSSES, decoded_losses
from magnet.denoiser.levels import draw_levels
from magnet.denoiser.losses import consistency_losses, near_loss, snr_weights, token_losses
from magnet.denoiser.self_forcing import with_self_forcing
from magnet.motion.scene import Scene
from magnet.sampling.noise import add_noise

if TYPE_CHECKING:
    from magnet.denoiser.module import Denoiser


def training_losses(model: Denoiser, scene: Scene, generator: torch.Generator) -> dict[str, Tensor]:
    """The weighted sum `loss` and its parts, unweighted; all noise comes from the generator (paper Eq. 9-11)."""
    h: Any = model.hparams
    layout = model.layout
    with torch.no_grad():
        tokens, there = model.tokenize(scene)
        truth = model.normalizer.normalize(tokens)
        B, N, P, _ = truth.shape
        levels = draw_levels(h.noise_levels, B, N, P, generator, h.level_shift)
        group_levels = layout.group_levels(levels)
        noise = torch.randn(truth.shape, generator=generator, device=truth.device)
        shown = truth
        if model.training and h.own_past:
            shown = with_self_forcing(model, truth, levels, scene.pad_agents(P), h.own_past, generator)
        noisy = add_noise(shown, noise, layout.spread(group_levels))
        weights = snr_weights(group_levels, h.snr_most) if h.weighting == "min_snr" else None
    clean = model.denoise(noisy, levels, scene.pad_agents(P).present).float()
    losses = token_losses(clean, truth, layout, there, weights)
    total = h.latent_weight * losses["latent"] + h.step_weight * losses["step"]
    if layout.slots:
        predicted = model.normalizer.denormalize(clean)
        rotation, translation = consistency_losses(predicted, layout, there)
        losses["consistency"] = rotation + translation
        ramp = min(1.0, (model.global_step + 1) / max(h.consistency_warmup, 1)) if model.training else 1.0
        total = total + h.pairwise_weight * losses["pairwise"] + ramp * h.consistency_weight * losses["consistency"]
        if h.near_weight:
            losses["near"] = near_loss(predicted, tokens, layout, there, group_levels)
            total = total + h.near_weight * losses["near"]
    if any(h[f"{name}_weight"] for name in BODY_LOSSES):
        bodies = decoded_losses(model, clean, tokens, levels, scene.pad_agents(P), there, model.require_body())
        total = total + sum(h[f"{name}_weight"] * value for name, value in bodies.items())
        losses |= bodies
    return {"loss": total, **losses}
