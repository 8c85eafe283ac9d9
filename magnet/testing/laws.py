"""Laws that every task keeps, for tests of ours and of task authors."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import torch
from torch import Tensor

from magnet.motion.frames import partners
from magnet.motion.tokens import TokenLayout
from magnet.sampling.faint import faint_levels
from magnet.sampling.guidance import Guidance
from magnet.sampling.noise import LEVELS
from magnet.sampling.planned_stage import Denoising
from magnet.sampling.sampler import begin, run_stages, sample
from magnet.sampling.schedule import Grid, MaskSchedule, Stage
from magnet.sampling.solvers import History
from magnet.tasks.base import Task

TASK_GRIDS = (
    Grid(30, 2, 8, steps=4),
    Grid(20, 3, 4, steps=4, window=8, stride=3),
    Grid(16, 4, 8, steps=3),
    Grid(24, 1, 1, steps=2),
    Grid(12, 2, 0, steps=3, window=8, stride=2, opening=2),
    Grid(9, 3, 0, steps=1),
    Grid(20, 2, 4, steps=6, window=8, pyramid_offset=2),
    Grid(20, 2, 4, steps=6, window=8, pyramid_offset=None),
    Grid(20, 2, 4, steps=9, window=8, pyramid_offset=1),
)
"""Long and short scenes of one to four agents, with a past and without, in strides, rolling and in pyramids."""

POSED = 2
"""On so many of these grids poses are checked too, which takes a second each; in these the window moves."""


def task_laws(task: Task, grids: Sequence[Grid] | None = None, nameless: bool = False) -> list[Grid]:
    """Check a task against the laws that every task obeys; for the tests of those who write tasks.

    - The task is a frozen dataclass with a docstring and a formula. Two plans are equal.
    - Levels never rise. What is known stays clean and comes back bit-identical. Something is generated; it ends clean
      or stays at pure noise. No window is longer than the grid's.
    - What is neither known nor generated yet does not influence the sample, nor do pairs with it.
    - What a stage hides from an agent does not influence what the stage makes of that agent, not through others either.
    - No pose depends on what is not known when it is shown (`magnet.testing.poses.pose_law`).
    - The same seed gives the same sample, and a batch gives what each of its scenes gives alone.

    Args:
        task: the task with its options.
        grids: what to plan on; the task must accept each. None: `TASK_GRIDS`, of which the task may refuse some, but
            not all, with a ValueError.
        nameless: check too that the slots of agents who know the same make no difference: in the plan, and in the
            samples of a model that does not know slots.

    Returns:
        The grids that were checked.

    Raises:
        AssertionError: a law is broken; says which, on which grid, and where.
        ValueError: the task refuses one of `grids`, or all of `TASK_GRIDS`.
    """
    from magnet.testing.poses import pose_law

    _check_record(task)
    checked: list[Grid] = []
    refused: list[str] = []
    for grid in TASK_GRIDS if grids is None else grids:
        try:
            schedule = task.schedule(grid)
        except ValueError as error:
            if _raised_by_schedule(error):
                raise AssertionError(f"{_place(task, grid)}: {error}") from error
            if grids is not None:
                raise
            refused.append(str(error))
            continue
        _check_plan(task, grid, schedule)
        _check_samples(task, grid, schedule)
        check_hidden(task, grid, schedule)
        if grids is not None or len(checked) < POSED:
            pose_law(task, grid)
        if nameless:
            renaming_law(task, task, grid, torch.arange(grid.agents).roll(1))
        checked.append(grid)
    if not checked:
        raise ValueError(f"{type(task).__name__} refuses every grid: {'; '.join(dict.fromkeys(refused))}")
    return checked


def _place(task: Task, grid: Grid) -> str:
    return f"{task} on {grid}"


def _require(holds: object, message: str) -> None:
    """An assertion that python -O does not remove."""
    if not holds:
        raise AssertionError(message)


def _raised_by_schedule(error: BaseException) -> bool:
    """Whether a plan broke a law, and not the task refused the grid."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return trace is not None and trace.tb_frame.f_code is MaskSchedule.__post_init__.__code__


