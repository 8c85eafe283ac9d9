"""From a recorded beginning to a whole scene: tokens in, the sampling loop, bodies out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import roma
import torch
from torch import Tensor

from magnet.motion.frames import (
    Placement,
    canonical_frame,
    canonical_steps,
    from_9d,
    inverse,
    pairwise,
    partners,
    place,
    posed,
    project_se2,
    rigid,
    to_9d,
)
from magnet.motion.scene import Scene, absent
from magnet.motion.tokens import STRIDE, by_frame, by_token
from magnet.sampling.guidance import Guidance
from magnet.sampling.sampler import sample
from magnet.sampling.schedule import Grid, MaskSchedule

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
        trust: weight of a pairwise transform against a step in `fuse`.
        requantise: snap generated latents to the nearest code before decoding, as the reference does.
        paste: put the given frames back in place of their lossy reconstruction, with the seam blended.
        blend: frames over which the seam fades out behind given frames.
        guidance: motion history guidance (paper A.7), off by default.
    """

    steps: int = 30
    stride: int = 4
    placement: Placement = "fuse"
    trust: float = 0.1
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
        canvas = Canvas(model, given, schedule, options, samples)
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
    relations = relations_by_token(canonical_frame((related or given).T_world_root))
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


def relations_by_token(T_world_can: Tensor) -> Tensor:
    """Pairwise transforms by token. (B, T, P, 4, 4) -> (B, N, P, P - 1, 4, 9)"""
    pairs = to_9d(pairwise(T_world_can))
    return by_token(pairs.flatten(-2)).unflatten(-1, (-1, 9)).transpose(-3, -2)


