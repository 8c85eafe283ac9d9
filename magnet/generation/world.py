"""A scene while it is generated: its tokens made consistent with where people stand, and its bodies in the end."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from magnet.denoiser.core import DenoiserCore
from magnet.generation.causal_bodies import finalized_bodies
from magnet.generation.chunk_bodies import chunk_bodies
from magnet.generation.couples import LONG, Couples
from magnet.generation.places import Places
from magnet.generation.separation import Decode, MadeRows, separated
from magnet.generation.settling import LEAD_TOKENS, Corrected, settled_rows
from magnet.generation.stats import SamplingStats
from magnet.motion.frames import canonical_frame, from_planar, pairwise, to_9d
from magnet.motion.scene import Scene
from magnet.motion.tokens import TOKEN_FRAMES, pairwise_by_token
from magnet.sampling.faint import shown_clean
from magnet.sampling.options import SamplerOptions, Settling
from magnet.sampling.schedule import MaskSchedule
from magnet.tokenizer.carried import Carried


class WorldState(Places):
    """The world of a scene while it is generated: places, tokens that agree with them, and bodies.

    After each stage the new tokens are made consistent before the model sees them again: latents moved to their nearest
    codes, transforms projected to planar ones, agents placed, and deltas and pairwise transforms computed from there.

    Args:
        model, given, schedule, options, samples: see `Places`.
        stats: filled, where given.
        groups: how scenes of three and more people are corrected (`settle`), chunk by chunk; None: as all others.
    """

    def __init__(
        self,
        model: DenoiserCore,
        given: Scene,
        schedule: MaskSchedule,
        options: SamplerOptions,
        samples: int,
        stats: SamplingStats | None = None,
        groups: Settling | None = None,
    ) -> None:
        super().__init__(model, given, schedule, options, samples)
        self.stats, self.settle = stats, None if options.settle == "off" else options.settle
        people = self.given.present.sum(dim=1).tolist()
        self.hows: list[str] = [(groups if groups and count > 2 else self.settle) or "off" for count in people]
        self.saw = torch.ones(self.known.shape[1], self.known.shape[1], dtype=torch.bool)  # see `shown_to`
        self.correction: Corrected | None = None  # of the last two frames shown, in causal plans
        self.chunk_corrections: dict[str, Corrected] = {}  # of the chunk before, in all other plans, by how it was done
        self.couples = Couples(options.together) if options.together and not self.causal else None
        self.steer: Callable[[slice, Tensor], None] | None = None  # of a crowd: moves the newly placed a little
        self.decode_rows: Callable[[Tensor, int, int], Decode] = lambda tokens, first, stop: model.tokenizer.decode
        self.decoder = Carried(keep=2 * options.blend + 4 * TOKEN_FRAMES)  # seams are decoded again
        self.decoder_of_others: dict[tuple[int, bool], Carried] = {}  # as somebody expects them

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
        first, stop = int(rows[0]), int(rows[-1]) + 1
        latent, deltas, pairs = self.model.parts_of(tokens[:, first:stop])
        latent = self._requantized(latent, finished[first:stop].to(tokens.device))
        placement = "integrate" if decentralized else self.options.placement
        near = pairs if self.model.layout.slots else None
        moved = self.place_all(deltas, near, finished, first, stop, placement)
        if self.steer is not None:
            self.steer(slice(first, stop), finished[first:stop])
        if self.couples is not None:
            self._lead(self.couples, finished, first, stop)
        if self.options.apart != "off":  # a row in front tells the decoder where poses come from
            made = self._made_rows(tokens, latent, finished, first, stop, decentralized, lead=1)
            decode = self.decode_rows(tokens, made.first, stop)
            self.T_world_can[:, made.frames] = separated(decode, made, self.options.apart)
        if self.options.settle_blocks and self.settle is not None:
            made = self._made_rows(tokens, latent, finished, first, stop, decentralized, LEAD_TOKENS)
            latent = self._settle(made)
        begin = int(moved.any(dim=1).nonzero()[0, 0])
        if begin < first:  # a gap longer than the window has been closed, which moves its earlier frames too
            latent = torch.cat([self.model.parts_of(tokens[:, begin:first])[0], latent], dim=1)
        implied = self.implied(begin, stop)
        changed = self.changed(moved[begin:stop], begin, stop).to(tokens.device)
        if self.model.layout.slots and self.stats is not None:
            new = finished[first:stop].to(tokens.device) if decentralized else None
            self._count_drift(pairs, implied[:, first - begin :], changed[first - begin :], new)
        settled = self.model.tokens_of(latent, self.placed_deltas(begin, stop), implied)
        tokens[:, begin:stop] = torch.where(self.model.layout.spread(changed), settled, tokens[:, begin:stop])
        return self._enter(tokens, begin, stop)

    def _requantized(self, latent: Tensor, new: Tensor) -> Tensor:
        """The nearest codes of latents (B, n, P, C) that are new (n, P); unchanged where the model has no codes."""
        if not (self.model.quantized if self.options.requantize is None else self.options.requantize):
            return latent
        code = self.model.tokenizer.requantize(latent)
        if self.stats is not None:
            self.stats.add_quantization_error(latent, code, new & self.given.present[:, None])
        return torch.where(new[..., None], code, latent)

    def implied(self, first: int, stop: int) -> Tensor:
        """Pairwise transforms of some tokens as people stand in the world. -> (B, n, P, slots, 4, 9)"""
        partner = self.model.layout.partners(self.T_world_can.device)
        return pairwise_by_token(
            to_9d(pairwise(self.T_world_can[:, first * TOKEN_FRAMES : stop * TOKEN_FRAMES], partner))
        )

    def _count_drift(self, pairs: Tensor, implied: Tensor, changed: Tensor, apart: Tensor | None) -> None:
        """Note how far predicted pairwise transforms are from those implied. changed (n, P, 1 + slots) bool

        apart: (n, P) bool, who did not see each other's; None: nobody.
        """
        assert self.stats is not None
        layout = self.model.layout
        together = (layout.group_present(self.given.present)[:, None] & changed)[..., 1:]
        if apart is not None:
            together &= ~(apart[:, :, None] & apart[:, layout.partners(apart.device)])
        self.stats.add_pairwise_drift(pairs, implied, together)

    def _unseen(self, row: int) -> Tensor:
        """Who is given at a token step and not shown to everybody whose block it is. -> (P,) bool"""
        return self.known[row] & ~self.saw.all(dim=0) if self.causal else torch.zeros_like(self.known[row])

    def _lead(self, couples: Couples, finished: Tensor, first: int, stop: int) -> None:
        """Lead couples back together in what is made long after what was given, but not on the way to a keyframe."""
        rows = slice(first, stop)
        long = ~shown_clean(self.known, LONG, self.since)[rows]
        new = finished[rows] & long & ~self.known[stop] if stop < len(self.known) else finished[rows] & long
        frames, lead = slice(first * TOKEN_FRAMES, stop * TOKEN_FRAMES), int(first == 0)
        around = self.T_world_can[:, frames.start - 1 + lead : frames.stop, :, [0, 2], 3]
        around = torch.cat([around[:, :1], around], dim=1) if lead else around
        moved = couples.led(around, self.rows_by_frame(new), self.given.present)
        T_new_world = from_planar(torch.zeros_like(moved[..., 0]), moved)
        led = (moved != 0).any(dim=-1)[..., None, None]
        now = self.T_world_can[:, frames]
        self.T_world_can[:, frames] = torch.where(led, T_new_world @ now, now)

    def _settle(self, rows: MadeRows) -> Tensor:
        """Correct the poses of the newly placed, and make them what the model goes on from. -> latents (B, n, P, C)"""
        assert self.settle is not None
        plain, made = settled_rows(self.model.tokenizer.decode, rows, self.settle)
        moved = (made.T_world_root != plain.T_world_root).flatten(3).any(-1)
        moves = rows.new & moved.unflatten(1, (-1, TOKEN_FRAMES)).any(2)
        frame = moves.repeat_interleave(TOKEN_FRAMES, dim=1)[..., None, None]
        self.T_world_can[:, rows.frames] = torch.where(frame, canonical_frame(made.T_world_root), rows.T_world_can)
        changed = self.model.encode(made) - self.model.encode(plain)  # what encoding itself loses stays as it was
        return torch.where(moves[..., None], rows.latent + changed, rows.latent)[:, rows.lead :]

    def _made_rows(
        self, tokens: Tensor, latent: Tensor, finished: Tensor, first: int, stop: int, decentralized: bool, lead: int
    ) -> MadeRows:
        """The rows [first, stop) that a stage has finished, with so many in front, or fewer where there are fewer.

        Of those on their way to a keyframe nobody counts as new: they have to arrive. latent (B, n, P, C) of the rows
        """
        low = max(first - lead, 0)
        if low < first:
            latent = torch.cat([self.model.parts_of(tokens[:, low:first])[0], latent], dim=1)
        new = finished[low:stop] & ~self.known[stop] if stop < len(self.known) else finished[low:stop]
        frames, device = slice(low * TOKEN_FRAMES, stop * TOKEN_FRAMES), latent.device
        return MadeRows(
            low,
            latent,
            self.placed_deltas(low, stop),
            self.T_world_can[:, frames],
            self.given.slice(frames.start, frames.stop),
            new.to(device),
            self.known[low:stop].to(device),
            self._unseen(first).to(device),
            first - low,
            decentralized,
        )

    def _enter(self, tokens: Tensor, first: int, stop: int) -> Tensor:
        """Write the delta into known tokens whose gap before them has just been closed."""
        until = min(stop + 1, len(self.known))
        before = torch.nn.functional.pad(self.known, (0, 0, 1, 0))[first:until]
        entered = (self.known[first:until] & ~before).to(tokens.device)
        entered[0] = False  # nothing in front of these rows has moved
        if not bool(entered.any()):
            return tokens
        layout = self.model.layout
        latent, _, pairs = layout.unpack(tokens[:, first:until])
        true = self.model.tokens_of(latent, self.placed_deltas(first, until), pairs)
        number = torch.arange(layout.width, device=tokens.device)
        delta = (number >= layout.latent) & (number < layout.latent + 9)
        tokens[:, first:until] = torch.where(entered[..., None] & delta, true, tokens[:, first:until])
        return tokens

    def changed(self, moved: Tensor, first: int, stop: int) -> Tensor:
        """Groups of tokens [first, stop) that concern an agent that moved, and only agents that are placed.

        moved (n, P) bool -> (n, P, 1 + slots) bool
        """
        placed = self.placed[first:stop]
        own = (placed & moved)[..., None]
        if not self.model.layout.slots:
            return own
        partner = self.model.layout.partners()
        both, either = placed[..., None] & placed[:, partner], moved[..., None] | moved[:, partner]
        return torch.cat([own, both & either], dim=-1)

    def scene(self, tokens: Tensor, first: int = 0, stop: int | None = None, before: Scene | None = None) -> Scene:
        """Bodies in the world of rows [first, stop) of the finished tokens; by default of all rows.

        `before` is the frame before them, where there is one, which agents that have ended stand still in. Poses
        depend on neighbouring rows (`magnet.generation.chunk_bodies`); those of causal plans on earlier rows alone
        (`magnet.generation.causal_bodies`).
        """
        stop = len(self.known) if stop is None else stop
        if self.causal:
            return finalized_bodies(self, tokens, first, stop)
        return chunk_bodies(self, tokens, first, stop, before)