def _check_record(task: Task) -> None:
    name = type(task).__name__
    record = getattr(type(task), "__dataclass_params__", None)
    _require(
        record is not None and record.frozen,
        f"{name}: not an instance of a @dataclass(frozen=True); its options must not change",
    )
    _require((type(task).__doc__ or "").strip(), f"{name}: has no docstring, which is its help on the command line")
    formula = getattr(task, "formula", None)
    _require(
        isinstance(formula, str) and formula.startswith("P("),
        f"{name}: formula {formula!r} does not say what is sampled; write it like P(A_t:t+L | A_0:t-1)",
    )


def _check_plan(task: Task, grid: Grid, schedule: MaskSchedule) -> None:
    place, known = _place(task, grid), schedule.known
    size = (schedule.tokens, schedule.agents)
    _require(size == (grid.tokens, grid.agents), f"{place}: planned {size[0]} tokens of {size[1]} agents")
    _require(known.dtype == torch.bool, f"{place}: known is {known.dtype}, expected bool")
    levels = torch.stack(list(schedule.levels_by_step()))  # (S, N, P)
    rises = (levels.diff(dim=0) > 0).nonzero().tolist()
    _require(not rises, f"{place}: (step, token, agent) {rises[:1]} rises in level")
    _require((levels[:, known] == 0).all(), f"{place}: a known token is not clean throughout")
    _require((levels[0][~known] == LEVELS).all(), f"{place}: an unknown token does not begin at pure noise")
    left = ((levels[-1] != 0) & (levels[-1] != LEVELS)).nonzero().tolist()
    _require(not left, f"{place}: (token, agent) {left[:1]} is left half denoised: end at 0 or stay at {LEVELS}")
    _require((schedule.finished & ~known).any(), f"{place}: nothing is generated")
    for number, stage in enumerate(schedule.stages):
        width = stage.levels.shape[1] + stage.ahead
        _require(width <= grid.window, f"{place}: stage {number} is {width} tokens wide, the window {grid.window}")
        shape = (grid.agents, width - stage.ahead, grid.agents)
        fits = stage.visibility is None or tuple(stage.visibility.shape) == shape
        _require(fits, f"{place}: stage {number}: visibility is not of shape {shape}")
        if stage.visibility is not None:
            agent = torch.arange(grid.agents)
            blind = ~stage.visibility[agent, :, agent].T & (stage.levels[0] != stage.levels[-1])
            _require(not blind.any(), f"{place}: stage {number}: hides from an agent what it generates of itself")
    again = task.schedule(grid)
    same = torch.equal(again.known, known) and len(again.stages) == len(schedule.stages)
    same = same and (again.causal, again.lookahead) == (schedule.causal, schedule.lookahead)
    same = same and all(_same_stage(a, b) for a, b in zip(again.stages, schedule.stages, strict=True))
    _require(same, f"{place}: planned twice, the plans differ; a task must not draw random numbers")


def _same_stage(a: Stage, b: Stage) -> bool:
    return a.start == b.start and a.same_but_start(b)


