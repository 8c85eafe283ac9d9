"""Bodies of all plans that are not causal: decoded chunk by chunk, once nothing around a chunk changes any more."""

from __future__ import annotations

import torch
from torch import Tensor

from magnet.denoiser.options import Sampling
from magnet.generation.blending import crossfade_given, freeze_after, smoothed_path
from magnet.generation.causal_bodies import World, decoded_frames
from magnet.generation.conditioning import receptive_field, require_finite
from magnet.generation.settling import settled_chunk
from magnet.motion.frames import posed
from magnet.motion.scene import Scene, concatenate
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.sampling.options import SamplerOptions, Settling


def chunk_bodies(world: World, tokens: Tensor, first: int, stop: int, before: Scene | None) -> Scene:
    """Bodies of token steps [first, stop), given frames blended in at their seams, corrected where asked for.

    `before`: the frame before them, where there is one, which agents that have ended stand still in. Poses depend on
    neighbouring token steps, through the decoder and the blending of seams.
    """
    options, known, model = world.options, world.known, world.model
    blend = -(-options.blend // TOKEN_FRAMES) if options.keep_given else 0
    # Later rows count only where something given there has a seam; `reference`, which rounds by its window, reads all.
    later = options.precision == "reference" or bool(known[stop : stop + blend].any())
    low, high = max(first - blend, 0), min(stop + blend * later, len(known))
    behind, ahead = receptive_field(model)
    near = slice(max(low - behind, 0), high + ahead)
    latent, deltas, _ = model.parts_of(tokens[:, near])
    frames = slice((low - near.start) * TOKEN_FRAMES, (high - near.start) * TOKEN_FRAMES)
    features = decoded_frames(world, latent, deltas, frames, near.start, latent.shape[1])
    given = world.given.slice(low * TOKEN_FRAMES, high * TOKEN_FRAMES)
    T_world_can = shown_path(world, low, high)
    made = posed(features, T_world_can, given)
    if options.keep_given:
        made = crossfade_given(made, given, T_world_can, world.rows_by_frame(known[low:high]), options.blend)
    made = made.slice((first - low) * TOKEN_FRAMES, (stop - low) * TOKEN_FRAMES)
    placed = world.placed[first:stop]
    require_finite(made, world.rows_by_frame(placed), options.guidance)
    if world.settle is not None:
        goes_on = placed.all(dim=0).to(tokens.device)
        seen = made.replace(present=made.present & goes_on)  # nobody makes way for whom nothing is known of
        fixed = world.rows_by_frame(known[first:stop])
        made = corrected_alike(world, seen, fixed).replace(present=made.present)
    return freeze_after(made, world.rows_by_frame(placed), before)


def settle_of_groups(said: SamplerOptions | None, best: Sampling, known: Tensor) -> Settling | None:
    """How scenes of three and more people are corrected; None: as couples are.

    Couples hold hands; three and more from nothing walk in circles, clap and part.

    Args:
        said: options before they are filled with what is best for the model.
        best: what is best for the model.
        known: (N, P) bool, which tokens are given.
    """
    if (said is not None and said.settle is not None) or bool(known.any()):
        return None
    return best.settle_groups or ("firm" if best.settle == "hold" else None)


def corrected_alike(world: World, scene: Scene, fixed: Tensor) -> Scene:
    """Bodies of a chunk corrected, scenes together that are corrected in the same way. fixed (T, P) bool"""
    before = world.chunk_corrections
    parts: list[Scene] = []
    order: list[int] = []
    for how in sorted(set(world.hows)):
        rows = [b for b, each in enumerate(world.hows) if each == how]
        few = scene if len(rows) == scene.scenes else scene.select(rows)
        part, before[how] = settled_chunk(few, fixed, how, before.get(how))
        parts.append(part)
        order += rows
    return parts[0] if len(parts) == 1 else concatenate(parts).select(torch.tensor(order).argsort().tolist())


def shown_path(world: World, first: int, stop: int) -> Tensor:
    """Canonical frames of token steps [first, stop) as they are shown. -> (B, 4 n, P, 4, 4)"""
    until = stop * TOKEN_FRAMES + 1
    T_world_can, frames = world.T_world_can[:, :until], slice(first * TOKEN_FRAMES, stop * TOKEN_FRAMES)
    if world.options.smooth_path:
        placed, known = (world.rows_by_frame(each)[:until] for each in (world.placed, world.known))
        T_world_can = smoothed_path(T_world_can, placed, known)
    return T_world_can[:, frames]
