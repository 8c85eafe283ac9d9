"""What sampling costs: every task, for so many people and scenes at once."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from magnet.body.floor import on_floor
from magnet.denoiser.compiled import answered, records
from magnet.denoiser.core import DenoiserCore
from magnet.generation.rollout import stream
from magnet.generation.stats import SamplingStats
from magnet.motion.frames import from_planar
from magnet.motion.scene import Scene, empty_scene
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.sampling.options import SamplerOptions
from magnet.tasks import registry
from magnet.tokenizer.core import TokenizerCore

Clock = Callable[[], float]
"""Seconds: `time.perf_counter`, or `time.process_time`, which others on the machine disturb less."""

PRODUCTS = ("mm", "_int_mm", "addmm", "bmm", "baddbmm", "convolution", "_scaled_dot_product", "_linear_pointwise")
"""Beginnings of the names of the operators that count: everything that grows with a product of two sizes."""


class Recorder(TorchDispatchMode):
    """Counts every operator that runs within it, and keeps those that are matrix products.

    Attributes:
        operators: how many ran.
        products: the matrix products, ready to be run again.
    """

    def __init__(self) -> None:
        super().__init__()
        self.operators = 0
        self.products: list[Callable[[], Any]] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        self.operators += 1
        if func._schema.name.rpartition("::")[2].startswith(PRODUCTS):
            self.products.append(lambda: func(*args, **kwargs))
        return func(*args, **kwargs)


def products_of(run: Callable[[], Any]) -> tuple[list[Callable[[], Any]], int]:
    """The matrix products that a function runs, and how many operators it runs in all."""
    with torch.no_grad(), Recorder() as recorder:
        run()
    return recorder.products, recorder.operators


def seconds_of(runs: Iterable[Callable[[], Any]], device: torch.device, clock: Clock = time.perf_counter) -> float:
    """How long some functions take together, until the device is done."""
    finished(device)
    began = clock()
    for run in runs:
        run()
    finished(device)
    return clock() - began


def finished(device: torch.device) -> None:
    """Wait until a GPU has done what it was asked."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


CONTEXT = 32
"""Frames that are given of everybody, where a task takes that."""


@dataclass(frozen=True)
class Case:
    """What is measured.

    Attributes:
        task: name in the registry.
        people: agents P in a scene.
        batch: scenes B at once.
        options: of the task, where they differ from its defaults.
    """

    task: str
    people: int
    batch: int
    options: tuple[tuple[str, Any], ...] = ()

    def __str__(self) -> str:
        options = "".join(f", {name} {value}" for name, value in self.options)
        return f"{self.task}, {self.people} people, batch {self.batch}{options}"


@dataclass(frozen=True)
class Speed:
    """What was measured of a case: medians over the rounds.

    Attributes:
        evaluation_ms: one run of the network on the whole batch, views and branches of guidance included.
        floor_ms: its matrix products alone, in the same round.
        floor_ratio: `evaluation_ms` over `floor_ms`, the median of the rounds' ratios.
        operators: tensor operators of an evaluation.
        evaluations_per_frame: runs of the network for each frame of a scene.
        windows_per_frame: windows that went through it for each frame of one scene.
        frames_per_second: of all scenes together.
        first_frame_ms: until the first frames are handed out.
        memory_mib: of the process, after the case.
    """

    evaluation_ms: float
    floor_ms: float
    floor_ratio: float
    operators: int
    evaluations_per_frame: float
    windows_per_frame: float
    frames_per_second: float
    first_frame_ms: float
    memory_mib: float | None