def _check_samples(task: Task, grid: Grid, schedule: MaskSchedule) -> None:
    place = _place(task, grid)
    layout = TokenLayout(latent=4, agents=grid.agents)
    generator = torch.Generator().manual_seed(1)
    tokens, other = (torch.randn(2, grid.tokens, grid.agents, layout.width, generator=generator) for _ in range(2))
    given = layout.spread(layout.group_levels(torch.where(schedule.known, 0, LEVELS)) == 0)
    present = torch.ones(2, grid.agents, dtype=torch.bool)

    def run(tokens: Tensor) -> Tensor:
        return sample(mixing, schedule, tokens, present, layout, torch.Generator().manual_seed(2), solver="dpmpp_2m")

    plain = run(tokens)
    _require(torch.equal(plain[:, given], tokens[:, given]), f"{place}: known tokens do not come back bit-identical")
    _require(torch.equal(plain, run(tokens)), f"{place}: the same seed gives different samples")
    replaced = run(torch.where(given, tokens, 100 * other))
    _require(torch.equal(plain, replaced), f"{place}: tokens that are not known influence the sample")
    _require(plain.isfinite().all(), f"{place}: samples are not finite")
    each = [[torch.Generator().manual_seed(seed) for seed in (3, 4)] for _ in range(2)]
    both = sample(mixing, schedule, tokens, present, layout, each[0])
    alone = [sample(mixing, schedule, tokens[b : b + 1], present[:1], layout, each[1][b : b + 1]) for b in (0, 1)]
    same = torch.allclose(both, torch.cat(alone), atol=1e-5)
    _require(same, f"{place}: scenes in a batch are sampled otherwise than alone")


def check_hidden(task: Task, grid: Grid, schedule: MaskSchedule, guidance: Guidance | None = None) -> None:
    """Check hiding: change what a stage hides from an agent, in the tokens and in all that the model predicts of it."""
    guidance, layout = guidance or Guidance(), TokenLayout(latent=4, agents=grid.agents)
    shape = (1, grid.tokens, grid.agents, layout.width)
    generator = torch.Generator().manual_seed(1)
    tokens, noise, mask_noise, other = (torch.randn(shape, generator=generator) for _ in range(4))
    present = torch.ones(1, grid.agents, dtype=torch.bool)
    tokens = begin(tokens, noise, schedule.known, layout)
    history = History.empty(tokens)
    faint = functools.partial(faint_levels, guidance, schedule.known, live=schedule.causal)
    last = max((n for n, stage in enumerate(schedule.stages) if stage.visibility is not None), default=-1)
    for number, stage in enumerate(schedule.stages[: last + 1]):
        before, past = tokens, history.copy()
        how = Denoising(mixing, present, layout, guidance)
        tokens = run_stages(how, [stage], before, mask_noise, history=history, faint=faint)
        if stage.visibility is None:
            continue
        window = slice(stage.start, stage.stop)
        every = ~stage.visibility
        for hidden in every.unique(dim=0):
            secret = layout.spread(layout.group_levels(hidden.long()) > 0)  # (W, P, D)
            changed = before.clone()
            changed[:, window] = torch.where(secret, 10 * other[:, window], before[:, window])
            remembered = past.copy()
            remembered.clean[:, window] = torch.where(secret, 10 * other[:, window], past.clean[:, window])

            def lying(noisy: Tensor, levels: Tensor, present: Tensor, secret: Tensor = secret) -> Tensor:
                said = mixing(noisy, levels, present)
                return torch.where(secret, 1 - 3 * said, said)

            # Smoothing follows what is said of everybody, in each agent's own view: not told by what is hidden.
            how = dataclasses.replace(how, denoise=mixing if guidance.smooth else lying)
            after = run_stages(how, [stage], changed, mask_noise, history=remembered, faint=faint)
            alike = ((after == tokens)[:, window] | secret).all(dim=-1).flatten(0, 1).all(dim=0)
            for agent in (every == hidden).flatten(1).all(dim=1).nonzero()[:, 0].tolist():
                message = f"stage {number}: what it hides from agent {agent} influences that agent's tokens"
                _require(alike[agent], f"{_place(task, grid)}: {message}")


