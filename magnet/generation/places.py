"""Where everybody stands in a scene while it is generated."""

from __future__ import annotations

import torch
from torch import Tensor

from magnet.denoiser.core import DenoiserCore
from magnet.generation.blending import GOES_ON, delta_between, eased_in, gone_on, taken_up, warp_to_keyframe
from magnet.generation.conditioning import first_of, lookahead_limit, spans
from magnet.generation.entering import starts
from magnet.motion.frames import canonical_deltas, canonical_frame, from_9d, inverse, project_se2, to_9d
from magnet.motion.placement import Placement, place
from magnet.motion.scene import Scene, cat_time
from magnet.motion.tokens import TOKEN_FRAMES, by_frame, by_token, pairwise_by_frame
from magnet.sampling.faint import steps_since
from magnet.sampling.options import SamplerOptions
from magnet.sampling.schedule import MaskSchedule


class Places:
    """Where everybody stands in the token steps (rows) that are held: given, or placed by what was predicted.

    Args:
        model: whose tokens place people.
        given: (B, T) the scene (or its first rows, see `extend`) with everything unknown masked.
        schedule: the plan of the whole scene; only what it knows is read.
        options: how to sample.
        samples: scenes drawn for each of B.

    Attributes:
        known, placed: (n, P) bool, whose tokens are given, and who stands somewhere.
        T_world_can: (B, 4 n, P, 4, 4) canonical frames of those who do.
        since: token steps to the first row from each one's last given one before it.
        faint: (n, P) int, levels at which the stage that is sampled shows what is finished; None: all clean.
        rooted: whether something was known in rows that have been let go.
        finalized: rows of a causal plan whose bodies are final, and given from then on.
        released: rows that have been let go.
    """

    def __init__(
        self, model: DenoiserCore, given: Scene, schedule: MaskSchedule, options: SamplerOptions, samples: int
    ) -> None:
        self.model, self.options, self.samples = model, options, samples
        self.known = schedule.known[: given.frames // TOKEN_FRAMES]
        self.given = given.repeat(samples)
        self.there = self.given.present.any(dim=0).nonzero()[:, 0]  # slots that somebody is in
        self.placed = self.known.clone()
        # Recorded across the border of two known tokens; the rest is filled in as it is placed.
        self.T_world_can = canonical_frame(self.given.T_world_root).clone()
        self.since: Tensor | None = None
        self.faint: Tensor | None = None
        self.causal, self._lookahead_limit = schedule.causal, lookahead_limit(schedule)
        self.rooted, self.finalized, self.released = False, 0, 0

    def extend(self, given: Scene, known: Tensor) -> None:
        """Add rows at the end. given (B, 4 n), known (n, P)"""
        self.given = cat_time([self.given, given := given.repeat(self.samples)])
        self.known, self.placed = torch.cat([self.known, known]), torch.cat([self.placed, known])
        self.T_world_can = torch.cat([self.T_world_can, canonical_frame(given.T_world_root)], dim=1)

    def release(self, rows: int) -> None:
        """Release the first rows, on which nothing that may still change depends: one row before it must stay.

        What is left is a view of what was, which goes when rows are added.
        """
        frames, guidance = rows * TOKEN_FRAMES, self.options.guidance
        if self.options.together or guidance.stabilization_level or guidance.stabilization_unseen:
            self.since = steps_since(self.known[:rows], self.since)
        self.rooted |= bool(self.known[:rows].any())
        self.finalized, self.released = max(self.finalized - rows, 0), self.released + rows
        self.known, self.placed = self.known[rows:], self.placed[rows:]
        self.T_world_can, self.given = self.T_world_can[:, frames:], self.given.slice(frames)

    def placed_deltas(self, first: int, stop: int) -> Tensor:
        """Deltas of some tokens as placed in the world; the identity after unplaced rows. -> (B, n, P, 4, 9)"""
        # One frame more in front, so that the first delta leads in from where each agent stood.
        lead = min(1, first)
        deltas = canonical_deltas(self.T_world_can[:, first * TOKEN_FRAMES - lead : stop * TOKEN_FRAMES])[:, lead:]
        deltas = by_token(to_9d(deltas))
        before = torch.nn.functional.pad(self.placed[:stop], (0, 0, 1, 0))[first:stop].to(deltas.device)
        deltas[:, :, :, 0] = torch.where(before[..., None], deltas[:, :, :, 0], to_9d(torch.eye(4)).to(deltas))
        return deltas

    def place_all(
        self, deltas: Tensor, pairs: Tensor | None, finished: Tensor, first: int, stop: int, placement: Placement
    ) -> Tensor:
        """Place the new tokens of a stage in the world, gap by gap. -> (N, P) bool, who moved"""
        moved = finished.clone()
        for start, end in spans(finished, self.placed, first, stop):
            part = slice(start - first, end - first)
            new = finished[start]
            near = None if pairs is None else pairs[:, part]
            self._place(deltas[:, part], near, start, end, new, placement)
            self.placed[start:end] |= new
            moved |= self._warp_to_keyframe(end, new)
        return moved

    def _place(
        self, deltas: Tensor, pairs: Tensor | None, first: int, stop: int, new: Tensor, placement: Placement
    ) -> None:
        """Place newly generated agents by their predicted deltas and pairwise transforms. new (P,) bool"""
        new = new.to(deltas.device)
        known = self.placed[first].to(deltas.device)
        true_deltas = from_9d(by_frame(self.placed_deltas(first, stop)))
        T_prev_can = torch.where(known[:, None, None], true_deltas, project_se2(from_9d(by_frame(deltas))))
        if self.causal and self.options.smooth_path and first:
            made, last = (self.placed & ~self.known)[first - 1].to(new.device), first * TOKEN_FRAMES
            T_prev_can = eased_in(self.T_world_can[:, last - 2 : last], T_prev_can, made & new)
        T_self_partner = None if pairs is None else from_9d(pairwise_by_frame(pairs))
        there = self.given.present & (known | new)  # of others, nothing is known here
        placed = place(
            T_prev_can,
            T_self_partner,
            self.starts(T_prev_can, T_self_partner, first, new),
            placement,
            self.options.weight_of_pairs,
            present=there,
            fixed=known,
            anchor=first_of(there),
            partner=self.model.layout.partners(deltas.device),
        )
        placed = self._gone_on(placed, first)
        frames = slice(first * TOKEN_FRAMES, stop * TOKEN_FRAMES)
        self.T_world_can[:, frames] = torch.where(new[:, None, None], placed, self.T_world_can[:, frames])

    def _gone_on(self, placed: Tensor, first: int) -> Tensor:
        """Paths from row `first` on that begin as fast as they went before. (B, T, P, 4, 4) -> same

        What is known was right, and people go on from it; of what was made and shown noisily, networks know the speed
        only roughly.
        """
        if not first or not self.options.smooth_path:
            return placed
        before = self.T_world_can[:, (first - 1) * TOKEN_FRAMES : first * TOKEN_FRAMES]
        known, made = self.known[first - 1], (self.placed & ~self.known)[first - 1]
        faintly = torch.zeros_like(made) if self.faint is None or self.causal else made & (self.faint[first - 1] > 0)
        for who, way in ((known, gone_on), (faintly, taken_up)):
            if bool(who.any()):
                placed = torch.where(who.to(placed.device)[:, None, None], way(before, placed), placed)
        return placed

    def starts(self, T_prev_can: Tensor, T_self_partner: Tensor | None, first: int, new: Tensor) -> Tensor:
        """Canonical frames just before token `first`; see `magnet.generation.entering.starts`."""
        before, at = self.T_world_can[:, max(first * TOKEN_FRAMES - 1, 0)], self.T_world_can[:, first * TOKEN_FRAMES]
        there = self.placed[first - 1] if first else torch.zeros_like(self.placed[0])
        who = there.to(new.device), self.placed[first].to(new.device), new, self.given.present
        return starts(before, at, *who, T_prev_can, T_self_partner)

    def _warp_to_keyframe(self, row: int, new: Tensor) -> Tensor:
        """Warp the paths of agents that have been placed up to a known token. new (P,) -> (N, P) bool, who moved

        Each agent's error is spread over its gap, or over the part of it that is not finalized. If nothing was known
        before, the world's origin was arbitrary, and everybody is moved along with the first agent that arrives.
        """
        moved = torch.zeros_like(self.placed)
        arriving = self.known[row] & new & ~self._late(row) if row < len(self.known) else torch.zeros_like(new)
        if not bool(arriving.any()):
            return moved
        key = row * TOKEN_FRAMES
        if not self.rooted and not self.finalized and not bool(self.known[:row].any()):
            self._root(key, arriving)
            moved[:row] |= self.placed[:row]
        for agent in arriving.nonzero()[:, 0].tolist():
            T_world_key = self.T_world_can[:, key, agent]
            key_delta = inverse(T_world_key) @ self.T_world_can[:, key + 1, agent]
            gap = (self.placed & ~self.known)[:row, agent]
            gap[: self.finalized] = False  # too late to move
            outside = (~gap).nonzero()[:, 0]
            start = int(outside[-1]) + 1 if len(outside) else 0
            left = int(start > 0 and bool(self.placed[start - 1, agent]))
            path = self.T_world_can[:, start * TOKEN_FRAMES - left : key, agent]
            arrives = GOES_ON if self.options.smooth_path else 0
            path = warp_to_keyframe(path, T_world_key, key_delta, arrives)
            self.T_world_can[:, start * TOKEN_FRAMES : key, agent] = path[:, left:]
            moved[start:row, agent] = True
        return moved

    def _late(self, row: int) -> Tensor:
        """Whose known token becomes known only when the one before is finalized. -> (P,) bool"""
        row += self.released
        if not self.causal or not 0 < row < len(self._lookahead_limit):
            return torch.zeros_like(self.known[0])
        return self._lookahead_limit[row - 1] <= row

    def _root(self, key: int, arriving: Tensor) -> None:
        """Move the world before frame `key` so that in each scene the first arriving agent fits. arriving (P,)"""
        there = self.given.present & arriving.to(self.given.device)
        scene, lead = torch.arange(len(there), device=there.device), first_of(there)
        T_world_key = self.T_world_can[scene, key, lead]
        key_delta = inverse(T_world_key) @ self.T_world_can[scene, key + 1, lead]
        path = self.T_world_can[scene, :key, lead]
        shift = T_world_key @ inverse(path[:, -1] @ delta_between(path, key_delta))
        shift = torch.where(
            there.any(dim=1)[:, None, None], shift, torch.eye(4, dtype=shift.dtype, device=shift.device)
        )
        placed = self.rows_by_frame(self.placed[: key // TOKEN_FRAMES])[..., None, None]
        now = self.T_world_can[:, :key]
        self.T_world_can[:, :key] = torch.where(placed, project_se2(shift[:, None, None] @ now), now)

    def rows_by_frame(self, rows: Tensor) -> Tensor:
        """A mask of rows as one of frames, where the bodies are. (n, P) -> (4 n, P)"""
        return rows.repeat_interleave(TOKEN_FRAMES, dim=0).to(self.given.device)
