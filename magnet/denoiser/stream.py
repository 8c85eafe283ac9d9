"""Scenes of any length: sampled, decoded and handed out piece by piece, in memory that does not grow."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from magnet.denoiser.canvas import Canvas, Health
from magnet.denoiser.generation import (
    SamplerOptions,
    known_tokens,
    occupied,
    planning_grid,
    reach,
    require_people,
    scrub,
    task_sight,
)
from magnet.denoiser.inputs import check_given, check_request
from magnet.denoiser.transformer import without_dropout
from magnet.motion.scene import Scene, joined
from magnet.motion.tokens import STRIDE
from magnet.sampling.noise import NoiseStream
from magnet.sampling.sampler import begin, run_stages
from magnet.sampling.schedule import Grid, MaskSchedule, Stage
from magnet.sampling.solvers import History

if TYPE_CHECKING:
    from magnet.denoiser.module import Denoiser
    from magnet.tasks.base import Task

PIECE = 64
"""Token steps that are decoded at a time: scenes of up to 8.5 seconds are one piece."""

Generators = torch.Generator | Sequence[torch.Generator] | None


def generate(
    model: Denoiser,
    scene: Scene,
    task: Task,
    context: int,
    frames: int,
    samples: int = 1,
    options: SamplerOptions | None = None,
    generator: Generators = None,
    progress: Callable[[int], None] | None = None,
    health: Health | None = None,
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
        generator: source of randomness, on the model's device; or one for each of the B * samples scenes, which
            are then the same whatever else is in the batch.
        progress: told 1 after each denoising step.
        health: filled with how well the sampled tokens hang together, and how often the network ran.

    Returns:
        Scene of B * samples, context + frames frames, the given frames included.

    Raises:
        ValueError: context is not a whole number of tokens, the scene's slots do not fit the model, or in some
            scene nobody is there to be generated, or nobody to be given where the task gives somebody.
    """
    return joined(list(stream(model, scene, task, context, frames, samples, options, generator, progress, health)))


def stream(
    model: Denoiser,
    scene: Scene,
    task: Task,
    context: int,
    frames: int | None,
    samples: int = 1,
    options: SamplerOptions | None = None,
    generator: Generators = None,
    progress: Callable[[int], None] | None = None,
    health: Health | None = None,
    piece: int = PIECE,
) -> Iterator[Scene]:
    """Sample a task in consecutive pieces of frames, which make up what `generate` returns.

    Memory holds a piece and its neighbourhood, however long the scene; it grows only where a keyframe far ahead
    decides where everything before it stands. Arguments as for `generate`, and:

    Args:
        frames: None: without end, for tasks that then are given no more than the context.
        piece: token steps decoded and handed out at a time. Smaller pieces come sooner and cost more; poses
            differ by rounding.

    Raises:
        ValueError: as `generate`; or the task cannot go on without end, or a piece has no tokens.
    """
    if piece < 1:
        raise ValueError(f"piece: got {piece}, expected at least 1 token step")
    return Stream(model, scene, task, context, frames, samples, options, generator, progress, health, piece).pieces()