def renaming_law(task: Task, renamed: Task, grid: Grid, order: Tensor) -> None:
    """Check that a task treats the same people alike in other slots, in its plan and in its samples.

    Args:
        task: the task with agents in their slots.
        renamed: the same task where agent p is the former agent order[p].
        grid: what to plan on.
        order: (P,) int, a permutation.

    Raises:
        AssertionError: a slot makes a difference.
    """
    place, layout = _place(renamed, grid), TokenLayout(latent=4, agents=grid.agents)
    first, second = task.schedule(grid), renamed.schedule(grid)
    same = len(first.stages) == len(second.stages) and torch.equal(first.known[:, order], second.known)
    _require(same, f"{place}: knows or generates other things for the slots they are in")
    for number, (stage, other) in enumerate(zip(first.stages, second.stages, strict=True)):
        seen = None if stage.visibility is None else stage.visibility[order][:, :, order]
        alike = _same_stage(other, dataclasses.replace(stage, levels=stage.levels[:, :, order], visibility=seen))
        _require(alike, f"{place}: stage {number} treats agents differently for the slots they are in")
    generator = torch.Generator().manual_seed(1)
    shape = (1, grid.tokens, grid.agents, layout.width)
    drawn = [torch.randn(shape, generator=generator) for _ in range(3)]
    plain = sampled_blind(first, layout, grid.agents, drawn)
    moved = sampled_blind(second, layout, grid.agents, [reordered(each, order, layout) for each in drawn])
    alike = torch.allclose(reordered(plain, order, layout), moved, atol=1e-5)
    _require(alike, f"{place}: with the agents in other slots, they are sampled differently")


def sampled_blind(schedule: MaskSchedule, layout: TokenLayout, people: int, drawn: Sequence[Tensor]) -> Tensor:
    """A sample of a model that does not know slots, of people in the first ones.

    drawn: what is given, noise and mask_noise (B, N, P, D) -> (B, N, P, D)
    """
    tokens, noise, mask_noise = drawn
    P = layout.agents
    there = torch.arange(P) < people
    both = there[:, None] & there[partners(P)] if layout.slots else there[:, None]

    def blind(noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
        """Tokens of an agent from its own, its pairs and everybody's, all slots alike."""
        latent, deltas, pairs = layout.unpack(noisy * (1 + levels[..., None] / LEVELS))
        own = torch.cat([latent, deltas.flatten(-2)], dim=-1) * there[:, None]
        pairs = pairs * both[..., None, None]
        everybody = own.sum(dim=2, keepdim=True).mean(dim=1, keepdim=True) / there.sum()
        own = torch.tanh(own.roll(1, dims=1) + everybody + pairs.flatten(3).sum(dim=-1, keepdim=True))
        latent, deltas = own[..., : layout.latent], own[..., layout.latent :].unflatten(-1, deltas.shape[-2:])
        return layout.pack(latent, deltas, torch.tanh(pairs + deltas.mean(dim=(-1, -2))[..., None, None, None]))

    tokens = begin(tokens, noise, schedule.known, layout)
    how = Denoising(blind, there.expand(len(tokens), P), layout)
    return run_stages(how, schedule.stages, tokens, mask_noise)


def reordered(tokens: Tensor, order: Tensor, layout: TokenLayout) -> Tensor:
    """Tokens of the same people in other slots: agent p becomes what agent order[p] was. (B, N, P, D) -> same"""
    latent, deltas, pairs = layout.unpack(tokens)
    P = layout.agents
    whole = pairs.new_zeros(*pairs.shape[:2], P, P, *pairs.shape[4:])
    own, others = torch.arange(P)[:, None], partners(P)
    if layout.slots:
        whole[:, :, own, others] = pairs
        pairs = whole[:, :, order][:, :, :, order][:, :, own, others]
    return layout.pack(latent[:, :, order], deltas[:, :, order], pairs)


def mixing(noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
    """A toy denoiser in which every token depends on all others and on their levels. -> as noisy"""
    pooled = (noisy * (1 + levels[..., None] / LEVELS)).mean(dim=(1, 2), keepdim=True)
    return torch.tanh(noisy.roll(1, dims=1) + noisy.roll(1, dims=2) + pooled)
