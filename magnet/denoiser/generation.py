"""What a sample starts from: the options of the sampler, and the tokens of what is given."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from magnet.motion.frames import Placement, canonical_frame, canonical_steps, pairwise, to_9d
from magnet.motion.scene import Scene, absent
from magnet.motion.tokens import STRIDE, by_token, relations_by_token
from magnet.sampling.guidance import Guidance
from magnet.tokenizer.module import Tokenizer

if TYPE_CHECKING:
    from magnet.denoiser.module import Denoiser


@dataclass(frozen=True)
class SamplerOptions:
    """How scenes are sampled.

    Args:
        steps: denoising steps S, paper A.3.
        stride: token steps finished before the window moves on; the reference keeps 12 of 16.
        rolling: denoising steps between a token and the next, which makes the plan lower-triangular: 4 keeps
            8 tokens half denoised. 0: the tokens of a stride are denoised together, as in the paper.
        placement: how predicted steps and pairwise transforms become world poses: `integrate` (the
            reference), `anchor`, or `fuse` (ours).
        trust: weight of a pairwise transform against a step in `fuse`; chosen on validation scenes
            (docs/results.md): steps are far surer than pairwise transforms, so a little is enough.
        requantise: snap generated latents to the nearest code before decoding, as the reference does.
        paste: put the given frames back in place of their lossy reconstruction, with the seams blended.
        blend: frames over which a seam fades out behind given frames, and in before them.
        guidance: motion history guidance (paper A.7), off by default.
    """

    steps: int = 30
    stride: int = 4
    rolling: int = 0
    placement: Placement = "fuse"
    trust: float = 0.003
    requantise: bool = True
    paste: bool = True
    blend: int = 10
    guidance: Guidance = field(default_factory=Guidance)


def reach(model: Denoiser) -> tuple[int, int]:
    """Tokens before and after that a code or a decoded frame can depend on: encoder and decoder look equally far."""
    return model.tokenizer.vqvae.decoder.reach if isinstance(model.tokenizer, Tokenizer) else (0, 0)


def scrub(scene: Scene, known: Tensor, first: int = 0, stop: int | None = None) -> Scene:
    """The scene as far as it is known: everything else is gone, so that nothing can leak. known (N, P) bool

    Unknown frames hold a body at rest at the origin; missing frames are added, surplus ones cut.

    Args:
        scene: the recordings.
        known: (N, P) bool, of the whole scene.
        first: token step at which to begin.
        stop: token step at which to end, which may lie beyond what `known` tells of; None: at the end of `known`.

    Raises:
        ValueError: something is known that was not recorded.
    """
    needed = int(known.any(dim=1).nonzero()[-1]) + 1 if bool(known.any()) else 0
    if needed * STRIDE > scene.frames:
        raise ValueError(f"the task needs {needed * STRIDE} frames, the scene has {scene.frames}")
    stop = len(known) if stop is None else stop
    part = scene.cut(first * STRIDE, min(stop, needed) * STRIDE)
    blank = absent(scene.scenes, (stop - first) * STRIDE, scene.agents, scene.T_world_root)
    keep = known[first : min(stop, needed)].repeat_interleave(STRIDE, dim=0).to(scene.device)  # (T, P)
    keep = keep[:, :, None, None] & scene.present[:, None, :, None, None]
    body_rot, T_world_root = blank.body_rot.clone(), blank.T_world_root.clone()
    recorded = part.frames
    body_rot[:, :recorded] = torch.where(keep[..., None], part.body_rot, body_rot[:, :recorded])
    T_world_root[:, :recorded] = torch.where(keep, part.T_world_root, T_world_root[:, :recorded])
    return scene.replace(body_rot=body_rot, T_world_root=T_world_root, valid=None)


def known_tokens(model: Denoiser, given: Scene, known: Tensor, related: Scene | None = None) -> Tensor:
    """Normalised tokens of what is known; other tokens hold nothing of use. known (N, P) -> (B, N, P, D)

    Each agent's unbroken stretches are encoded alone: an encoder that looks ahead must not see beyond
    them. Pairwise transforms are those of `related`, by default the same scene. A step into a stretch from an
    unknown frame cannot be known either; the stretch's own next step stands in for it, which leaves a smaller
    misfit at keyframes than standing still does. At the very beginning nobody has come from anywhere.
    """
    N, P = known.shape
    like = given.T_world_root
    latent = torch.zeros(given.scenes, N, P, model.layout.latent, device=like.device)
    steps = to_9d(torch.eye(4, device=like.device)).expand(given.scenes, N, P, STRIDE, 9).clone()
    for start, stop, agents in stretches(known):
        part = given.cut(start * STRIDE, stop * STRIDE).order(torch.tensor(agents, device=like.device))
        latent[:, start:stop, agents] = model.encode(part)
        own = by_token(to_9d(canonical_steps(canonical_frame(part.T_world_root))))
        if start > 0:
            own[:, 0, :, 0] = own[:, 0, :, 1]
        steps[:, start:stop, agents] = own
    relations = relations_by_token(to_9d(pairwise(canonical_frame((related or given).T_world_root))))
    return model.statistics.normalise(model.layout.pack(latent, steps, relations))


def stretches(known: Tensor) -> list[tuple[int, int, list[int]]]:
    """Unbroken known stretches as (start, stop, agents that share it). known (N, P) bool"""
    found: dict[tuple[int, int], list[int]] = {}
    edges = torch.nn.functional.pad(known.int(), (0, 0, 1, 1)).diff(dim=0)
    for agent in range(known.shape[1]):
        starts = (edges[:, agent] == 1).nonzero()[:, 0].tolist()
        stops = (edges[:, agent] == -1).nonzero()[:, 0].tolist()
        for span in zip(starts, stops, strict=True):
            found.setdefault(span, []).append(agent)
    return [(start, stop, agents) for (start, stop), agents in sorted(found.items())]