def paper_model() -> DenoiserCore:
    """An untrained denoiser and tokenizer at the paper's sizes: as fast as trained ones, and as good as noise."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        tokenizer, model = TokenizerCore(), DenoiserCore(max_agents=4)
        for part in (tokenizer.vqvae.pose, tokenizer.vqvae.deltas, tokenizer.vqvae.betas):
            part.set(torch.zeros_like(part.mean), torch.ones_like(part.std))
        tokenizer.get_buffer("quantizer.codes").normal_()
        tokenizer.get_buffer("quantizer.initialized").fill_(True)
        model.build(tokenizer)
        model.normalizer.set(torch.zeros_like(model.normalizer.mean), torch.ones_like(model.normalizer.std))
    return model.eval()


def standing(batch: int, frames: int, people: int, device: torch.device) -> Scene:
    """People who stand on the floor in a row, 1 m apart: what a network costs does not depend on how they move.

    What corrections cost does: people under the floor are lifted in every block.
    """
    like = torch.zeros((), device=device)
    scene = empty_scene(batch, frames, people, like)
    place = torch.stack([torch.arange(people) * 1.0, torch.zeros(people)], dim=-1)
    roots = from_planar(torch.zeros(people), place).to(device)
    there = torch.ones(batch, people, dtype=torch.bool, device=device)
    roots = roots.expand(batch, frames, people, 4, 4).clone()
    return on_floor(scene.replace(T_world_root=roots, body_rot=scene.body_rot.clone(), present=there))


def measure(
    model: DenoiserCore,
    case: Case,
    options: SamplerOptions,
    frames: int = 64,
    rounds: int = 3,
    seed: int = 0,
    clock: Clock = time.perf_counter,
) -> Speed:
    """Sample a case some times, and after each the matrix products of one of its evaluations.

    Args:
        model: a denoiser that can sample.
        case: what is sampled.
        options: how.
        frames: sampled after the context.
        rounds: times that it is done, after one that does not count.
        seed: of the noise.
        clock: see `Clock`.

    Raises:
        ValueError: the task cannot be sampled so; says why.
    """
    task = registry.get(case.task)(**dict(case.options))
    context = 0 if case.task in FROM_NOTHING else CONTEXT
    scene = standing(case.batch, context + frames, case.people, model.device)
    stats = SamplingStats()

    def sampled() -> dict[str, float]:
        nonlocal stats
        stats, generator = SamplingStats(), torch.Generator(model.device).manual_seed(seed)
        chunks = stream(model, scene, task, context, frames, 1, options, generator, stats=stats)
        return seconds_to_the_first_and_last(chunks, model.device, clock)

    with watched(model, clock) as watch:
        sampled()
    replays = options.compile and not options.guidance.smooth and records(scene.T_world_root)
    if replays:
        sampled()  # records what the rounds replay; what is watched is not recorded
        with torch.no_grad():
            replays = watch.replayed() is not None
    products, operators = products_of(watch.recorded if replays else watch.again)
    timings: list[dict[str, float]] = []
    for _ in range(rounds):
        if replays:
            timing = sampled()
            with torch.no_grad():
                timing["evaluation"] = seconds_of([watch.replayed], model.device, clock)
        else:
            with watched(model, clock) as watch:
                timing = sampled()
            timing["evaluation"] = watch.seconds / max(watch.calls, 1)
        timing["floor"] = median(seconds_of(products, model.device, clock) for _ in range(5))
        timings.append(timing)

    def middle(name: str) -> float:
        return median(each[name] for each in timings)

    return Speed(
        1000 * middle("evaluation"),
        1000 * middle("floor"),
        median(each["evaluation"] / each["floor"] for each in timings),
        operators,
        stats.calls / frames,
        stats.evaluations / frames,
        case.batch * frames / middle("took"),
        1000 * middle("first"),
        memory_mib(),
    )


def seconds_to_the_first_and_last(chunks: Iterator[Any], device: torch.device, clock: Clock) -> dict[str, float]:
    """How long it takes until the first frames are there, and until all are."""
    finished(device)
    began = clock()
    next(chunks)
    finished(device)
    first = clock() - began
    for _ in chunks:
        pass
    finished(device)
    return {"took": clock() - began, "first": first}


FROM_NOTHING = ("generation",)
"""Tasks that are given no context."""


class Watch:
    """What the network was asked: how often, how long it took, and the last question."""

    def __init__(self, model: DenoiserCore, clock: Clock) -> None:
        self.model, self.ask, self.clock = model, model.denoise, clock
        self.calls, self.seconds = 0, 0.0
        self._last: tuple[Any, ...] = ()

    def denoise(self, *question: Any) -> Tensor:
        """In place of the model's own."""
        self._last = question
        began = self.clock()
        answer = self.ask(*question)
        finished(answer.device)
        self.seconds += self.clock() - began
        self.calls += 1
        return answer

    def again(self) -> Tensor:
        """The last question once more."""
        return self.ask(*self._last)

    def recorded(self) -> Tensor:
        """The last question to the network as it was trained, which is what recordings hold."""
        return self.ask(*self._last[:4])

    def replayed(self) -> Tensor | None:
        """The last question once more, by a recording of it; None where such are not recorded."""
        noisy, levels, present, cond, _ = self._last
        return answered(self.model, noisy, levels, present, cond, compiled=True)


