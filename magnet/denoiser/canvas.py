"""World poses of a scene while it is being generated, and its bodies in the end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import roma
import torch
from torch import Tensor

from magnet.motion.frames import (
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
from magnet.motion.scene import Scene
from magnet.motion.tokens import STRIDE, by_frame, by_token, relations_by_frame, relations_by_token
from magnet.sampling.schedule import MaskSchedule

if TYPE_CHECKING:
    from magnet.denoiser.generation import SamplerOptions
    from magnet.denoiser.module import Denoiser


@dataclass
class Health:
    """How well sampled tokens hang together; filled while sampling, for whoever asks.

    `snap`: distance of a sampled latent to its code, as a share of the code's length. `drift`: metres
    between a sampled pairwise transform and what the placed agents imply.
    """

    snap_sum: float = 0.0
    snaps: int = 0
    drift_sum: float = 0.0
    drifts: int = 0

    def means(self) -> dict[str, float]:
        """Means of what was seen."""
        return {"snap": self.snap_sum / max(self.snaps, 1), "drift": self.drift_sum / max(self.drifts, 1)}

    def add_snap(self, latent: Tensor, code: Tensor, counts: Tensor) -> None:
        """latent, code (B, n, P, C), counts (B, n, P) bool"""
        away = ((latent - code).norm(dim=-1) / code.norm(dim=-1).clamp_min(1e-6))[counts]
        self.snap_sum += float(away.sum())
        self.snaps += len(away)

    def add_drift(self, relations: Tensor, implied: Tensor, counts: Tensor) -> None:
        """relations, implied (B, n, P, slots, 4, 9), counts (B, n, P, slots) bool"""
        away = (relations - implied)[..., 6:].norm(dim=-1).mean(dim=-1)[counts]
        self.drift_sum += float(away.sum())
        self.drifts += len(away)


class Canvas:
    """World poses of the scene while it is being generated.

    After each stage the new tokens are made self-consistent before the model sees them again: codes
    snapped, transforms projected to turns about the vertical and ground shifts, agents placed in the
    world, and both kinds of transforms recomputed from there.
    """

    def __init__(
        self,
        model: Denoiser,
        given: Scene,
        schedule: MaskSchedule,
        options: SamplerOptions,
        samples: int,
        health: Health | None = None,
    ) -> None:
        self.model = model
        self.options = options
        self.health = health or Health()
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
            code = self.model.tokenizer.requantise(latent)
            self.health.add_snap(latent, code, new & self.given.present[:, None])
            latent = torch.where(new[..., None], code, latent)
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
        implied = relations_by_token(to_9d(pairwise(T_world_can[:, lead:])))
        settled = layout.pack(latent, true_steps, implied)
        changed_groups = (self._ready(first, stop) & ~before).to(canvas.device)
        if layout.slots:
            together = layout.group_present(self.given.present)[:, None] & changed_groups
            self.health.add_drift(relations, implied, together[..., 1:])
        changed = layout.spread(changed_groups)
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
            T_self_partner = from_9d(relations_by_frame(relations))
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
