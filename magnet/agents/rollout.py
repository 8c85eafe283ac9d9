"""One agent's rollout: it generates its own tokens and is told those of the others, as far as they have come."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from magnet.denoiser.core import DenoiserCore
from magnet.generation.conditioning import receptive_field
from magnet.generation.rollout import Rollout
from magnet.generation.settling import PACE, carried_on
from magnet.motion.frames import canonical_frame
from magnet.motion.scene import Scene, cat_time
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.sampling.noise import LEVELS
from magnet.sampling.options import SamplerOptions
from magnet.sampling.schedule import Stage
from magnet.tasks.agentic import AgenticAsync, AgenticSync


@dataclass(frozen=True)
class OwnToken:
    """What an agent has generated of itself.

    Attributes:
        row: token step, counted from the first of the rollout's past.
        motion: (1, 4, 1) the body in the world.
        latent: (C,) what the bodies were decoded from, normalized as the model sees it.
        T_world_can: (4, 4, 4) canonical frames.
    """

    row: int
    motion: Scene
    latent: Tensor
    T_world_can: Tensor


class OwnRollout(Rollout):
    """The part of an agentic task that one agent computes, in its own view.

    What has not come of another agent is unknown, at level K, as what a view hides is; it is filled in when it comes
    (`fill`). With everything there in time, the tokens are those of `AgenticAsync` or `AgenticSync` in one process. Own
    poses are corrected as there (`settle`), out of the bodies that the others have told; theirs stay as they are.

    Args:
        model: the trained denoiser.
        past: one scene of everybody, whole tokens.
        agent: the slot that is generated.
        task: in turns (`AgenticAsync` with offset 1) or in step (`AgenticSync`); blocks of one token.
        options: how to sample.
        generator: source of noise; of the same seed in all processes.
        missing: (N, P) bool, token steps of the past that are not known.

    Raises:
        ValueError: another offset or block, several scenes, no such agent, `settle_blocks`, or what `Rollout` refuses.
    """

    def __init__(
        self,
        model: DenoiserCore,
        past: Scene,
        agent: int,
        task: AgenticAsync | AgenticSync,
        options: SamplerOptions | None = None,
        generator: torch.Generator | None = None,
        missing: Tensor | None = None,
    ) -> None:
        if task.block is None:
            task = dataclasses.replace(task, block=1)
        if task.block != 1 or (isinstance(task, AgenticAsync) and task.offset != 1):
            raise ValueError(f"task: got {task}, expected blocks of one token, and turns with offset 1")
        if past.scenes != 1 or not 0 <= agent < past.agents or not bool(past.present[0, agent]):
            raise ValueError(
                f"past: got {past.scenes} scenes of {past.agents} agents, expected one, agent {agent} in it"
            )
        options = options or SamplerOptions()
        if options.settle_blocks:
            raise ValueError("settle_blocks: got true, expected false: tokens that are told stay as they were made")
        if isinstance(task, AgenticSync):  # who does not see the others is placed by the own deltas
            options = dataclasses.replace(options, placement="integrate")
        super().__init__(model, past, task, past.frames, None, 1, options, generator)
        self.in_step = isinstance(task, AgenticSync)
        self.agent, self.names = agent, past.agents
        self.row = past.frames // TOKEN_FRAMES  # the next that is generated
        with torch.no_grad():
            self._bring_in(self.row)
            self._finalize(self.row, self.row)
        if missing is not None:
            self._forget(missing)

    def _forget(self, missing: Tensor) -> None:
        """Make token steps of the past unknown. missing (N, P) bool"""
        rows, slots = missing.nonzero(as_tuple=True)
        kept = slots != self.agent
        self.world.placed[rows[kept], slots[kept]] = False
        self.world.known[rows[kept], slots[kept]] = False

    def has(self, row: int, slot: int) -> bool:
        """Whether a token is known, or was long ago."""
        return row < self.first or (row < self.stop and bool(self.world.placed[row - self.first, slot]))

    def be_there(self, slot: int, there: bool) -> None:
        """Say that somebody has come or gone."""
        given = self.world.given
        if bool(given.present[0, slot]) != there:
            present = given.present.clone()
            present[0, slot] = there
            self.world.given = given.replace(present=present)
            self.world.there = present[0].nonzero()[:, 0]

    @torch.no_grad()
    def advance(self) -> OwnToken:
        """Generate the next token of the agent from what is known of the others."""
        stage = None
        while stage is None or not bool((stage.levels[0] != stage.levels[-1])[:, self.agent].any()):
            stage, _, needed = next(self.plan)
        row = stage.active[0]
        with torch.autocast(self._autocast[0], enabled=False):
            self._bring_in(row + 1)
        self._run(self._in_own_view(stage))
        if self.in_step:  # whatever has come of the others is of before
            self.world.saw.fill_(False)
        self._expect_others(row)
        self._finalize(row + 1, row + 1)
        local = row - self.first
        latent = self.tokens[0, local, self.agent, : self.model.layout.latent].clone()
        T_world_can = self.world.T_world_can[0, local * TOKEN_FRAMES : (local + 1) * TOKEN_FRAMES, self.agent].clone()
        motion = self._decoded(row, row + 1, None, needed).permute_agents(torch.tensor([self.agent]))
        self.row = row + 1
        return OwnToken(row, motion.replace(given=None, names=()).to("cpu"), latent, T_world_can)

    def _in_own_view(self, stage: Stage) -> Stage:
        """A stage as one agent runs it: others' tokens are as they are, and unknown where they have not come."""
        own = torch.arange(stage.levels.shape[2]) == self.agent
        there = self.world.placed[stage.start - self.first : stage.stop - self.first]
        others = torch.where(there, 0, LEVELS).to(stage.levels)
        levels = torch.where(own, stage.levels, others)
        visible = there | own | ~self.world.given.present[0].cpu()
        visibility = None if bool(visible.all()) else visible.expand(len(own), -1, -1)
        return dataclasses.replace(stage, levels=levels, visibility=visibility)

    def _expect_others(self, row: int) -> None:
        """Others who have not told their frames up to a token step go on as they went, as far as bodies matter."""
        world, local = self.world, row - self.first
        if world.settle is None:
            return
        for slot in (world.given.present[0].cpu() & (torch.arange(len(world.placed[0])) != self.agent)).nonzero():
            told = world.placed[:local, slot[0]].nonzero()
            stop = (int(told[-1]) + 1) * TOKEN_FRAMES if len(told) else 0
            if stop and stop < local * TOKEN_FRAMES:
                low = max(stop - 1 - PACE, 0)
                one = world.given.slice(low, local * TOKEN_FRAMES).permute_agents(slot)
                self._show(stop, slot, carried_on(one, one.present[0], stop - 1 - low).slice(stop - low))

    def _show(self, frame: int, slot: Tensor, motion: Scene) -> None:
        """Somebody's body is this from some frame on. slot (1,), motion (1, f, 1)"""
        given, frames = self.world.given, slice(frame, frame + motion.frames)
        given.body_rot[:, frames, slot] = motion.body_rot.to(given.body_rot)
        given.T_world_root[:, frames, slot] = motion.T_world_root.to(given.T_world_root)

    @torch.no_grad()
    def fill(self, row: int, slot: int, T_world_can: Tensor, latent: Tensor, motion: Scene | None = None) -> bool:
        """Enter a token of somebody else, as an `OwnToken` has it; whether it is of any use still.

        T_world_can (4, 4, 4), latent (C,), motion (1, 4, 1), which only corrections ask for
        """
        if slot == self.agent or row <= self.first or self.has(row, slot):
            return False
        with torch.autocast(self._autocast[0], enabled=False):
            self._bring_in(row + 1)
            local, world, layout = row - self.first, self.world, self.model.layout
            frames = slice(local * TOKEN_FRAMES, (local + 1) * TOKEN_FRAMES)
            world.T_world_can[0, frames, slot] = T_world_can.to(world.T_world_can)
            world.placed[local, slot] = True
            if motion is not None:
                world.known[local, slot] = True  # so that the body stays as it is told
                self._show(frames.start, torch.tensor([slot]), motion)
            stop = min(local + 2, len(world.placed))  # a token that came earlier begins where this one ends
            moved = torch.zeros_like(world.placed)
            moved[local:stop, slot] = world.placed[local:stop, slot]
            held = self.tokens[:, local:stop]
            latents = held.new_zeros(*held.shape[:3], layout.latent)
            made = self.model.tokens_of(latents, world.placed_deltas(local, stop), world.implied(local, stop))
            made[..., : layout.latent] = held[..., : layout.latent]
            made[0, 0, slot, : layout.latent] = latent.to(made)
            changed = layout.spread(world.changed(moved[local:stop], local, stop)).to(made.device)
            self.tokens[:, local:stop] = torch.where(changed, made, held)
        return True

    @torch.no_grad()
    def encode(self, frames: Sequence[Scene]) -> Tensor:
        """The latent of the last of consecutive tokens of one person, known by poses alone. (1, 4, 1) each -> (C,)"""
        wanted = frames[-1 - receptive_field(self.model)[0] :]
        scene = cat_time([each.replace(given=None, valid=None, names=()) for each in wanted]).to(self.model.device)
        packed = self.options.precision != "reference"
        latent = self.model.encode(scene, slice(len(wanted) - 1, len(wanted)), packed)[0, 0]
        rest = latent.new_zeros(1, self.model.layout.width - self.model.layout.latent)
        return self.model.normalizer.normalize(torch.cat([latent, rest], dim=1))[0, : self.model.layout.latent]

    def canonical(self, frames: Scene) -> Tensor:
        """Canonical frames of a token of one person. (1, 4, 1) -> (4, 4, 4)"""
        return canonical_frame(frames.T_world_root)[0, :, 0]
