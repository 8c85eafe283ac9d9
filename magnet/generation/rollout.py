"""Scenes of any length: sampled, decoded and handed out chunk by chunk, in memory that does not grow."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from magnet.checks import require_whole
from magnet.denoiser.compiled import answered
from magnet.denoiser.core import DenoiserCore
from magnet.denoiser.lean import LeanTransformer, Memory, lean
from magnet.denoiser.options import Sampling
from magnet.denoiser.transformer import is_plain, without_dropout
from magnet.generation.body_guidance import BodyGuidance
from magnet.generation.causal_bodies import finalize_bodies, shown
from magnet.generation.chunk_bodies import settle_of_groups
from magnet.generation.conditioning import (
    Encoders,
    known_tokens,
    mask_unknown,
    occupied,
    receptive_field,
    require_people,
    task_lookahead_limit,
    window_condition,
)
from magnet.generation.expected import Expected, views
from magnet.generation.inputs import check_condition, check_given, check_request, whole_tokens
from magnet.generation.loaded import Loaded, denoiser_of
from magnet.generation.plan import periodic_plan, planned
from magnet.generation.stats import SamplingStats
from magnet.generation.world import WorldState
from magnet.motion.required import require_rate
from magnet.motion.scene import Scene, cat_time
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.packing import count_unseen_writes
from magnet.precision import cpu_by_default, dtype_of, each_cpu_by_default
from magnet.sampling.faint import faint_levels
from magnet.sampling.grid import planning_grid
from magnet.sampling.noise import LEVELS, NoiseStream
from magnet.sampling.options import SamplerOptions
from magnet.sampling.planned_stage import Denoising
from magnet.sampling.sampler import begin, run_stages
from magnet.sampling.schedule import Stage
from magnet.sampling.solvers import History
from magnet.tasks.base import Task, schedule_of
from magnet.tokenizer.carried import Carried

CHUNK = 64
"""Token steps that are decoded at a time, so that scenes of up to 8.5 seconds are one chunk."""

ENCODED = 8
"""Token steps that are encoded at a time where what is final is handed out at once."""

Generators = torch.Generator | Sequence[torch.Generator] | None


@cpu_by_default
def generate(
    model: DenoiserCore | Loaded,
    scene: Scene,
    task: Task,
    context: int,
    frames: int,
    samples: int = 1,
    options: SamplerOptions | None = None,
    generator: Generators = None,
    progress: Callable[[int], None] | None = None,
    stats: SamplingStats | None = None,
    cond: Tensor | None = None,
    slots: int = 0,
) -> Scene:
    """Sample a task.

    Args:
        model: the trained denoiser, or what `magnet.load` returns; its sampler is not read.
        scene: B recordings; only what the task's schedule calls known is read.
        task: plans what is known and what is generated.
        context: frames recorded of everybody, a multiple of 4.
        frames: frames after the context.
        samples: scenes drawn for each recording; sample s of scene b is at b * samples + s.
        options: how to sample; what they leave open is as the model is best sampled.
        generator: source of randomness, on the model's device; or one for each of the B * samples scenes, which
            are then the same whatever else is in the batch.
        progress: told 1 after each denoising step.
        stats: filled with how consistent the sampled tokens are, and how often the network ran.
        cond: what the model is conditioned on, (B, C), or (B, N, C) for each token step of context and frames; see
            `Denoiser.condition`. None, and steps behind the N: nothing.
        slots: slots to plan for at least, such as those of a set of which these are some scenes.

    Returns:
        Scene of B * samples, context + frames frames, the given frames included.

    Raises:
        ValueError: context is not a whole number of tokens, the scene's slots do not fit the model, or in some
            scene nobody is there to be generated, or nobody to be given where the task gives somebody.
    """
    model = denoiser_of(model)
    rollout = Rollout(
        model, scene, task, context, frames, samples, options, generator, progress, stats, cond=cond, slots=slots
    )
    return cat_time(list(rollout.chunks()))


@cpu_by_default
def stream(
    model: DenoiserCore | Loaded,
    scene: Scene,
    task: Task,
    context: int,
    frames: int | None,
    samples: int = 1,
    options: SamplerOptions | None = None,
    generator: Generators = None,
    progress: Callable[[int], None] | None = None,
    stats: SamplingStats | None = None,
    chunk: int | None = None,
    cond: Tensor | None = None,
) -> Iterator[Scene]:
    """Sample a task in consecutive chunks of frames, which together are what `generate` returns.

    A chunk comes when it is final: as late as the decoder looks ahead. Memory does not grow with the scene's length,
    unless a keyframe far ahead decides where everything before it is placed. The recording and chunks that have come
    may be written over. Arguments as for `generate`, and:

    Args:
        frames: None: endless, for tasks that are given nothing after the context.
        chunk: token steps decoded and handed out at a time. Smaller chunks come sooner. With the precision `reference`
            they cost more, and poses differ by rounding. None: all that are final, or 64 where `options` say `settle`,
            which is off here unless they do.

    Raises:
        ValueError: as `generate`; or the task cannot go on without end, or a chunk is no whole number of tokens.
    """
    options = options or SamplerOptions()
    if chunk is None:
        options = options.filled(Sampling(settle="off"))
        chunk = None if options.settle == "off" else CHUNK
    if chunk is not None:
        require_whole("chunk", chunk, 1)
    model = denoiser_of(model)
    require_rate(scene)
    scene = scene.clone()
    rollout = Rollout(
        model, scene, task, context, frames, samples, options, generator, progress, stats, chunk=chunk, cond=cond
    )
    return (made.clone() for made in rollout.chunks())


class Rollout:
    """A scene while it is sampled: the token steps (rows) that may still change, or are needed to decode those that do.

    Rows [first, stop) are held: `tokens` and `mask_noise` (B, n, P, D), the `history` of a multistep solver, and
    `world`. `there` is the number of rows that are given so far.
    """

    online = False

    def __init__(
        self,
        model: DenoiserCore,
        scene: Scene,
        task: Task,
        context: int,
        frames: int | None,
        samples: int = 1,
        options: SamplerOptions | None = None,
        generator: Generators = None,
        progress: Callable[[int], None] | None = None,
        stats: SamplingStats | None = None,
        *,
        chunk: int | None = CHUNK,
        cond: Tensor | None = None,
        slots: int = 0,
    ) -> None:
        check_request(model, scene, context, frames, samples, task)
        count_unseen_writes(model)
        self._plain = is_plain(model.transformer)
        layout = model.layout
        self.model, self.options, self.chunk = model, (options or SamplerOptions()).filled(model.sampling), chunk
        self.scene = scene.replace(given=None).to_float32().to(model.device).pad_agents(layout.agents)
        self.samples, self.progress, self.stats = samples, progress, stats or SamplingStats()
        self.frames = None if frames is None else context + frames
        if self.frames is not None and scene.frames >= self.frames:
            self.scene = whole_tokens(self.scene, self.frames)
        o = self.options
        tokens = model.window if self.frames is None else -(-self.frames // TOKEN_FRAMES)
        past = context // TOKEN_FRAMES
        grid = planning_grid(max(tokens, past), max(occupied(scene), slots), past, model.window, o)
        self.length: float = grid.tokens
        if frames is None:
            schedule, self.plan = periodic_plan(task, grid, layout.agents, self.online)
            self.length = torch.inf
        else:
            schedule = schedule_of(task, grid).padded(layout.agents)
            self.plan = planned(schedule)
        require_people(schedule, self.scene)
        self.known = schedule.known
        self.limits: Tensor | None = None  # how far codes look ahead; matters only where something is given later
        if frames is not None and bool(self.known[past:].any()):
            free = layout.agents - grid.agents
            self.limits = torch.nn.functional.pad(task_lookahead_limit(task, grid), (0, free), value=grid.tokens)
        # The paper read literally: a known token holds its pairs to everybody, also to those not known. It leaks.
        self.related: Tensor | None = None
        if layout.pairwise_noise == "token":
            self.related = torch.zeros_like(self.known)
            self.related[: scene.frames // TOKEN_FRAMES] = True
        check_given(self.scene, self.known, o.any_floor)
        B, P = scene.scenes * samples, layout.agents
        self.noise = NoiseStream((B, P, layout.width), generator, model.device, eta=o.eta, scale=o.noise_scale or 1.0)
        check_condition(cond, scene.scenes, o.guidance.cond_weight)
        self.cond = None if cond is None else cond.to(model.device).repeat_interleave(samples, dim=0)
        self.encoded: dict[tuple[int, ...], Carried] = {}
        self.stats.begin(B)
        self.first = self.stop = self.reached = 0  # one past the last row that has been generated
        self.there: float = self.length
        self.expected = Expected(receptive_field(model)[1])
        self._clean = torch.empty(0)  # what the network said last, of tokens ahead of the window too
        groups = settle_of_groups(options, model.sampling, self.known)
        self.world = WorldState(model, self._given(0, 0), schedule, o, samples, stats, groups)
        self.tokens, self.mask_noise = self.noise.draw(0)
        self.history = None if o.solver == "ddim" else History.empty(self.tokens)
        self.body_guidance = None if o.body_guidance == "off" else BodyGuidance.of(self.world, grid)
        kind = model.device.type
        self._autocast = (kind, torch.get_autocast_dtype(kind), torch.is_autocast_enabled(kind))

    @each_cpu_by_default
    def chunks(self) -> Iterator[Scene]:
        """Everything, chunk by chunk."""
        start, before = 0, None
        for stage, final, needed in self.plan:
            if stage is not None:
                self._run(stage)
            for ready in self._ready(final):
                while start < self.length and ready >= min(start + (self.chunk or 1), self.length):
                    stop = int(min(start + (self.chunk or CHUNK), self.length if self.chunk else ready))
                    made = self._decoded(start, stop, before, needed)
                    yield made if self.frames is None else made.slice(0, self.frames - start * TOKEN_FRAMES)
                    start, before = stop, made.slice(made.frames - 1)

    def _ready(self, final: int) -> Iterator[float]:
        """Rows before which bodies are ready, given those (`final`) before which nothing changes any more.

        Bodies of causal plans are decoded here, block by block, as they are in a live run.
        """
        if not self.world.causal:
            yield self.length if final >= self.length else final - self._margins[1]
            return
        for end in (min(self.reached, final), final):
            while (done := self.first + self.world.finalized) < end:
                yield self._finalize(min(done + CHUNK, end), end)

    @torch.no_grad()
    def _finalize(self, stop: int, end: int) -> int:
        """Finalize the bodies of rows up to `stop`; the tokens before `end` are finished. Returns `stop`."""
        near = min(stop + receptive_field(self.model)[1], end)
        with torch.autocast(self._autocast[0], enabled=False):
            self._bring_in(near)
            expected = self.expected.behind(end) if near == end else None
            finalize_bodies(self.world, self.tokens, stop - self.first, near - self.first, expected)
        return stop

    @property
    def _margins(self) -> tuple[int, int]:
        """Rows before and after a chunk that its poses depend on, through the decoder and the blending of seams."""
        before, after = receptive_field(self.model)
        if self.world.causal:
            return before + 2, 0
        seam = -(-self.options.blend // TOKEN_FRAMES) if self.options.keep_given else 0
        after = after + seam * (self.limits is not None or self.options.precision == "reference")
        return before + seam + 1, max(after, int(bool(self.options.smooth_path)))

    # Each call enters its contexts itself: held across a yield they would apply to the caller too.

    @torch.no_grad()
    def _run(self, stage: Stage) -> None:
        world, self._ahead, self.begins = self.world, stage.ahead, stage.start
        world.saw = shown(world, stage)
        self._ask_for(stage)
        with torch.autocast(self._autocast[0], enabled=False):  # half precision is for the network, not for geometry
            self._bring_in(stage.stop + 1)  # the delta into the token after the window is written too
            held = dataclasses.replace(stage, start=stage.start - self.first)
            world.faint = faint_levels(self.options.guidance, world.known, held, world.since, world.causal)
            what, who, guidance = self._guided_by_condition, world.given.present, self.options.guidance
            how = Denoising(what, who, self.model.layout, guidance, self.noise, self.body_guidance, self.progress)
            rows, faint = (self.tokens, self.mask_noise), lambda _: world.faint
            self.tokens = run_stages(how, [held], *rows, world.make_consistent, self.first, self.history, faint)
        self.reached = max(self.reached, stage.active[1])
        if world.causal and self.expected.most:
            self.expected.keep(stage, *views(self._clean, stage, len(self.tokens)))

    def _ask_for(self, stage: Stage) -> None:
        """Note whose predictions are read: tokens that the stage changes and, in its last step, those behind them."""
        self._steps_left = len(stage.levels) - 1
        # A token that is known may hold pairwise transforms to somebody who is not.
        begins, ends = (self.model.layout.group_levels(levels) for levels in stage.levels[[0, -1]])
        changes = (begins != ends).any(dim=-1)
        self._asked = torch.nn.functional.pad(changes, (0, 0, 0, stage.ahead))
        # Where attention is causal, what lies before the first change is the same in all steps of a stage.
        block, rows = self.model.network.causal_block, changes.any(dim=1).nonzero()[:, 0].tolist() or [0]
        self._packed: LeanTransformer | None = None
        self._memory: Memory | None = Memory(rows[0] // block * block if block else 0, (rows[0], rows[-1] + 1))

    def _network(self) -> Callable[..., Tensor]:
        """What predicts: the transformer as it was trained, or its lean form, which predicts only what is read."""
        network, precision = self.model.transformer, self.options.precision
        smooth = self.options.guidance.smooth  # by a gradient, which packed weights have not
        if precision == "reference" or smooth or not self._plain or dtype_of(network) != torch.float32:
            return network
        asked = self._asked if self.model.posterior is None else None
        packed = self._packed = self._packed or lean(network, precision)  # a stage looks once whether weights changed
        return functools.partial(packed, wanted=asked, memory=self._memory, compiled=self.options.compile)

    def _guided_by_condition(self, noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
        """Classifier-free guidance, where it has a weight: each window is predicted with its condition and without."""
        weight = self.options.guidance.cond_weight
        if not weight:
            return self._denoise(noisy, levels, present)
        clean = self._denoise(*(x.repeat_interleave(2, dim=0) for x in (noisy, levels, present)))
        whole: Tensor = self._clean
        self._clean, clean = (x[0::2] + weight * (x[0::2] - x[1::2]) for x in (whole, clean))
        return clean

    def _denoise(self, noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
        self.stats.add_call(len(noisy))
        self._steps_left -= 1
        if self._steps_left == 0 and self.expected.most and self.world.causal:  # from the block on it is kept
            self._asked |= self._asked.any(dim=1, keepdim=True).cumsum(dim=0) > 0
        if self._ahead:  # nobody's: shown as the mean of pure noise, which tells nothing of anybody
            noisy = torch.nn.functional.pad(noisy, (0, 0, 0, 0, 0, self._ahead))
            levels = torch.nn.functional.pad(levels, (0, 0, 0, self._ahead), value=LEVELS)
        with torch.autocast(*self._autocast), without_dropout(self.model.transformer):
            guided = bool(self.options.guidance.cond_weight)
            cond = window_condition(self.cond, self.begins, len(noisy), noisy.shape[1], guided)
            clean = answered(self.model, noisy, levels, present, cond, self.options.compile)
            clean = self.model.denoise(noisy, levels, present, cond, self._network()) if clean is None else clean
        self._clean = clean.detach().float()
        return clean.float()[:, : clean.shape[1] - self._ahead]

    @torch.no_grad()
    def _decoded(self, start: int, stop: int, before: Scene | None, needed: int) -> Scene:
        """Bodies of the final rows [start, stop); rows that no later chunk or stage needs are released."""
        behind, ahead = self._margins
        with torch.autocast(self._autocast[0], enabled=False):
            self._bring_in(stop + ahead)
            made = self.world.scene(self.tokens, start - self.first, stop - self.first, before)
        surplus = min(stop - behind, needed - 1) - self.first
        if surplus > 0:
            self.world.release(surplus)
            self.tokens, self.mask_noise = self.tokens[:, surplus:], self.mask_noise[:, surplus:]
            self.history = None if self.history is None else self.history.release(surplus)
            self.first += surplus
        given = self._known(start, stop).repeat_interleave(TOKEN_FRAMES, dim=0).to(made.device)
        return made.replace(given=given[None] & made.present[:, None])

    def _bring_in(self, stop: int) -> None:
        """Add rows, whole chunks at a time, until those before `stop` are held."""
        behind, ahead = receptive_field(self.model)
        while self.stop < min(stop, self.there):
            last = int(min(self.stop + (self.chunk or ENCODED), self.there))
            # What is known is encoded with all the neighbours that its codes can depend on.
            low, high = max(self.stop - behind - 1, 0), int(min(last + ahead + 1, self.there))
            known, given = self._known(low, high), self._given(low, high)
            related = None if self.related is None else mask_unknown(self.scene, self.related, low, high)
            part = slice(self.stop - low, last - low)
            limits, packed = self._limits(low, high, part), self.options.precision != "reference"
            encoders = Encoders(low, self.encoded)
            tokens = known_tokens(self.model, given, known, related, limits, packed, part, encoders)
            tokens = tokens.repeat_interleave(self.samples, dim=0)
            init_noise, mask_noise = self.noise.draw(last - self.stop)
            new = begin(tokens, init_noise, known[part], self.model.layout)
            self.tokens = torch.cat([self.tokens, new], dim=1)
            self.history = None if self.history is None else self.history.extend(new)
            self.mask_noise = torch.cat([self.mask_noise, mask_noise], dim=1)
            self.world.extend(given.slice(part.start * TOKEN_FRAMES, part.stop * TOKEN_FRAMES), known[part])
            self.stop = last

    def _given(self, low: int, high: int) -> Scene:
        """Rows [low, high) of the recording, as far as they are known."""
        return mask_unknown(self.scene, self.known, low, high)

    def _limits(self, low: int, high: int, part: slice) -> Tensor | None:
        """Lookahead limits of some of the rows [low, high), counted from `low`; 0 for the others."""
        if self.limits is None:
            return None
        limits = torch.zeros_like(self.limits[low:high])
        limits[part] = (self.limits[low:high][part] - low).clamp(max=high - low)
        return limits

    def _known(self, first: int, stop: int) -> Tensor:
        """Which tokens of the rows [first, stop) are known; none beyond the plan of an endless scene."""
        rows = self.known[first:stop]
        return torch.nn.functional.pad(rows, (0, 0, 0, stop - first - len(rows)))
