"""The past as the model itself would have made it, so that it learns to live on what it made (ours)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from magnet.denoiser.options import SelfForcing
from magnet.motion.frames import canonical_frame, from_9d, pairwise, partners, project_se2
from magnet.motion.placement import place
from magnet.motion.scene import Scene
from magnet.motion.tokens import TokenLayout, by_frame, transforms
from magnet.sampling.noise import LEVELS, add_noise, shifted
from magnet.tokenizer.normalizer import Normalizer

Denoise = Callable[[Tensor, Tensor, Tensor, Tensor | None], Tensor]
"""noisy (B, N, P, D), levels (B, N, P), present (B, P), condition (B, ...) -> clean (B, N, P, D), all normalized"""

MOST_NOISE, LEAST_NOISE = 0.75, 0.1
"""Between which of the even levels, as shares of K, a past is made noisy before the model restores it."""


@torch.no_grad()
def with_self_forcing(
    denoise: Denoise,
    requantize: Callable[[Tensor], Tensor] | None,
    normalizer: Normalizer,
    layout: TokenLayout,
    truth: Tensor,
    levels: Tensor,
    scene: Scene,
    options: SelfForcing,
    generator: torch.Generator,
    shift: float = 1.0,
    cond: Tensor | None = None,
) -> Tensor:
    """Normalized tokens in which the clean pasts of some scenes are the model's own work; the rest is the truth.

    Noise is added to a past, the model restores it in one step, and it is rounded to codes and placed in the world, as
    finished tokens are in sampling. It is then a little blurred and calm. Recorded pairwise transforms keep people
    where they stood to each other, so that what follows, which is still the truth, does not begin with a jump.

    Args:
        denoise: the model.
        requantize: latents to their nearest codes; None: they stay as they are.
        normalizer, layout: of the tokens.
        truth: (B, N, P, D) normalized.
        levels: (B, N, P) int; the past of an agent is what is clean before something that is not.
        scene: the same scenes, of P agents.
        options: the share of scenes, and how a past is placed.
        generator: of all randomness.
        shift: of the added noise, see `magnet.sampling.noise.shifted`.
        cond: condition of the scenes.

    Returns:
        (B, N, P, D).
    """
    clean = levels == 0
    past = clean & (levels.flip(1).cummax(dim=1).values.flip(1) > 0)
    selected = torch.rand(len(levels), generator=generator, device=levels.device) < options.share
    few = (past.flatten(1).any(dim=1) & selected).nonzero()[:, 0]
    if not len(few):
        return truth
    past, T_world_can = past[few], canonical_frame(scene.T_world_root[few])
    even = torch.rand(len(few), 1, 1, generator=generator, device=levels.device)
    even = LEAST_NOISE + (MOST_NOISE - LEAST_NOISE) * even
    renoised = torch.where(past, shifted((even * LEVELS).long(), shift), levels[few])
    noise = torch.randn(truth[few].shape, generator=generator, device=truth.device)
    noisy = add_noise(truth[few], noise, layout.spread(layout.group_levels(renoised)))
    restored = denoise(noisy, renoised, scene.present[few], None if cond is None else cond[few]).float()
    with torch.autocast(truth.device.type, enabled=False):
        latent, deltas, _ = layout.unpack(normalizer.denormalize(restored))
        own = by_frame(past[..., None, None].expand(*past.shape, deltas.shape[-2], 1))[..., 0]  # (b, T, P)
        T_prev_can = project_se2(from_9d(by_frame(deltas)))
        T_prev_can[:, 0] = torch.eye(4, device=truth.device)
        placed = place(
            T_prev_can,
            pairwise(T_world_can) if layout.slots else None,
            T_world_can[:, 0],
            options.placement,
            options.pairwise_weight,
            present=scene.present[few],
        )
        T_world_can = torch.where(own[..., None, None], placed, T_world_can)
        latent = latent if requantize is None else requantize(latent)
        made = normalizer.normalize(layout.pack(latent, *transforms(T_world_can)))
    moved = past[..., None]
    if layout.slots:  # a pairwise transform moves with either of its ends, where it is shown at all
        either = past[..., None] | past[..., partners(layout.agents, past.device)]
        moved = torch.cat([moved, either & (layout.group_levels(levels[few]) == 0)[..., 1:]], dim=-1)
    shown = truth.clone()
    shown[few] = torch.where(layout.spread(moved), made, truth[few])
    return shown
