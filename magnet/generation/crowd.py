"""Scenes of more people than a model has slots: each is sampled in a view of the nearest partners.

Tokens, noise, places and bodies are everybody's; only the network sees small groups. In each denoising step everybody
is read from the own view, and one solve places all, so that people who share several views agree on where they are.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from magnet.checks import require_whole
from magnet.denoiser.core import DenoiserCore
from magnet.generation.crowd_room import SMOOTHED, room_made
from magnet.generation.crowd_settling import SettledGroups, bonded_groups, settled_groups, settled_moments
from magnet.generation.crowd_start import START, require_crowd, start_from_nothing
from magnet.generation.crowd_views import PAIR, Window, by_view, gathered, read_from_views, shown_to_views
from magnet.generation.inputs import check_condition
from magnet.generation.loaded import Loaded, denoiser_of
from magnet.generation.rollout import CHUNK, Generators, Rollout
from magnet.generation.separation import Decode
from magnet.generation.stats import SamplingStats
from magnet.motion.frames import from_9d, inverse, project_se2, to_9d, to_planar
from magnet.motion.neighbours import CrowdLayout, CrowdViews, nearest_partners
from magnet.motion.placement import place
from magnet.motion.scene import Scene, cat_time, concatenate
from magnet.motion.tokens import TOKEN_FRAMES, by_frame, by_token
from magnet.precision import cpu_by_default
from magnet.sampling.noise import add_noise
from magnet.sampling.options import SamplerOptions
from magnet.sampling.schedule import Stage, initial_levels
from magnet.tasks.base import Task
from magnet.tasks.joint import Generation, JointFuture

BATCH = 32
"""Views that run through the network at a time, to bound memory."""

BOND = 1.2
"""Metres between two people, on average over the context, up to which they stay partners wherever they go."""

BEHIND = 8
"""Token steps before a block that its bodies are decoded with, to keep them out of each other."""

MOST_HIDING = 16
"""People up to whom a task may hide agents from each other: everybody's view of everybody is their square."""


