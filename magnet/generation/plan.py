"""The order in which a scene is generated: a task's stages, and which token steps (rows) are final after each."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch

from magnet.denoiser.core import DenoiserCore
from magnet.generation.loaded import Loaded, denoiser_of
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.sampling.grid import planning_grid
from magnet.sampling.options import SamplerOptions
from magnet.sampling.schedule import Grid, MaskSchedule, Stage
from magnet.tasks.base import Task, schedule_of


class PlannedStage(NamedTuple):
    """A stage, and what is true after it."""

    stage: Stage | None  # None before the first
    final: int  # rows before this one are never generated or moved again
    needed: int  # rows before this one are never shown to the model again


Plan = Iterator[PlannedStage]


def plan_of_scene(
    model: DenoiserCore | Loaded, task: Task, agents: int, context: int, frames: int, options: SamplerOptions
) -> MaskSchedule:
    """What a task knows and makes of a scene, and in which order, where this model samples it with these options.

    Args:
        agents: slots of the scene.
        context: frames given of everybody at the start, whole tokens.
        frames: frames after them.

    Raises:
        ValueError: the task makes no sense at these sizes.
    """
    model = denoiser_of(model)
    return plan_of_frames(task, agents, context, frames, model.window, options.filled(model.sampling))


def plan_of_frames(
    task: Task, agents: int, context: int, frames: int, window: int = 16, options: SamplerOptions | None = None
) -> MaskSchedule:
    """As `plan_of_scene`, of any model that sees `window` token steps."""
    tokens = -(-(context + frames) // TOKEN_FRAMES)
    grid = planning_grid(tokens, agents, context // TOKEN_FRAMES, window, options or SamplerOptions())
    return schedule_of(task, grid)


def planned(schedule: MaskSchedule) -> Plan:
    """The stages of a schedule."""
    stages, end = schedule.stages, schedule.tokens
    if schedule.causal:  # what has been shown is not moved, whatever it leads to
        needed, final = (least(rows, end) for rows in ([s.start for s in stages], [s.active[0] for s in stages]))
    else:
        needed = final = least(first_changed(schedule), end)
    for stage, *rows in zip((None, *stages), final, needed, strict=True):
        yield PlannedStage(stage, *rows)


def least(rows: Sequence[int], end: int) -> list[int]:
    """Minimum of the rows from each one on, then `end`. (S) -> (S + 1)"""
    return list(itertools.accumulate(reversed([*rows, end]), min))[::-1]


def first_changed(schedule: MaskSchedule) -> list[int]:
    """The first row that each stage may change: the first of its window, or of a gap that it closes.

    Where an agent reaches a keyframe its path is warped from its last known row on (see `WorldState`); where nobody
    was known before, everybody is moved.
    """
    known = schedule.known
    row = torch.arange(schedule.tokens)[:, None]
    gap = torch.where(known, row, -1).cummax(dim=0).values + 1
    gap[known.any(dim=1).cumsum(dim=0) == 0] = 0
    arrives = torch.nn.functional.pad(known, (0, 0, 0, 1))[1:]
    found = []
    for stage in schedule.stages:
        window = slice(stage.start, stage.stop)
        closes = arrives[window] & (stage.levels[-1] == 0) & (stage.levels[0] > 0)
        found.append(min([stage.start, *gap[window][closes].tolist()]))
    return found


def periodic_plan(task: Task, grid: Grid, slots: int, online: bool = False) -> tuple[MaskSchedule, Plan]:
    """The schedule of the beginning of an endless scene, and its plan: that of a long scene, its last stages repeated.

    `slots` are the model's, free ones included. `online`: what is given after the context comes as it happens.

    Raises:
        ValueError: the plan depends on the scene's end or is not periodic, or the task looks ahead at what is fed.
    """
    long, longer = (
        schedule_of(task, dataclasses.replace(grid, tokens=grid.context + windows * grid.window)).padded(slots)
        for windows in (6, 7)
    )
    name = type(task).__name__
    later = longer.known[grid.context :]
    if bool(later.any()) and not online:
        raise ValueError(
            f"{name} is given something after the context, so it cannot be endless: give the number of frames"
        )
    if bool(later.any()) and (longer.lookahead or bool((later != later[0]).any())):
        raise ValueError(
            f"{name}: what it is given later cannot be fed as it happens, because the task looks ahead at it"
        )
    pairs = itertools.takewhile(lambda pair: _moved(*pair) == 0, zip(long.stages, longer.stages, strict=False))
    stages = [stage for stage, _ in pairs]
    for period in range(1, len(stages) // 3 + 1):
        late = stages[-2 * period :]
        shift = late[period].start - late[0].start
        earlier = stages[-3 * period : -period]
        if shift > 0 and all(_moved(*pair) == shift for pair in zip(earlier, late, strict=True)):
            return long, _repeated(stages, period, shift, long.causal)
    raise ValueError(f"{name}: its plan is not periodic, so it cannot be endless: give the number of frames")


def _repeated(stages: list[Stage], period: int, shift: int, causal: bool) -> Plan:
    """Some stages, and then the last `period` of them forever, each time `shift` rows later."""
    begun = [(stage, stage.active[0]) for stage in stages]
    rounds = (
        (dataclasses.replace(stage, start=stage.start + number * shift), first + number * shift)
        for number in itertools.count(1)
        for stage, first in begun[-period:]
    )
    everything = itertools.chain(begun, rounds)
    coming = list(itertools.islice(everything, len(stages) + period))

    def turn(stage: Stage | None) -> PlannedStage:
        needed = min(each.start for each, _ in coming)
        return PlannedStage(stage, min(first for _, first in coming) if causal else needed, needed)

    yield turn(None)
    while True:
        stage, _ = coming.pop(0)
        yield turn(stage)
        coming.append(next(everything))


def _moved(a: Stage, b: Stage) -> int | None:
    """By how many rows `b` is later than `a`, if it is the same stage otherwise; else None."""
    return b.start - a.start if a.same_but_start(b) else None
