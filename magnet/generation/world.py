"""World poses of a scene while it is generated, and its bodies in the end."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from magnet.denoiser.core import DenoiserCore
from magnet.generation.blending import (
    GOES_ON,
    crossfade_given,
    delta_between,
    eased_in,
    freeze_after,
    gone_on,
    smoothed_path,
    warp_to_keyframe,
)
from magnet.generation.causal_bodies import decoded_frames, finalized_bodies
from magnet.generation.conditioning import first_of, lookahead_limit, receptive_field, require_finite, spans
from magnet.generation.entering import starts
from magnet.generation.separation import Decode, separated
from magnet.generation.settling import LEAD, Corrected, settled_block, settled_chunk
from magnet.generation.stats import SamplingStats
from magnet.motion.frames import (
    canonical_deltas,
    canonical_frame,
    from_9d,
    inverse,
    pairwise,
    posed,
    project_se2,
    to_9d,
)
from magnet.motion.placement import Placement, place
from magnet.motion.scene import Scene, cat_time
from magnet.motion.tokens import TOKEN_FRAMES, by_frame, by_token, pairwise_by_frame, pairwise_by_token
from magnet.sampling.faint import steps_since
from magnet.sampling.options import SamplerOptions
from magnet.sampling.schedule import MaskSchedule
from magnet.tokenizer.carried import Carried


class WorldState:
    """World poses of the scene while it is generated.

    After each stage the new tokens are made consistent before the model sees them again: latents moved to their nearest
    codes, transforms projected to planar ones, agents placed, and deltas and pairwise transforms computed from there.

    Args:
        model: whose tokens these are.
        given: (B, T) the scene (or its first rows, see `extend`) with everything unknown masked.
        schedule: the plan of the whole scene; only what it knows is read.
        options: how to sample.
        samples: scenes drawn for each of B.
        stats: filled, where given.
    """

    def __init__(
        self,
        model: DenoiserCore,
        given: Scene,
        schedule: MaskSchedule,
        options: SamplerOptions,
        samples: int,
        stats: SamplingStats | None = None,
    ) -> None:
        self.model, self.options, self.stats, self.samples = model, options, stats, samples
        self.settle = None if options.settle == "off" else options.settle
        self.known = schedule.known[: given.frames // TOKEN_FRAMES]
        self.given = given.repeat(samples)
        self.there = self.given.present.any(dim=0).nonzero()[:, 0]  # slots that somebody is in
        self.placed = self.known.clone()
        self.saw = torch.ones(self.known.shape[1], self.known.shape[1], dtype=torch.bool)  # see `shown_to`
        # Recorded across the border of two known tokens; the rest is filled in as it is placed.
        self.T_world_can = canonical_frame(self.given.T_world_root).clone()
        self.since: Tensor | None = None  # token steps to the first row from each one's last given one before it
        self.rooted = False  # whether something was known in rows that have been let go
        self.causal, self._lookahead_limit, self.released = schedule.causal, lookahead_limit(schedule), 0
        self.correction: Corrected | None = None  # of the last two frames shown, in causal plans
        self.uncorrected: Scene | None = None  # the same two frames before they were corrected
        self.chunk_correction: Corrected | None = None  # of the chunk before, in all other plans
        self.finalized = 0  # rows of a causal plan whose bodies are final, and given from then on
        self.steer: Callable[[slice, Tensor], None] | None = None  # of a crowd: moves the newly placed a little
        self.decode_rows: Callable[[Tensor, int, int], Decode] = lambda tokens, first, stop: model.tokenizer.decode
        self.decoder = Carried(keep=2 * options.blend + 4 * TOKEN_FRAMES)  # seams are decoded again

    def extend(self, given: Scene, known: Tensor) -> None:
        """Add rows at the end. given (B, 4 n), known (n, P)"""
        self.given = cat_time([self.given, given := given.repeat(self.samples)])
        self.known, self.placed = torch.cat([self.known, known]), torch.cat([self.placed, known])
        self.T_world_can = torch.cat([self.T_world_can, canonical_frame(given.T_world_root)], dim=1)

    def release(self, rows: int) -> None:
        """Release the first rows, on which nothing that may still change depends: one row before it must stay.

        What is left is a view of what was, which goes when rows are added.
        """
        frames = rows * TOKEN_FRAMES
        if self.options.guidance.stabilization_level or self.options.guidance.stabilization_unseen:
            self.since = steps_since(self.known[:rows], self.since)
        self.rooted |= bool(self.known[:rows].any())
        self.finalized, self.released = max(self.finalized - rows, 0), self.released + rows
        self.known, self.placed = self.known[rows:], self.placed[rows:]
        self.T_world_can, self.given = self.T_world_can[:, frames:], self.given.slice(frames)

    @torch.inference_mode()
    def make_consistent(self, tokens: Tensor, finished: Tensor, decentralized: bool = False) -> Tensor:
        """Make the tokens that a stage finished self-consistent, in place. tokens (B, N, P, D), finished (N, P) bool

        Known tokens keep everything but the delta that leads into them, which is written once the agent before them is
        placed. `decentralized`: some agents did not see what others did in this stage. Their pairwise transforms are
        noise then, so everybody is placed by the own deltas alone, whatever the options say.
        """
        rows = finished.any(dim=1).nonzero()[:, 0]
        if not len(rows):
            return tokens
        layout, normalizer = self.model.layout, self.model.normalizer
        first, stop = int(rows[0]), int(rows[-1]) + 1
        latent, deltas, pairs = layout.unpack(normalizer.denormalize(tokens[:, first:stop]))
        if self.model.quantized if self.options.requantize is None else self.options.requantize:
            new = finished[first:stop].to(tokens.device)
            code = self.model.tokenizer.requantize(latent)
            if self.stats is not None:
                self.stats.add_quantization_error(latent, code, new & self.given.present[:, None])
            latent = torch.where(new[..., None], code, latent)
        placement = "integrate" if decentralized else self.options.placement
        moved = self._place_all(deltas, pairs if layout.slots else None, finished, first, stop, placement)
        if self.steer is not None:
            self.steer(slice(first, stop), finished[first:stop])
        if self.options.apart != "off":
            self._separate(tokens, latent, finished, first, stop, decentralized)
        if self.options.settle_blocks and self.settle is not None:
            latent = self._settle(tokens, latent, finished, first, stop, decentralized)
        begin = int(moved.any(dim=1).nonzero()[0, 0])
        if begin < first:  # a gap longer than the window has been closed, which moves its earlier frames too
            earlier = layout.unpack(normalizer.denormalize(tokens[:, begin:first]))[0]
            latent = torch.cat([earlier, latent], dim=1)
        true_deltas = self.placed_deltas(begin, stop)
        here, partner = self.T_world_can[:, begin * TOKEN_FRAMES : stop * TOKEN_FRAMES], layout.partners(tokens.device)
        implied = pairwise_by_token(to_9d(pairwise(here, partner)))
        settled = layout.pack(latent, true_deltas, implied)
        changed_groups = (self._ready(begin, stop) & self._touched(moved[begin:stop])).to(tokens.device)
        if layout.slots and self.stats is not None:
            together = (layout.group_present(self.given.present)[:, None] & changed_groups)[:, first - begin :, :, 1:]
            if decentralized:
                new = finished[first:stop].to(tokens.device)
                together &= ~(new[:, :, None] & new[:, partner])
            self.stats.add_pairwise_drift(pairs, implied[:, first - begin :], together)
        changed = layout.spread(changed_groups)
        tokens[:, begin:stop] = torch.where(changed, normalizer.normalize(settled), tokens[:, begin:stop])
        return self._enter(tokens, begin, stop)

    def _unseen(self, row: int) -> Tensor:
        """Who is given at a token step and not shown to everybody whose block it is. -> (P,) bool"""
        return self.known[row] & ~self.saw.all(dim=0) if self.causal else torch.zeros_like(self.known[row])

    def _separate(
        self, tokens: Tensor, latent: Tensor, finished: Tensor, first: int, stop: int, decentralized: bool
    ) -> None:
        """Move the newly placed out of others' bodies, but for those on their way to a keyframe."""
        lead = min(1, first)  # a row more in front, so that the decoder knows where poses come from
        if lead:
            before = self.model.normalizer.denormalize(tokens[:, first - 1 : first])
            latent = torch.cat([self.model.layout.unpack(before)[0], latent], dim=1)
        low, frames = first - lead, slice((first - lead) * TOKEN_FRAMES, stop * TOKEN_FRAMES)
        new = finished[low:stop] & ~self.known[stop] if stop < len(self.known) else finished[low:stop]
        self.T_world_can[:, frames] = separated(
            self.decode_rows(tokens, low, stop),
            latent,
            self.placed_deltas(low, stop),
            self.T_world_can[:, frames],
            self.given.slice(frames.start, frames.stop),
            new.to(latent.device),
            self.options.apart,
            bool(lead),
            self.known[low:stop].to(latent.device),
            self._unseen(first).to(latent.device),
            decentralized,
        )

    def _settle(
        self, tokens: Tensor, latent: Tensor, finished: Tensor, first: int, stop: int, decentralized: bool
    ) -> Tensor:
        """Correct the poses of the newly placed, and make them what the model goes on from. -> latents (B, n, P, C)"""
        assert self.settle is not None
        lead = min(LEAD, first)
        if lead:
            before = self.model.normalizer.denormalize(tokens[:, first - lead : first])
            latent = torch.cat([self.model.layout.unpack(before)[0], latent], dim=1)
        low, frames = first - lead, slice((first - lead) * TOKEN_FRAMES, stop * TOKEN_FRAMES)
        new = finished[low:stop] & ~self.known[stop] if stop < len(self.known) else finished[low:stop]
        new, known = new.to(latent.device), self.known[low:stop].to(latent.device)
        T_world_can, unseen = self.T_world_can[:, frames], self._unseen(first).to(latent.device)
        rest = self.given.slice(frames.start, frames.stop), new, known, unseen, self.settle, lead, decentralized
        deltas = self.placed_deltas(low, stop)
        plain, made = settled_block(self.model.tokenizer.decode, latent, deltas, T_world_can, *rest)
        moved = (made.T_world_root != plain.T_world_root).flatten(3).any(-1)
        moves = new & moved.unflatten(1, (-1, TOKEN_FRAMES)).any(2)
        frame = moves.repeat_interleave(TOKEN_FRAMES, dim=1)[..., None, None]
        self.T_world_can[:, frames] = torch.where(frame, canonical_frame(made.T_world_root), T_world_can)
        changed = self.model.encode(made) - self.model.encode(plain)  # what encoding itself loses stays as it was
        return torch.where(moves[..., None], latent + changed, latent)[:, lead:]

    def placed_deltas(self, first: int, stop: int) -> Tensor:
        """Deltas of some tokens as placed in the world; the identity after unplaced rows. -> (B, n, P, 4, 9)"""
        # One frame more in front, so that the first delta leads in from where each agent stood.
        lead = min(1, first)
        deltas = canonical_deltas(self.T_world_can[:, first * TOKEN_FRAMES - lead : stop * TOKEN_FRAMES])[:, lead:]
        deltas = by_token(to_9d(deltas))
        before = torch.nn.functional.pad(self.placed[:stop], (0, 0, 1, 0))[first:stop].to(deltas.device)
        deltas[:, :, :, 0] = torch.where(before[..., None], deltas[:, :, :, 0], to_9d(torch.eye(4)).to(deltas))
        return deltas

    def _enter(self, tokens: Tensor, first: int, stop: int) -> Tensor:
        """Write the delta into known tokens whose gap before them has just been closed."""
        until = min(stop + 1, len(self.known))
        before = torch.nn.functional.pad(self.known, (0, 0, 1, 0))[first:until]
        entered = (self.known[first:until] & ~before).to(tokens.device)
        entered[0] = False  # nothing in front of these rows has moved
        if not bool(entered.any()):
            return tokens
        layout, normalizer = self.model.layout, self.model.normalizer
        latent, _, pairs = layout.unpack(tokens[:, first:until])
        true = normalizer.normalize(layout.pack(latent, self.placed_deltas(first, until), pairs))
        number = torch.arange(layout.width, device=tokens.device)
        delta = (number >= layout.latent) & (number < layout.latent + 9)
        tokens[:, first:until] = torch.where(entered[..., None] & delta, true, tokens[:, first:until])
        return tokens

    def _ready(self, first: int, stop: int) -> Tensor:
        """Groups of tokens that concern placed agents only. -> (n, P, 1 + slots) bool"""
        own = self.placed[first:stop, :, None]
        if not self.model.layout.slots:
            return own.clone()
        return torch.cat([own, own & self.placed[first:stop][:, self.model.layout.partners()]], dim=-1)

    def _touched(self, moved: Tensor) -> Tensor:
        """Groups of tokens that concern an agent that moved. moved (n, P) -> (n, P, 1 + slots) bool"""
        own = moved[..., None]
        if not self.model.layout.slots:
            return own
        return torch.cat([own, own | moved[:, self.model.layout.partners()]], dim=-1)

    def _place_all(
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
            self.options.pairwise_weight,
            present=there,
            fixed=known,
            anchor=first_of(there),
            partner=self.model.layout.partners(deltas.device),
        )
        placed = self._gone_on(placed, first)
        frames = slice(first * TOKEN_FRAMES, stop * TOKEN_FRAMES)
        self.T_world_can[:, frames] = torch.where(new[:, None, None], placed, self.T_world_can[:, frames])

    def _gone_on(self, placed: Tensor, first: int) -> Tensor:
        """Paths from row `first` on, of which those that follow known rows go on as fast. (B, T, P, 4, 4) -> same"""
        if not first or not self.options.smooth_path or not bool(self.known[first - 1].any()):
            return placed
        before = self.T_world_can[:, (first - 1) * TOKEN_FRAMES : first * TOKEN_FRAMES]
        goes_on = self.known[first - 1].to(placed.device)[:, None, None]
        return torch.where(goes_on, gone_on(before, placed), placed)

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
        shift = torch.where(there.any(dim=1)[:, None, None], shift, torch.eye(4, device=shift.device))
        placed = self.by_frame(self.placed[: key // TOKEN_FRAMES])[..., None, None]
        now = self.T_world_can[:, :key]
        self.T_world_can[:, :key] = torch.where(placed, project_se2(shift[:, None, None] @ now), now)

    def scene(self, tokens: Tensor, first: int = 0, stop: int | None = None, before: Scene | None = None) -> Scene:
        """Bodies in the world of rows [first, stop) of the finished tokens; by default of all rows.

        `before` is the frame before them, where there is one, which agents that have ended stand still in. Poses
        depend on neighbouring rows, through the decoder and the blending of seams; those of causal plans on earlier
        rows alone (`magnet.generation.causal_bodies`).
        """
        if self.causal:
            return finalized_bodies(self, tokens, first, len(self.known) if stop is None else stop)
        blend = -(-self.options.blend // TOKEN_FRAMES) if self.options.keep_given else 0
        stop = len(self.known) if stop is None else stop
        # Only what is given later has a seam before it; the plain network rounds otherwise in another window.
        later = self.options.precision == "reference" or bool(self.known[stop : stop + blend].any())
        low, high = max(first - blend, 0), min(stop + blend * later, len(self.known))
        behind, ahead = receptive_field(self.model)
        near = slice(max(low - behind, 0), high + ahead)
        latent, deltas, _ = self.model.layout.unpack(self.model.normalizer.denormalize(tokens[:, near]))
        frames = slice((low - near.start) * TOKEN_FRAMES, (high - near.start) * TOKEN_FRAMES)
        features = decoded_frames(self, latent, deltas, frames, near.start, latent.shape[1])
        given = self.given.slice(low * TOKEN_FRAMES, high * TOKEN_FRAMES)
        T_world_can = self._shown_path(low, high)
        decoded = posed(features, T_world_can, given)
        if self.options.keep_given:
            keep = self.by_frame(self.known[low:high])
            decoded = crossfade_given(decoded, given, T_world_can, keep, self.options.blend)
        decoded = decoded.slice((first - low) * TOKEN_FRAMES, (stop - low) * TOKEN_FRAMES)
        require_finite(decoded, self.by_frame(self.placed[first:stop]))
        if self.settle is not None:
            fixed, goes_on = self.by_frame(self.known[first:stop]), self.placed[first:stop].all(dim=0).to(tokens.device)
            seen = decoded.replace(present=decoded.present & goes_on)  # nobody makes way for whom nothing is known of
            made, self.chunk_correction = settled_chunk(seen, fixed, self.settle, self.chunk_correction)
            decoded = made.replace(present=decoded.present)
        return freeze_after(decoded, self.by_frame(self.placed[first:stop]), before)

    def _shown_path(self, first: int, stop: int) -> Tensor:
        """Canonical frames of rows [first, stop) as they are shown. -> (B, 4 n, P, 4, 4)"""
        until = stop * TOKEN_FRAMES + 2
        T_world_can, frames = self.T_world_can[:, :until], slice(first * TOKEN_FRAMES, stop * TOKEN_FRAMES)
        if self.options.smooth_path:
            beside = self.known.any(dim=1, keepdim=True) & ~self.known
            who = (self.by_frame(each)[:until] for each in (self.placed, self.known, beside))
            T_world_can = smoothed_path(T_world_can, *who)
        return T_world_can[:, frames]

    def by_frame(self, rows: Tensor) -> Tensor:
        """A mask of rows as one of frames, where the bodies are. (n, P) -> (4 n, P)"""
        return rows.repeat_interleave(TOKEN_FRAMES, dim=0).to(self.given.device)
