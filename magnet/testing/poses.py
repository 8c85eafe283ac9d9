"""The law of poses over time: a pose that was shown does not depend on what the task does not know yet."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from magnet.denoiser.module import Denoiser
from magnet.generation.conditioning import task_lookahead_limit
from magnet.generation.rollout import Rollout
from magnet.motion.scene import Scene, cat_time
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.sampling.noise import NoiseStream
from magnet.sampling.options import SamplerOptions
from magnet.sampling.schedule import Grid, MaskSchedule, Stage
from magnet.tasks.base import Task
from magnet.testing.models import random_scene, tiny_denoiser

AFTER = 4
"""Token steps sampled beyond those that are compared: time enough for what came later to reach back."""
STEPS = 2
"""Denoising steps, which have no part in what is checked; two, so that agents can start one after another."""


def pose_law(task: Task, grid: Grid, options: SamplerOptions | None = None) -> list[int]:
    """Check that no pose of a causal plan depends on what is not known when it is shown.

    The check is made after the first block, and after a block that no longer sees the beginning of the scene. It
    replaces what the task is given later, and the noise of all tokens that an agent has not seen by then. The agent's
    poses up to the end of the block must stay bit-identical.

    Args:
        task: the task with its options.
        grid: what to plan on; sampled with an untrained model, in few steps.
        options: options of sampling beside the grid's sizes.

    Returns:
        The token steps up to which poses were compared; none if the plan is not causal, because then everything given
        is known from the start.

    Raises:
        AssertionError: a pose depends on what is not known yet; names the agent and the frame.
    """
    grid = dataclasses.replace(grid, steps=min(grid.steps, STEPS))
    schedule = task.schedule(grid)
    if not schedule.causal:
        return []
    generator = torch.Generator().manual_seed(3)
    scene, other = (random_scene(1, grid.tokens * TOKEN_FRAMES, grid.agents, generator) for _ in range(2))
    sizes = {each.name for each in dataclasses.fields(Grid)} & {
        each.name for each in dataclasses.fields(SamplerOptions)
    }
    options = dataclasses.replace(options or SamplerOptions(), **{name: getattr(grid, name) for name in sorted(sizes)})
    run = Run(small_model(grid.agents, grid.window), task, grid, options)
    limit = task_lookahead_limit(task, grid)
    blocks = list(blocks_of(schedule))
    chosen = {0, next((n for n, (_, end) in enumerate(blocks) if end > grid.window), len(blocks) - 1)}
    plain = run(scene, max(blocks[number][1] for number in chosen))
    for stages, end in (blocks[number] for number in sorted(chosen)):
        late = schedule.known & (torch.arange(grid.tokens)[:, None] >= limit[end - 1].clamp_min(end))
        unseen = never_shown(schedule, stages)
        for secret in unseen.unique(dim=0):
            changed = run(replaced(scene, other, late), end, secret & ~schedule.known)
            for agent in (unseen == secret).flatten(1).all(dim=1).nonzero()[:, 0].tolist():
                parts = [(plain.body_rot, changed.body_rot), (plain.T_world_root, changed.T_world_root)]
                if not all(torch.equal(*(x[:, : end * TOKEN_FRAMES, agent] for x in pair)) for pair in parts):
                    raise AssertionError(
                        f"{task} on {grid}: poses of agent {agent} before frame {end * TOKEN_FRAMES} depend on what it "
                        "does not know by then"
                    )
    return [blocks[number][1] for number in sorted(chosen)]


@functools.cache
def small_model(agents: int, window: int) -> Denoiser:
    """An untrained model, cached because making it takes longer than sampling."""
    return tiny_denoiser(max_agents=agents, window=window)


def blocks_of(schedule: MaskSchedule) -> Iterator[tuple[Sequence[Stage], int]]:
    """The stages of each block, and where it ends: no later stage generates anything before."""
    begun, reached = 0, 0
    for number, stage in enumerate(schedule.stages):
        reached = max(reached, stage.active[1])
        if all(later.active[0] >= reached for later in schedule.stages[number + 1 :]):
            yield schedule.stages[begun : number + 1], reached
            begun = number + 1


def never_shown(schedule: MaskSchedule, stages: Sequence[Stage]) -> Tensor:
    """Which tokens (N, P) of a block and after it each agent has not been shown, by nobody else either. -> (P, N, P)

    Whoever is made in an earlier stage of the block passes on what it was shown. Of those who are given, and may be
    shown as the model decodes them, only what nobody has been shown is asked.
    """
    P = schedule.agents
    first = min(stage.active[0] for stage in stages)
    seen = torch.zeros(P, schedule.tokens, P, dtype=torch.bool)
    seen[:, :first] = True
    done = torch.zeros(P, dtype=torch.bool)
    for stage in stages:
        window, made = slice(stage.start, stage.stop), stage.levels[0] != stage.levels[-1]
        shown = torch.zeros_like(seen)
        shown[:, window] = True if stage.visibility is None else stage.visibility
        told = seen.clone()
        for agent in made.any(dim=0).nonzero()[:, 0].tolist():
            heard = shown[agent, first:].any(dim=0) & done
            told[agent] |= shown[agent] | seen[heard].any(dim=0)
        seen, done = told, done | made.any(dim=0)
    seen[~done] = seen[done].any(dim=0)
    return ~seen


@dataclass(frozen=True)
class Run:
    """A task sampled again and again, always with the same noise but for what is replaced."""

    model: Denoiser
    task: Task
    grid: Grid
    options: SamplerOptions

    def __call__(self, scene: Scene, rows: int, other: Tensor | None = None) -> Scene:
        """The first rows, and some more. other (N, P) bool, tokens whose noise is another one"""
        context, frames = self.grid.context * TOKEN_FRAMES, (self.grid.tokens - self.grid.context) * TOKEN_FRAMES
        generator = torch.Generator().manual_seed(4)
        stream = Rollout(self.model, scene, self.task, context, frames, 1, self.options, generator, chunk=1)
        if other is not None:
            stream.noise = OtherNoise(stream.noise, other)
        return cat_time(list(itertools.islice(stream.chunks(), min(rows + AFTER, self.grid.tokens))))


def replaced(scene: Scene, other: Scene, tokens: Tensor) -> Scene:
    """A scene that goes on otherwise: as the other in some tokens. tokens (N, P) bool"""
    return scene.with_poses(tokens.repeat_interleave(TOKEN_FRAMES, dim=0), other.body_rot, other.T_world_root)


class OtherNoise(NoiseStream):
    """Another stream's noise, but for some tokens. tokens (N, P) bool"""

    def __init__(self, plain: NoiseStream, tokens: Tensor) -> None:
        super().__init__(plain.shape, torch.Generator().manual_seed(5), plain.device, plain.dtype, plain.eta)
        self.plain, self.tokens, self.row = plain, tokens, 0

    def draw(self, count: int) -> tuple[Tensor, Tensor]:
        init_noise, mask_noise = self.plain.draw(count)
        mine, _ = super().draw(count)
        there = self.tokens[self.row : self.row + count, :, None]
        self.row += count
        return torch.where(there, mine, init_noise), mask_noise

    def drawn(self, first: int, rows: int, draws: Sequence[tuple[int, int, Tensor | None]]) -> Tensor:
        there = self.tokens[first : first + rows, :, None]
        return torch.where(there, super().drawn(first, rows, draws), self.plain.drawn(first, rows, draws))
