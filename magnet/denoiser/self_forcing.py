"""The past as the model itself would have made it, so that it learns to live on what it made (ours)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from magnet.denoiser.core import DenoiserCore
from magnet.denoiser.options import SelfForcing
from magnet.motion.frames import canonical_frame, from_9d, from_planar, pairwise, partners, project_se2
from magnet.motion.placement import place
from magnet.motion.resample import smoothstep
from magnet.motion.scene import Scene, concatenate
from magnet.motion.tokens import TOKEN_FRAMES, by_frame, transforms
from magnet.sampling.noise import LEVELS, add_noise, shifted
from magnet.waiting import may_look

MOST_NOISE, LEAST_NOISE = 0.75, 0.1
"""Between which of the even levels, as shares of K, a past is made noisy before the model restores it."""

DISPLACED_GROUND, DISPLACED_YAW = 0.1, 0.12
"""Standard deviations, in metres and radians, by which somebody stands off at first."""

FAR_GROUND, FAR_YAW, FAR_FRAMES = 1.2, 0.62, 30
"""The same of those who stand far off, as couples who leave each other do, and how many frames longer they take."""

RETURN_FRAMES = 30, 75
"""Fewest and most frames in which such people come back: slowly, for feet slide on the way."""


@dataclass(frozen=True, eq=False)
class MadePasts:
    """Scenes whose beginning the model has made, with a recording behind it; see `magnet.callbacks.RollOuts`.

    Attributes:
        scenes: (R, T) as long as training scenes.
        past: token steps that are made.
        share: of a batch's scenes that these replace.
    """

    scenes: Scene
    past: int
    share: float


def with_made_pasts(scene: Scene, made: MadePasts | None, generator: torch.Generator) -> tuple[Scene, Tensor | None]:
    """Replace some scenes of a batch. -> the batch, (B, N) bool which token steps the model has made, or None"""
    if made is None:
        return scene, None
    B, N, device = scene.scenes, scene.frames // TOKEN_FRAMES, generator.device
    replaced = torch.rand(B, generator=generator, device=device) < made.share
    chosen = torch.randint(made.scenes.scenes, (B,), generator=generator, device=device)
    both = concatenate([each.replace(names=()) for each in (scene, made.scenes)])  # names are the host's
    mixed = both.select(torch.where(replaced, B + chosen, torch.arange(B, device=device)))
    return mixed, replaced[:, None] & (torch.arange(N, device=device) < made.past)


@torch.no_grad()
def displaced_at_first(scene: Scene, share: float, generator: torch.Generator, far: float = 0.0) -> Scene:
    """Some scenes with everybody moved and turned, a little or far, up to a random frame, and eased back from there.

    What a model has made drifts: people stand where no recording has them, and the way back is in none. Poses stay as
    they are, so that where people are does not follow from them.

    Args:
        scene: (B, T) of P agents.
        share: of the scenes that are changed.
        generator: of all randomness.
        far: share of those in which people stand metres off.
    """
    if not share:
        return scene
    B, T, P = scene.T_world_root.shape[:3]
    device, dtype = scene.T_world_root.device, scene.T_world_root.dtype
    changed, begin, length = torch.rand(3, B, 1, generator=generator, device=device)
    begin = begin * T
    wide = torch.zeros_like(begin, dtype=torch.bool)
    if far:
        wide = torch.rand(B, 1, generator=generator, device=device) < far
    length = RETURN_FRAMES[0] + (RETURN_FRAMES[1] - RETURN_FRAMES[0]) * length + FAR_FRAMES * wide
    way = ((torch.arange(T, device=device) - begin) / length).clamp(0, 1)
    off = (1 - smoothstep(way)) * (changed < share)  # (B, T)
    drawn = torch.randn(B, 1, P, 3, generator=generator, device=device) * off[..., None, None]
    yaw = torch.where(wide[..., None], FAR_YAW, DISPLACED_YAW) * drawn[..., 0]
    ground = torch.where(wide[..., None, None], FAR_GROUND, DISPLACED_GROUND) * drawn[..., 1:]
    T_turn = from_planar(yaw, torch.zeros_like(ground)).to(dtype)
    T_world_root = scene.T_world_root.clone()
    T_world_root[..., :3, :3] = T_turn[..., :3, :3] @ T_world_root[..., :3, :3]
    T_world_root[..., :3:2, 3] += ground.to(dtype)
    return scene.replace(T_world_root=T_world_root)


def past_of(levels: Tensor, faint: int) -> Tensor:
    """Token steps clean, or at `faint` at most, from the first on to something noisier. levels (B, N, P) -> bool"""
    begun = levels.cummax(dim=1).values <= faint
    return begun & (levels.flip(1).cummax(dim=1).values.flip(1) > faint)


@torch.no_grad()
def with_self_forcing(
    model: DenoiserCore,
    truth: Tensor,
    levels: Tensor,
    scene: Scene,
    options: SelfForcing,
    generator: torch.Generator,
    cond: Tensor | None = None,
    faint: int = 0,
) -> Tensor:
    """Normalized tokens in which the clean pasts of some scenes are the model's own work; the rest is the truth.

    Noise is added to a past, the model restores it in one step, and it is rounded to codes and placed in the world, as
    finished tokens are in sampling. It is then a little blurred and calm. Recorded pairwise transforms keep people
    where they stood to each other, so that what follows, which is still the truth, does not begin with a jump.

    Args:
        model: whose work the pasts are.
        truth: (B, N, P, D) normalized.
        levels: (B, N, P) int, which say what a past is: `past_of`.
        scene: the same scenes, of P agents.
        options: the share of scenes, and how a past is placed.
        generator: of all randomness.
        cond: condition of the scenes.
        faint: highest level of a past that is shown a little noisy.

    Returns:
        (B, N, P, D).
    """
    layout, normalizer, past = model.layout, model.normalizer, past_of(levels, faint)
    few = _some(past, options.share, generator)
    if isinstance(few, Tensor) and not len(few):
        return truth
    past, T_world_can = past[few], canonical_frame(scene.T_world_root[few])
    drawn = torch.rand(len(past), 1, 1, generator=generator, device=levels.device)
    even = LEAST_NOISE + (MOST_NOISE - LEAST_NOISE) * drawn
    renoised = torch.where(past, shifted((even * LEVELS).long(), model.noise.shift), levels[few])
    noise = torch.randn(truth[few].shape, generator=generator, device=truth.device)
    noisy = add_noise(truth[few], noise, layout.spread(layout.group_levels(renoised)))
    restored = model.denoise(noisy, renoised, scene.present[few], None if cond is None else cond[few]).float()
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
        latent = model.tokenizer.requantize(latent) if model.quantized else latent
        made = normalizer.normalize(layout.pack(latent, *transforms(T_world_can)))
    moved = past[..., None]
    if layout.slots:  # a pairwise transform moves with either of its ends, where it is shown at all
        either = past[..., None] | past[..., partners(layout.agents, past.device)]
        moved = torch.cat([moved, either & (layout.group_levels(levels[few]) <= faint)[..., 1:]], dim=-1)
    shown = truth.clone()
    shown[few] = torch.where(layout.spread(moved), made, truth[few])
    return shown


def _some(past: Tensor, share: float, generator: torch.Generator) -> Tensor | slice:
    """A share of the scenes: chosen among those with a past, or off a CPU the first, some of which may have none."""
    if not may_look(past.device):
        return slice(max(round(share * len(past)), 1))
    selected = torch.rand(len(past), generator=generator, device=past.device) < share
    return (past.flatten(1).any(dim=1) & selected).nonzero()[:, 0]