@contextlib.contextmanager
def watched(model: DenoiserCore, clock: Clock) -> Iterator[Watch]:
    """Within it, a watch looks at every evaluation of a model."""
    watch = Watch(model, clock)
    object.__setattr__(model, "denoise", watch.denoise)
    try:
        yield watch
    finally:
        object.__delattr__(model, "denoise")


def memory_mib() -> float | None:
    """Memory that this process holds now; None where the system does not say."""
    if sys.platform != "linux":
        return None
    import os
    from pathlib import Path

    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def cases(
    tasks: Sequence[str],
    people: Sequence[int],
    batches: Sequence[int],
    options: Mapping[str, Mapping[str, Any]] | None = None,
) -> list[Case]:
    """Every combination that makes sense: tasks that make one agent from another need two. `options`: by task."""
    own = {task: tuple((options or {}).get(task, {}).items()) for task in tasks}
    found = [Case(task, P, B, own[task]) for task in tasks for P in people for B in batches]
    return [case for case in found if case.people > 1 or case.task in ALONE]


ALONE = ("joint_future", "generation", "inbetweening", "agentic_sync", "agentic_async")
"""Tasks that one person alone can be sampled by."""


def live_latency(model: DenoiserCore, options: SamplerOptions, seconds: float) -> dict[str, Any]:
    """Latency of a partner who answers each token as it happens, against the clock of the motion.

    The frames of a token are there when the last of them has happened. An answer is late where the next token is there
    before it.

    Returns:
        `median_ms`, `p99_ms`, `jitter_ms` (the standard deviation) and `most_ms` of the answers, how many there were
        and were `late`, and the process's memory at the beginning and the end.
    """
    from magnet.generation.partner import Partner

    past = standing(1, CONTEXT, 2, model.device)
    partner = Partner(model, past, (0,), options, torch.Generator(model.device).manual_seed(0))
    coming = past.slice(CONTEXT - TOKEN_FRAMES)
    period = TOKEN_FRAMES / past.fps
    for _ in range(3):
        partner.answer(coming)
    before, latencies = memory_mib(), []
    began = time.perf_counter()
    for number in range(1, max(round(seconds / period), 1) + 1):
        due = began + number * period
        time.sleep(max(due - time.perf_counter(), 0.0))
        partner.answer(coming)
        latencies.append(1000 * (time.perf_counter() - due))
    ordered = sorted(latencies)
    spread = torch.tensor(latencies).std(correction=0)
    return {
        "answers": len(latencies),
        "median_ms": median(latencies),
        "p99_ms": ordered[min(len(ordered) - 1, int(0.99 * len(ordered)))],
        "most_ms": ordered[-1],
        "jitter_ms": float(spread),
        "late": sum(latency > 1000 * period for latency in latencies),
        "period_ms": 1000 * period,
        "memory_mib": [before, memory_mib()],
    }