class Canvas:
    """World poses of the scene while it is being generated.

    After each stage the new tokens are made self-consistent before the model sees them again: codes
    snapped, transforms projected to turns about the vertical and ground shifts, agents placed in the
    world, and both kinds of transforms recomputed from there.
    """

    def __init__(
        self, model: Denoiser, given: Scene, schedule: MaskSchedule, options: SamplerOptions, samples: int
    ) -> None:
        self.model = model
        self.options = options
        self.known = schedule.known
        self.given = given.repeat(samples)
        self.placed = schedule.known.clone()
        # Steps across the border of two known tokens are recorded; the rest is filled in as it is placed.
        self.T_world_can = canonical_frame(self.given.T_world_root).clone()

    def settle(self, canvas: Tensor, finished: Tensor) -> Tensor:
        """Make the tokens that a stage finished self-consistent. canvas (B, N, P, D), finished (N, P) bool"""
        rows = finished.any(dim=1).nonzero()[:, 0]
        if not len(rows):
            return canvas
        layout, statistics = self.model.layout, self.model.statistics
        first, stop = int(rows[0]), int(rows[-1]) + 1
        new = finished[first:stop].to(canvas.device)  # (n, P)
        latent, steps, relations = layout.unpack(statistics.restore(canvas[:, first:stop]))
        if self.options.requantise:
            latent = torch.where(new[..., None], self.model.tokenizer.requantise(latent), latent)
        before = self._ready(first, stop)
        self._place(steps, relations if layout.slots else None, first, stop, new)
        self.placed[first:stop] |= finished[first:stop]
        # One frame more in front, so that the first step leads in from where each agent stood.
        lead = min(1, first)
        T_world_can = self.T_world_can[:, first * STRIDE - lead : stop * STRIDE]
        true_steps = by_token(to_9d(canonical_steps(T_world_can))[:, lead:])
        if lead:
            entered = self.placed[first - 1].to(canvas.device)[None, :, None]
            true_steps[:, 0, :, 0] = torch.where(entered, true_steps[:, 0, :, 0], to_9d(torch.eye(4)).to(canvas))
        settled = layout.pack(latent, true_steps, relations_by_token(T_world_can[:, lead:]))
        changed = layout.spread(self._ready(first, stop) & ~before).to(canvas.device)
        canvas = canvas.clone()
        canvas[:, first:stop] = torch.where(changed, statistics.normalise(settled), canvas[:, first:stop])
        return canvas

    def _ready(self, first: int, stop: int) -> Tensor:
        """Which groups of tokens speak only of agents that are placed. -> (n, P, 1 + slots) bool"""
        own = self.placed[first:stop, :, None]
        if not self.model.layout.slots:
            return own.clone()
        partner = partners(own.shape[1])
        return torch.cat([own, own & self.placed[first:stop][:, partner]], dim=-1)

    def _place(self, steps: Tensor, relations: Tensor | None, first: int, stop: int, new: Tensor) -> None:
        """Put newly generated agents into the world from their predicted steps and relations."""
        T_prev_can = project_se2(from_9d(by_frame(steps)))
        T_self_partner = None
        if relations is not None:
            T_self_partner = from_9d(relations.permute(0, 1, 4, 2, 3, 5).flatten(1, 2))
        T_world_start = self._starts(T_prev_can, T_self_partner, first)
        known = self.placed[first:stop].all(dim=0).to(new.device)
        placed = place(
            T_prev_can,
            T_self_partner,
            T_world_start,
            self.options.placement,
            self.options.trust,
            present=self.given.present & (known | new.any(dim=0)),  # of others, nothing is known here
            fixed=known,
        )
        frames = slice(first * STRIDE, stop * STRIDE)
        keep = new.repeat_interleave(STRIDE, dim=0)[..., None, None]
        self.T_world_can[:, frames] = torch.where(keep, placed, self.T_world_can[:, frames])

    def _starts(self, T_prev_can: Tensor, T_self_partner: Tensor | None, first: int) -> Tensor:
        """Canonical frames just before token `first`, such that the first step leads to the right place.

        Whoever was there before goes on from there. A newcomer's first frame hangs off somebody known at
        that frame by the pairwise transform, or off agent 0, who then starts at the origin.
        """
        P = self.T_world_can.shape[2]
        there = self.placed[first - 1] if first else torch.zeros(P, dtype=torch.bool)
        starts = self.T_world_can[:, max(first * STRIDE - 1, 0)].clone()
        if bool(there.all()):
            return starts
        known_now = self.placed[first].nonzero()[:, 0].tolist()
        anchor = known_now[0] if known_now else 0
        T_world_anchor = self.T_world_can[:, first * STRIDE, anchor]
        if not known_now:
            T_world_anchor = torch.eye(4, device=starts.device).expand_as(T_world_anchor)
        for agent in (~there).nonzero()[:, 0].tolist():
            T_world_first = T_world_anchor
            if agent != anchor and T_self_partner is not None:
                slot = agent - (agent > anchor)
                T_world_first = T_world_anchor @ project_se2(T_self_partner[:, 0, anchor, slot])
            starts[:, agent] = T_world_first @ inverse(T_prev_can[:, 0, agent])
        return starts

    def scene(self, canvas: Tensor) -> Scene:
        """The finished canvas as bodies in the world."""
        layout = self.model.layout
        latent, steps, _ = layout.unpack(self.model.statistics.restore(canvas))
        features = self.model.tokenizer.decode(latent, self.given.betas, steps)
        decoded = posed(features, self.T_world_can, self.given)
        if self.options.paste:
            decoded = self._paste(decoded)
        return self._hold_unknown(decoded)

    def _hold_unknown(self, scene: Scene) -> Scene:
        """Agents that the task neither gives nor generates from some time on stand still from there."""
        ended = self.placed.repeat_interleave(STRIDE, dim=0).to(scene.device)
        if bool(ended.all()):
            return scene
        last, agents = last_known(ended), torch.arange(ended.shape[1], device=scene.device)
        return scene.replace(body_rot=scene.body_rot[:, last, agents], T_world_root=scene.T_world_root[:, last, agents])

    def _paste(self, decoded: Scene) -> Scene:
        """Put given frames back; what they differ by at the seam fades out over the frames behind it."""
        keep = self.known.repeat_interleave(STRIDE, dim=0).to(decoded.device)  # (T, P)
        fade = seam_weights(keep, self.options.blend)  # (T, P)
        last = last_known(keep)  # (T, P) frame of the seam in front
        body_rot, T_world_root = decoded.body_rot, decoded.T_world_root
        T_can_root = inverse(self.T_world_can) @ T_world_root
        given_can_root = inverse(canonical_frame(self.given.T_world_root)) @ self.given.T_world_root
        agents = torch.arange(keep.shape[1], device=keep.device)
        given_at, decoded_at = self.given.body_rot[:, last, agents], body_rot[:, last, agents]
        body_rot = fade_rotation(body_rot, given_at, decoded_at, fade[..., None])
        tilt = fade_rotation(
            T_can_root[..., :3, :3],
            given_can_root[:, last, agents, :3, :3],
            T_can_root[:, last, agents, :3, :3],
            fade,
        )
        lift = (given_can_root - T_can_root)[:, last, agents, :3, 3]
        T_can_root = rigid(tilt, T_can_root[..., :3, 3] + fade[..., None] * lift)
        there = decoded.present[:, None, :, None, None]
        blended = torch.where(there, self.T_world_can @ T_can_root, T_world_root)
        return decoded.replace(
            body_rot=torch.where(keep[..., None, None, None], self.given.body_rot, body_rot),
            T_world_root=torch.where(keep[..., None, None], self.given.T_world_root, blended),
        )


def last_known(keep: Tensor) -> Tensor:
    """For every frame the latest known frame at or before it; 0 where there is none. (T, P) bool -> (T, P) int"""
    frame = torch.arange(keep.shape[0], device=keep.device)[:, None]
    return torch.where(keep, frame, 0).cummax(dim=0).values


def seam_weights(keep: Tensor, blend: int) -> Tensor:
    """How much of the seam's difference is still added: 1 at the last known frame, 0 `blend` frames on. -> (T, P)"""
    frame = torch.arange(keep.shape[0], device=keep.device)[:, None]
    since = (frame - last_known(keep)).float() / max(blend, 1)
    after = keep.int().cummax(dim=0).values.bool()
    ramp = (1 - since).clamp(0, 1)
    return torch.where(after, ramp * ramp * (3 - 2 * ramp), 0.0)


def fade_rotation(rotation: Tensor, given: Tensor, decoded: Tensor, weight: Tensor) -> Tensor:
    """Add the turn that leads from `decoded` to `given`, scaled by a weight. (..., 3, 3), weight (...)"""
    difference = roma.rotmat_to_rotvec(given @ decoded.transpose(-1, -2))
    return roma.rotvec_to_rotmat(difference * weight[..., None]) @ rotation
