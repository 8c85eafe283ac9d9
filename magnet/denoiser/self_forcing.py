"""The past as the model itself would have made it, so that it learns to live on what it made (ours)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from magnet.motion.frames import canonical_frame, from_9d, pairwise, partners, place, project_se2
from magnet.motion.scene import Scene
from magnet.motion.tokens import by_frame, transforms
from magnet.sampling.noise import LEVELS, add_noise, shifted
from magnet.sampling.options import SamplerOptions

if TYPE_CHECKING:
    from magnet.denoiser.module import Denoiser

FAINTEST, CLEAREST = 0.75, 0.1
"""Between which of the even levels, as shares of K, a past is drowned in noise before the model restores it."""


@torch.no_grad()
def with_self_forcing(
    model: Denoiser, truth: Tensor, levels: Tensor, scene: Scene, share: float, generator: torch.Generator
) -> Tensor:
    """Normalised tokens in which some scenes' clean pasts are the model's own work, and all else is the truth.

    A past is drowned in noise, restored by the model in one step, snapped to codes and placed in the world, as
    finished tokens are when sampling: it is a little blurred and calm, and what follows it is still the truth.
    Pairwise transforms pull people to where they truly stood to each other, lest what follows begin with a jump.

    Args:
        model: the denoiser.
        truth: (B, N, P, D) normalized.
        levels: (B, N, P) int; the past of an agent is what is clean before something that is not.
        scene: the same scenes, of P agents.
        share: of the scenes that have a past.
        generator: source of all randomness.

    Returns:
        (B, N, P, D)
    """
    clean = levels == 0
    past = clean & (levels.flip(1).cummax(dim=1).values.flip(1) > 0)
    lucky = torch.rand(len(levels), generator=generator, device=levels.device) < share
    few = (past.flatten(1).any(dim=1) & lucky).nonzero()[:, 0]
    if not len(few):
        return truth
    layout, past, T_world_can = model.layout, past[few], canonical_frame(scene.T_world_root[few])
    even = CLEAREST + (FAINTEST - CLEAREST) * torch.rand(len(few), 1, 1, generator=generator, device=levels.device)
    drowned = torch.where(past, shifted((even * LEVELS).long(), model.hparams["level_shift"]), levels[few])
    noise = torch.randn(truth[few].shape, generator=generator, device=truth.device)
    noisy = add_noise(truth[few], noise, layout.spread(layout.group_levels(drowned)))
    restored = model.denoise(noisy, drowned, scene.present[few]).float()
    with torch.autocast(truth.device.type, enabled=False):
        latent, steps, _ = layout.unpack(model.normalizer.denormalize(restored))
        own = by_frame(past[..., None, None].expand(*past.shape, steps.shape[-2], 1))[..., 0]  # (b, T, P)
        T_prev_can = project_se2(from_9d(by_frame(steps)))
        T_prev_can[:, 0] = torch.eye(4, device=truth.device)
        placed = place(
            T_prev_can,
            pairwise(T_world_can) if layout.slots else None,
            T_world_can[:, 0],
            SamplerOptions.placement,
            SamplerOptions.pairwise_weight,
            present=scene.present[few],
        )
        T_world_can = torch.where(own[..., None, None], placed, T_world_can)
        latent = model.tokenizer.requantize(latent) if model.quantized else latent
        made = model.normalizer.normalize(layout.pack(latent, *transforms(T_world_can)))
    moved = past[..., None]
    if layout.slots:  # a pairwise transform moves with either of its ends, where it is shown at all
        either = past[..., None] | past[..., partners(layout.agents, past.device)]
        moved = torch.cat([moved, either & (layout.group_levels(levels[few]) == 0)[..., 1:]], dim=-1)
    shown = truth.clone()
    shown[few] = torch.where(layout.spread(moved), made, truth[few])
    return shown
