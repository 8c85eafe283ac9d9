"""From a recorded beginning to a whole scene: tokens in, the sampling loop, bodies out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from magnet.denoiser.canvas import Canvas, Health
from magnet.motion.frames import Placement, canonical_frame, canonical_steps, pairwise, to_9d
from magnet.motion.scene import Scene, absent
from magnet.motion.tokens import STRIDE, by_token, relations_by_token
from magnet.sampling.guidance import Guidance
from magnet.sampling.sampler import sample
from magnet.sampling.schedule import Grid

if TYPE_CHECKING:
    from magnet.denoiser.module import Denoiser
    from magnet.tasks.base import Task


@dataclass(frozen=True)
class SamplerOptions:
    """How scenes are sampled.

    Args:
        steps: denoising steps S, paper A.3.
        stride: token steps finished before the window moves on; the reference keeps 12 of 16.
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
    placement: Placement = "fuse"
    trust: float = 0.003
    requantise: bool = True
    paste: bool = True
    blend: int = 10
    guidance: Guidance = field(default_factory=Guidance)


def generate(
    model: Denoiser,
    scene: Scene,
    task: Task,
    context: int,
    frames: int,
    samples: int = 1,
    options: SamplerOptions | None = None,
    generator: torch.Generator | None = None,
    progress: Callable[[int], None] | None = None,
    health: Health | None = None,
) -> Scene:
    """Sample a task.

    Args:
        model: the trained denoiser.
        scene: B recordings; only what the task's schedule calls known is read.
        task: plans what is known and what is generated.
        context: frames recorded of everybody, a multiple of 4.
        frames: frames after the context.
        samples: scenes drawn for each recording; sample s of scene b is at b * samples + s.
        options: how to sample.
        generator: source of randomness, on the model's device.
        progress: told 1 after each denoising step.
        health: filled with how well the sampled tokens hang together.

    Returns:
        Scene of B * samples, context + frames frames, the given frames included.

    Raises:
        ValueError: context is not a whole number of tokens, or the scene's slots do not fit the model.
    """
    options = options or SamplerOptions()
    if context % STRIDE:
        raise ValueError(f"context of {context} frames is not a multiple of {STRIDE}: cut the scene to whole tokens")
    if scene.agents > model.layout.agents:
        raise ValueError(f"the scene has {scene.agents} agents, the model was built for {model.layout.agents}")
    tokens = -(-(context + frames) // STRIDE)
    grid = Grid(tokens, model.layout.agents, context // STRIDE, options.steps, model.window, options.stride)
    schedule = task.schedule(grid)
    scene = scene.to(model.device).pad_agents(model.layout.agents)
    given = scrub(scene, schedule.known)
    # The paper read literally: a known token holds its relations to everybody, also to those not known. It leaks.
    related = given
    if model.layout.relation_noise == "token":
        recorded = torch.zeros_like(schedule.known)
        recorded[: scene.frames // STRIDE] = True
        related = scrub(scene, recorded)
    kind = model.device.type
    dtype, enabled = torch.get_autocast_dtype(kind), torch.is_autocast_enabled(kind)

    def denoise(noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
        with torch.autocast(kind, dtype, enabled):
            return model.denoise(noisy, levels, present).float()

    with torch.autocast(kind, enabled=False):  # only the network may run in half precision, never the geometry
        canvas = Canvas(model, given, schedule, options, samples, health)
        packed = sample(
            denoise,
            schedule,
            known_tokens(model, given, schedule.known, related).repeat_interleave(samples, dim=0),
            canvas.given.present,
            model.layout,
            generator=generator,
            settle=canvas.settle,
            progress=progress,
            guidance=options.guidance,
        )
        return canvas.scene(packed).cut(0, context + frames)


def scrub(scene: Scene, known: Tensor) -> Scene:
    """The scene as far as it is known: everything else is gone, so that nothing can leak. known (N, P) bool

    Unknown frames hold a body at rest at the origin; missing frames are added, surplus ones cut.
    """
    T = known.shape[0] * STRIDE
    keep = known.repeat_interleave(STRIDE, dim=0).to(scene.device)  # (T, P)
    recorded = min(T, scene.frames)
    if bool(keep[recorded:].any()):
        raise ValueError(f"the task needs {int(keep.any(1).nonzero()[-1]) + 1} frames, the scene has {scene.frames}")
    blank = absent(scene.scenes, T, scene.agents, scene.T_world_root)
    keep = keep[:recorded, :, None, None] & scene.present[:, None, :, None, None]
    body_rot, T_world_root = blank.body_rot.clone(), blank.T_world_root.clone()
    body_rot[:, :recorded] = torch.where(keep[..., None], scene.body_rot[:, :recorded], body_rot[:, :recorded])
    T_world_root[:, :recorded] = torch.where(keep, scene.T_world_root[:, :recorded], T_world_root[:, :recorded])
    return scene.replace(body_rot=body_rot, T_world_root=T_world_root, valid=None)


def known_tokens(model: Denoiser, given: Scene, known: Tensor, related: Scene | None = None) -> Tensor:
    """Normalised tokens of what is known; other tokens hold nothing of use. known (N, P) -> (B, N, P, D)

    Each agent's unbroken stretches are encoded alone: an encoder that looks ahead must not see beyond
    them, and a step into a stretch from an unknown frame is the identity. Pairwise transforms are those of
    `related`, by default the same scene.
    """
    N, P = known.shape
    like = given.T_world_root
    latent = torch.zeros(given.scenes, N, P, model.layout.latent, device=like.device)
    steps = to_9d(torch.eye(4, device=like.device)).expand(given.scenes, N, P, STRIDE, 9).clone()
    for start, stop, agents in stretches(known):
        part = given.cut(start * STRIDE, stop * STRIDE).order(torch.tensor(agents, device=like.device))
        latent[:, start:stop, agents] = model.encode(part)
        T_world_can = canonical_frame(part.T_world_root)
        steps[:, start:stop, agents] = by_token(to_9d(canonical_steps(T_world_can)))
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