class Stream:
    """A sample in the making: rows (token steps) that may still change or are needed to decode those that do.

    The rows held are [first, stop): `tokens` and `veil` (B, n, P, D), the `history` of a multistep solver, and the
    world in `canvas`.
    """

    def __init__(
        self,
        model: Denoiser,
        scene: Scene,
        task: Task,
        context: int,
        frames: int | None,
        samples: int,
        options: SamplerOptions | None,
        generator: Generators,
        progress: Callable[[int], None] | None,
        health: Health | None,
        piece: int,
    ) -> None:
        check_request(model, scene, context, frames, samples)
        layout = model.layout
        self.model, self.options, self.piece = model, options or SamplerOptions(), piece
        self.scene = scene.replace(given=None).single().to(model.device).pad_agents(layout.agents)
        self.samples, self.progress, self.health = samples, progress, health or Health()
        self.frames = None if frames is None else context + frames
        if self.frames is not None and scene.frames >= self.frames:
            self.scene = whole_tokens(self.scene, self.frames)
        o = self.options
        tokens = model.window if self.frames is None else -(-self.frames // STRIDE)
        past = context // STRIDE
        grid = planning_grid(max(tokens, past), occupied(scene), past, model.window, o)
        self.rows: float = grid.tokens
        if frames is None:
            schedule, self.plan = endless(task, grid, layout.agents)
            self.rows = torch.inf
        else:
            schedule = task.schedule(grid).padded(layout.agents)
            self.plan = planned(schedule)
        require_people(schedule, self.scene)
        self.known = schedule.known
        self.cuts: Tensor | None = None  # how far codes look ahead; matters only where something is given later
        if frames is not None and bool(self.known[past:].any()):
            free = layout.agents - grid.agents
            self.cuts = torch.nn.functional.pad(task_sight(task, grid), (0, free), value=grid.tokens)
        # The paper read literally: a known token holds its relations to everybody, also to those not known. It leaks.
        self.related: Tensor | None = None
        if layout.relation_noise == "token":
            self.related = torch.zeros_like(self.known)
            self.related[: scene.frames // STRIDE] = True
        check_given(self.scene, self.known, o.any_floor)
        B, P = scene.scenes * samples, layout.agents
        self.noise = NoiseStream((B, P, layout.width), generator, model.device, eta=o.eta)
        self.health.begin(B)
        self.first = self.stop = 0
        self.canvas = Canvas(model, scrub(self.scene, self.known, 0, 0), schedule, o, samples, self.health)
        self.tokens, self.veil = self.noise.rows(0)
        self.history = None if o.solver == "ddim" else History.empty(self.tokens)
        kind = model.device.type
        self._autocast = (kind, torch.get_autocast_dtype(kind), torch.is_autocast_enabled(kind))

    def pieces(self) -> Iterator[Scene]:
        """Everything, piece by piece."""
        start, before = 0, None
        for stage, final in self.plan:
            if stage is not None:
                self._run(stage)
            while start < self.rows and final >= min(start + self.piece + self._margins[1], self.rows):
                stop = int(min(start + self.piece, self.rows))
                made = self._decoded(start, stop, before)
                yield made if self.frames is None else made.cut(0, self.frames - start * STRIDE)
                start, before = stop, made.cut(made.frames - 1)

    @property
    def _margins(self) -> tuple[int, int]:
        """Rows before and after a piece that its poses depend on: by its seams, which depend on their neighbours."""
        before, after = reach(self.model)
        seam = -(-self.options.blend // STRIDE) if self.options.paste else 0
        return before + seam + 1, after + seam

    # Contexts are entered anew in each call: while a piece is being looked at they would hold outside too.

    @torch.no_grad()
    def _run(self, stage: Stage) -> None:
        with torch.autocast(self._autocast[0], enabled=False):  # half precision is for the network, not for geometry
            self._bring_in(stage.stop + 1)  # the step into the token behind the window is written too
            self.tokens = run_stages(
                self._denoise,
                [dataclasses.replace(stage, start=stage.start - self.first)],
                self.tokens,
                self.veil,
                self.canvas.given.present,
                self.model.layout,
                self.canvas.settle,
                self.progress,
                self.options.guidance,
                self.noise,
                self.first,
                self.history,
            )

    def _denoise(self, noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
        self.health.add_call(len(noisy))
        with torch.autocast(*self._autocast), without_dropout(self.model.transformer):
            return self.model.denoise(noisy, levels, present).float()

    @torch.no_grad()
    def _decoded(self, start: int, stop: int, before: Scene | None) -> Scene:
        """Bodies of rows [start, stop), which are final; rows that no later piece needs are let go."""
        behind, ahead = self._margins
        with torch.autocast(self._autocast[0], enabled=False):
            self._bring_in(stop + ahead)
            made = self.canvas.scene(self.tokens, start - self.first, stop - self.first, before)
        surplus = stop - behind - self.first
        if surplus > 0:
            self.canvas.release(surplus)
            self.tokens, self.veil = self.tokens[:, surplus:].clone(), self.veil[:, surplus:].clone()
            self.history = None if self.history is None else self.history.release(surplus)
            self.first += surplus
        given = self._known(start, stop).repeat_interleave(STRIDE, dim=0).to(made.device)
        return made.replace(given=given[None] & made.present[:, None])

    def _bring_in(self, stop: int) -> None:
        """Bring in rows, whole pieces at a time, until those before `stop` are held."""
        behind, ahead = reach(self.model)
        while self.stop < min(stop, self.rows):
            last = int(min(self.stop + self.piece, self.rows))
            # What is known is encoded with all the neighbours that its codes can depend on.
            low, high = max(self.stop - behind - 1, 0), int(min(last + ahead + 1, self.rows))
            known = self._known(low, high)
            given = scrub(self.scene, self.known, low, high)
            related = None if self.related is None else scrub(self.scene, self.related, low, high)
            part = slice(self.stop - low, last - low)
            tokens = known_tokens(self.model, given, known, related, self._cuts(low, high, part))[:, part]
            tokens = tokens.repeat_interleave(self.samples, dim=0)
            fresh, veil = self.noise.rows(last - self.stop)
            new = begin(tokens, fresh, known[part], self.model.layout)
            self.tokens = torch.cat([self.tokens, new], dim=1)
            self.history = None if self.history is None else self.history.extend(new)
            self.veil = torch.cat([self.veil, veil], dim=1)
            self.canvas.extend(given.cut(part.start * STRIDE, part.stop * STRIDE), known[part])
            self.stop = last

    def _cuts(self, low: int, high: int, part: slice) -> Tensor | None:
        """How far the codes of some of the rows [low, high) look ahead, counted from `low`; 0 for the others."""
        if self.cuts is None:
            return None
        cuts = torch.zeros_like(self.cuts[low:high])
        cuts[part] = (self.cuts[low:high][part] - low).clamp(max=high - low)
        return cuts

    def _known(self, first: int, stop: int) -> Tensor:
        """Rows [first, stop) of what is known; nothing is, beyond the plan of a scene without end."""
        rows = self.known[first:stop]
        return torch.nn.functional.pad(rows, (0, 0, 0, stop - first - len(rows)))


def whole_tokens(scene: Scene, frames: int) -> Scene:
    """So many frames of a scene and, up to the end of their last token, its last pose held if there are no more."""
    wanted = -(-frames // STRIDE) * STRIDE
    if scene.frames >= wanted:
        return scene
    frame = torch.arange(wanted, device=scene.device).clamp(max=scene.frames - 1)
    valid = None if scene.valid is None else scene.valid[:, frame]
    return scene.replace(body_rot=scene.body_rot[:, frame], T_world_root=scene.T_world_root[:, frame], valid=valid)


# -- the plan ----------------------------------------------------------------------------------

Plan = Iterator[tuple[Stage | None, float]]
"""Stages in their order, each with the row before which nothing changes any more; None before the first."""


def planned(schedule: MaskSchedule) -> Plan:
    """The stages of a schedule."""
    lowest = [*lows(schedule), schedule.tokens]
    final = list(itertools.accumulate(reversed(lowest), min))[::-1]
    yield None, final[0]
    for number, stage in enumerate(schedule.stages):
        yield stage, final[number + 1]


def lows(schedule: MaskSchedule) -> list[int]:
    """For each stage the first row that it may change: its window's, or the first of a gap that it closes.

    An agent that arrives at a keyframe is moved since its last known row (see `Canvas`); where nobody was known
    before, everybody moves along.
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


def endless(task: Task, grid: Grid, slots: int) -> tuple[MaskSchedule, Plan]:
    """The beginning of a scene without end, and its plan: that of a long scene, the end of which is repeated.

    `slots` are the model's, free ones included.

    Raises:
        ValueError: the plan depends on the scene's end, or does not repeat itself.
    """
    long, longer = (
        task.schedule(dataclasses.replace(grid, tokens=grid.context + windows * grid.window)).padded(slots)
        for windows in (6, 7)
    )
    name = type(task).__name__
    if bool(longer.known[grid.context :].any()):
        raise ValueError(f"{name} is given something after the context, so it has an end: say how many frames")
    pairs = itertools.takewhile(lambda pair: _moved(*pair) == 0, zip(long.stages, longer.stages, strict=False))
    stages = [stage for stage, _ in pairs]
    for period in range(1, len(stages) // 3 + 1):
        late = stages[-2 * period :]
        shift = late[period].start - late[0].start
        earlier = stages[-3 * period : -period]
        if shift > 0 and all(_moved(*pair) == shift for pair in zip(earlier, late, strict=True)):
            return long, _repeated(stages, period, shift)
    raise ValueError(f"{name}: its plan does not repeat itself, so it needs an end: say how many frames")


def _repeated(stages: list[Stage], period: int, shift: int) -> Plan:
    """Some stages, of which the last `period` then follow again and again, `shift` rows further on each time."""
    rounds = (
        dataclasses.replace(stage, start=stage.start + number * shift)
        for number in itertools.count(1)
        for stage in stages[-period:]
    )
    everything = itertools.chain(stages, rounds)
    coming = list(itertools.islice(everything, len(stages) + period))
    yield None, min(stage.start for stage in coming)
    while True:
        stage = coming.pop(0)
        yield stage, min(later.start for later in coming[: len(stages) + period])
        coming.append(next(everything))


def _moved(a: Stage, b: Stage) -> int | None:
    """By how many rows b is a, further on; None if it is something else."""
    alike = a.levels.shape == b.levels.shape and torch.equal(a.levels, b.levels)
    if a.hidden is None or b.hidden is None:
        alike = alike and a.hidden is b.hidden
    else:
        alike = alike and torch.equal(a.hidden, b.hidden)
    return b.start - a.start if alike else None