@cpu_by_default
def generate_crowd(
    model: DenoiserCore | Loaded,
    scene: Scene,
    task: Task,
    context: int,
    frames: int,
    samples: int = 1,
    options: SamplerOptions | None = None,
    generator: torch.Generator | None = None,
    progress: Callable[[int], None] | None = None,
    stats: SamplingStats | None = None,
    cond: Tensor | None = None,
) -> Scene:
    """Sample a task for any number of people; arguments and result as of `magnet.generation.rollout.generate`.

    Scenes and samples are made one after the other. People are kept apart (`firm`, unless `options` say `light`),
    pairs are corrected as a scene of two is (`settle`), and in the end moments in which two still pass through each
    other are settled (`settled_moments`). Of as many people as the model has slots for, or fewer, a single scene is
    what `generate` makes, bit for bit. In tasks that go on live neither is done, for both see what comes later.
    `Generation` from nothing begins with couples on a floor plan (`start_crowd`), from which everybody goes on.

    Raises:
        ValueError: as `generate`; or somebody's start is not known, or the options or the task are not for crowds.
    """
    require_whole("samples", samples, 1)
    check_condition(cond, scene.scenes, 0)  # of all scenes; each rollout gets that of its own, with the weight
    model, made = denoiser_of(model), []
    how = options, generator, progress, stats
    for number in range(scene.scenes * samples):
        which = [number // samples]
        one, said = scene.select(which), None if cond is None else cond[which]
        if scene.agents > model.layout.agents and context == 0 and isinstance(task, Generation):
            require_crowd(model, one, TOKEN_FRAMES, options or SamplerOptions())
            start, rest = start_from_nothing(model, one, options, generator), max(frames - START, TOKEN_FRAMES)
            whole = cat_time(list(CrowdRollout(model, start, JointFuture(), START, rest, *how, cond=said).chunks()))
            nobody = torch.zeros(whole.T_world_root.shape[:3], dtype=torch.bool, device=whole.T_world_root.device)
            whole = whole.replace(given=nobody).slice(0, frames)
        else:
            rollout = CrowdRollout(model, one, task, context, frames, *how, cond=said)
            whole = cat_time(list(rollout.chunks()))
            if rollout.world.causal:  # whoever lives now does not make way for what is to come
                made.append(whole)
                continue
        made.append(settled_moments(whole) if scene.agents > model.layout.agents else whole)
    return concatenate(made)


class CrowdRollout(Rollout):
    """A rollout of one scene whose network sees views of it.

    Where a token has no slot for two people of a view, how they stand is worked out from what the view's ego expects
    of both. `views` are those of now. Arguments as for `Rollout`, of one sample.
    """

    def __init__(
        self,
        model: DenoiserCore,
        scene: Scene,
        task: Task,
        context: int,
        frames: int | None,
        options: SamplerOptions | None = None,
        generator: Generators = None,
        progress: Callable[[int], None] | None = None,
        stats: SamplingStats | None = None,
        *,
        chunk: int | None = CHUNK,
        cond: Tensor | None = None,
    ) -> None:
        self.crowd = scene.agents > model.layout.agents
        if self.crowd:
            options = options or SamplerOptions()
            require_crowd(model, scene, context, options)
            self.settle = options.filled(model.sampling).settle or "off"
            self._settled: SettledGroups = {}
            self._partner_radii = options.crowd_enter, options.crowd_leave
            beside = replace(options.guidance, stabilization_beside=0)  # somebody who is given may be far away
            apart = "firm" if options.apart == "off" else options.apart
            options = replace(options, settle="off", apart=apart, guidance=beside, together=0.0)
        self.viewer, self.model = model, copy.copy(model)  # the same weights with tokens of another layout
        self.model.denoise = self._denoise_in_views  # type: ignore[method-assign, assignment]
        self._guess, self._guess_at = torch.empty(0), 0  # what was predicted last, and the token step it begins with
        people = scene.pad_agents(max(scene.agents, model.layout.agents))
        self._look_around(people, context)
        how = options, generator, progress, stats
        super().__init__(self.model, scene, task, context, frames, 1, *how, chunk=chunk, cond=cond)
        if self.crowd:
            self.world.decode_rows = self._decode_rows
            self.world.steer = None if self.world.causal else self._steer  # nobody gives way to what is not seen yet
        if self.crowd and not bool((self.known[context // TOKEN_FRAMES - 1] | ~self.scene.present[0].cpu()).all()):
            raise ValueError(
                "in a crowd everybody's start must be known, because partners are chosen by place: generation needs "
                "context 0, partner_inpainting own_past; joint_future goes on from what start_crowd makes"
            )

    def _look_around(self, scene: Scene, context: int) -> None:
        """Choose everybody's first partners."""
        P, slots = scene.agents, self.viewer.layout.agents
        person = torch.arange(P, device=self.viewer.device)
        self._present = scene.present[0].to(self.viewer.device)
        if self.crowd:
            stood = scene.slice(0, context).T_world_root[0][..., [0, 2], 3].to(self.viewer.device)  # (T, P, 2)
            stood = torch.where(self._present[:, None], stood, 0.0)
            away = (stood[:, :, None] - stood[:, None]).norm(dim=-1).mean(dim=0)
            both = self._present[:, None] & self._present & (person[:, None] != person)
            self._bonds = (away < BOND) & both
            nobody = person[:, None].repeat(1, slots - 1)
            table = nearest_partners(stood[-1], self._present, nobody, self._bonds, *self._partner_radii)
        else:
            table = self.viewer.layout.partners(self.viewer.device)
        self._point(table)

    def _point(self, table: Tensor) -> None:
        """Point tokens at these partners."""
        self.model.layout = CrowdLayout.of(self.viewer.layout, table)
        self.views = CrowdViews.of(table, self._present, self.viewer.layout.agents)

    # -- partners change ---------------------------------------------------------------------------

    @torch.no_grad()
    def _run(self, stage: Stage) -> None:
        if self.crowd:
            if stage.visibility is not None and len(self._present) > MOST_HIDING:
                raise ValueError(
                    f"this task hides people from each other, which takes the square of their number: got "
                    f"{len(self._present)} people, expected at most {MOST_HIDING}; joint_future and motion_control "
                    "take hundreds"
                )
            with torch.autocast(self._autocast[0], enabled=False):
                self._bring_in(stage.stop + 1)
                self._choose_partners(stage)
        super()._run(stage)

    def _choose_partners(self, stage: Stage) -> None:
        """Change partners by where everybody stood last, and the slots of tokens that are not final with them."""
        begins = stage.active[0] - self.first
        row = torch.arange(begins)[:, None]
        last = torch.where(self.world.placed[:begins], row, -1).amax(dim=0).clamp_min(0).to(self.viewer.device)
        person = torch.arange(len(last), device=last.device)
        T_world_now = self.world.T_world_can[0, last * TOKEN_FRAMES + TOKEN_FRAMES - 1, person]
        before = self.model.layout.partners(last.device)
        table = nearest_partners(to_planar(T_world_now)[1], self._present, before, self._bonds, *self._partner_radii)
        who, slot = (table != before).nonzero(as_tuple=True)
        if not len(who):
            return
        self._point(table)
        meets = table[who, slot]
        keep = meets != who
        if bool(keep.any()):
            self.meet(stage, T_world_now, who[keep], slot[keep], meets[keep])

    def meet(self, stage: Stage, T_world_now: Tensor, who: Tensor, slot: Tensor, meets: Tensor) -> None:
        """Write new partners into tokens from the window on: as placed, or as expected with noise of their level.

        T_world_now (P, 4, 4) where everybody was last; who, slot, meets (C,) int: a person, the slot, the new partner.
        """
        start, active = stage.start - self.first, stage.active[0] - self.first
        levels = initial_levels(self._known(stage.start, self.stop))
        levels[: len(stage.levels[0])] = stage.levels[0]
        levels = levels.to(who.device)
        level = torch.maximum(levels[:, who], levels[:, meets])  # (n, C)
        numbers = self.viewer.layout.latent + PAIR * (1 + slot[:, None]) + torch.arange(PAIR, device=slot.device)
        T_world_can = self._expected(stage, T_world_now, start, active)
        T_self_partner = inverse(T_world_can[:, who]) @ T_world_can[:, meets]  # (4 n, C, 4, 4)
        pairs = by_token(to_9d(T_self_partner)[None])[0].flatten(-2)
        mean, std = self._pair_statistics()
        clean = (pairs - mean) / std
        at = (slice(start, None), who[:, None], numbers)
        noisy = add_noise(clean, self.mask_noise[0][at], level[..., None])
        self.tokens[0][at] = torch.where(level[..., None] == 0, clean, noisy)
        if self.history is not None:
            self.history.clean[0][at] = clean
            cells = (at[0], at[1].cpu(), numbers.cpu())  # levels are planned on the CPU
            self.history.levels[cells] = -1  # nothing has been predicted of this partner
        guess = self._guessed(stage.start, len(clean))
        guess[:, who[:, None], numbers] = clean
        self._guess, self._guess_at = guess, stage.start

    def _expected(self, stage: Stage, T_world_now: Tensor, start: int, active: int) -> Tensor:
        """Where people stand from the window on: as placed, else by the deltas predicted last. -> (4 n, P, 4, 4)"""
        T_world_can = self.world.T_world_can[0, start * TOKEN_FRAMES :].clone()
        guess = self._guessed(stage.active[0], self.tokens.shape[1] - active)
        _, deltas, _ = self.viewer.parts_of(guess)
        placed = self.world.rows_by_frame(self.world.placed[active:])
        ahead = place(project_se2(from_9d(by_frame(deltas[None]))), None, T_world_now[None])[0]
        new = slice((active - start) * TOKEN_FRAMES, None)
        T_world_can[new] = torch.where(placed[..., None, None], T_world_can[new], ahead)
        return T_world_can

    def _guessed(self, first: int, rows: int) -> Tensor:
        """What was predicted last of some token steps; 0 where nothing was. -> (n, P, D)"""
        guess = self.tokens.new_zeros(rows, *self.tokens.shape[2:])
        low, high = max(first, self._guess_at), min(first + rows, self._guess_at + len(self._guess))
        if high > low:
            guess[low - first : high - first] = self._guess[low - self._guess_at : high - self._guess_at]
        return guess

    def _pair_statistics(self) -> tuple[Tensor, Tensor]:
        """Mean and deviation of a pairwise transform's numbers, the same for all slots. (36,) each"""
        numbers = slice(self.viewer.layout.latent + PAIR, self.viewer.layout.latent + 2 * PAIR)
        return self.viewer.normalizer.mean[numbers], self.viewer.normalizer.std[numbers]

    def _decode_rows(self, tokens: Tensor, first: int, stop: int) -> Decode:
        """Decodes rows [first, stop), or the first of them, with those before and what is expected of those behind.

        Alone they would be decoded to bodies whose hands and feet are up to 20 cm from where they are shown in the end.
        """
        tokenizer = self.viewer.tokenizer
        low, begins = max(first - BEHIND, 0), self.first + stop
        held = self.model.parts_of(tokens[:, low:first])[0]
        before = held, self.world.placed_deltas(low, first)
        ahead = self._guessed(begins, max(self._guess_at + len(self._guess) - begins, 0))
        latent, deltas, _ = self.viewer.parts_of(ahead[None])
        behind = tokenizer.requantize(latent) if self.viewer.quantized else latent, deltas

        def decode(latent: Tensor, betas: Tensor, deltas: Tensor) -> Tensor:
            rows = latent.shape[1]
            parts = [before, (latent, deltas), *([behind] if rows == stop - first else [])]
            latents, steps = (torch.cat(each, dim=1) for each in zip(*parts, strict=True))
            poses = tokenizer.decode(latents, betas, steps)
            return poses[:, (first - low) * TOKEN_FRAMES :][:, : rows * TOKEN_FRAMES]

        return decode

    def _steer(self, rows: slice, new: Tensor) -> None:
        """Whom a stage has placed makes room for strangers; not those on the way to a keyframe. new (n, P) bool"""
        new = new & ~self.world.known[rows.stop] if rows.stop < len(self.world.known) else new
        lead = min(SMOOTHED, rows.start * TOKEN_FRAMES)  # frames before, by which everybody walks
        frames = slice(rows.start * TOKEN_FRAMES - lead, rows.stop * TOKEN_FRAMES)
        may = torch.nn.functional.pad(self.world.rows_by_frame(new), (0, 0, lead, 0)).to(self._present.device)
        here = self.world.T_world_can[:, frames]
        self.world.T_world_can[:, frames] = room_made(here, may, self._bonds, self._present)

    def _decoded(self, start: int, stop: int, before: Scene | None, needed: int) -> Scene:
        made = super()._decoded(start, stop, before, needed)
        if not self.crowd or self.settle == "off" or self.world.causal:  # a chunk's later frames are not seen yet there
            return made
        groups = bonded_groups(self._bonds, self._present, self.viewer.layout.agents)
        made, self._settled = settled_groups(made, groups, self.settle, self._settled)
        return made

    # -- the network sees views --------------------------------------------------------------------

    def _ask_for(self, stage: Stage) -> None:
        super()._ask_for(stage)
        if self.crowd:  # whoever is asked for may be in any slot
            self._asked = self._asked.any(dim=1, keepdim=True).repeat(1, self.viewer.layout.agents)
            self._memory = None

    def _denoise_in_views(
        self, noisy: Tensor, levels: Tensor, present: Tensor, cond: Tensor | None, network: Callable[..., Tensor]
    ) -> Tensor:
        """As `Denoiser.denoise`, in views. noisy (R, W, P, D) -> (R, W, P, D)"""
        R, V = len(noisy), len(self.views.people)
        self.stats.windows += R * (V - 1)
        latent = self.viewer.layout.latent
        if self.crowd:
            shown, each = shown_to_views(self._window(noisy.shape[1]), noisy, levels)
        else:
            own, about, each = gathered(self.views, latent, noisy, levels)
            shown, each = by_view(torch.cat([own, about.flatten(-2)], dim=-1)), by_view(each)
        there = self.views.present.expand(R, -1, -1).flatten(0, 1)
        cond = None if cond is None else cond.repeat_interleave(V, dim=0)
        made = torch.empty_like(shown)
        for some in self._batches(each, there):
            extra = None if cond is None else cond[some]
            made[some] = self.viewer.denoise(shown[some], each[some], there[some], extra, network).to(made)
        clean = read_from_views(self.views, latent, made.float().unflatten(0, (R, V)))
        if self.crowd:
            self._guess, self._guess_at = clean[0].detach(), self.begins
        return clean

    def _batches(self, levels: Tensor, present: Tensor) -> list[Tensor]:
        """Numbers of the views that run together. levels (V, W, M), present (V, M)

        Views that are alike in both share a batch where the model has a posterior, which then solves for all at once.
        """
        order = torch.arange(len(levels), device=levels.device)
        if not self.crowd or self.viewer.posterior is None:
            return list(order.split(BATCH))
        kind = torch.cat([levels.flatten(1), present], dim=1).unique(dim=0, return_inverse=True)[1]
        return [some for number in kind.unique().tolist() for some in order[kind == number].split(BATCH)]

    def _window(self, rows: int) -> Window:
        """What is known in the rows that the network is asked about."""
        device, table = self.viewer.device, self.model.layout.partners(self.viewer.device)
        T_world_can = self.world.T_world_can[0].unflatten(0, (-1, TOKEN_FRAMES))
        row = torch.arange(rows, device=device) + self.begins - self.first
        placed = T_world_can[row.clamp(max=len(T_world_can) - 1)]  # what lies ahead is nobody's
        guess, (mean, std) = self._guessed(self.begins, rows), self._pair_statistics()
        return Window(self.views, table, self.viewer.layout.latent, mean, std, guess, placed)
