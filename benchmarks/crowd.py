"""What a crowd costs, from two people to two hundred, and how deep its people are in each other.

    python benchmarks/crowd.py --people 2 4 8 16 32 64 128 200 --plot docs/pictures/crowd_cost.png
    python benchmarks/crowd.py --people 200 --frames 900 --out crowd.npz
    python benchmarks/crowd.py --people 200 --frames 1800 --memory docs/pictures/crowd_memory.png

Views a step are what the network looks at; time is that of the processor and of the clock, of sampling and of what is
corrected after it, of whoever is more than the model has slots for. With --memory what is made is kept on the disk
until the end, so that the memory drawn is that of making it.
"""

from __future__ import annotations

import argparse
import os
import resource
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import torch

import magnet.api
from magnet.body.contact import DEEP, deepest
from magnet.generation.crowd import CrowdRollout
from magnet.generation.crowd_settling import settled_moments
from magnet.generation.crowd_start import START
from magnet.generation.stats import SamplingStats
from magnet.metrics import Floating, FootSkating
from magnet.motion.scene import FPS, Scene, cat_time
from magnet.sampling.options import SamplerOptions
from magnet.tasks.joint import JointFuture


class Cost(NamedTuple):
    """Of one crowd: views and milliseconds of processor time a step, frames a second, the process's peak memory."""

    people: int
    steps: int
    views: float
    cpu_ms: float
    fps: float
    cpu_fps: float
    peak_gb: float


def held_gb() -> float:
    """Memory that the process holds now."""
    return int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1]) * resource.getpagesize() / 1e9


class Memory:
    """What the process holds while a crowd is made, after each denoising step; chunks are kept on the disk.

    Attributes:
        held: gigabytes, step by step.
        pieces: files of the chunks.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.held, self.pieces = folder, [held_gb()], list[Path]()

    def step(self, steps: int) -> None:
        self.held += [held_gb()] * steps

    def keep(self, piece: Scene) -> None:
        self.pieces.append(self.folder / f"{len(self.pieces)}.npz")
        piece.save(self.pieces[-1])

    def plot(self, people: int, frames: int, path: Path) -> None:
        from matplotlib.figure import Figure

        seconds = torch.linspace(0, frames / FPS, len(self.held)).tolist()
        for number in range(0, len(self.held), max(len(self.held) // 20, 1)):
            print(f"  {seconds[number]:.1f} s of the crowd, {self.held[number]:.3f} GB")
        figure = Figure(figsize=(5, 2.6), layout="constrained")
        axis = figure.subplots()
        axis.plot(seconds, self.held)
        axis.set(xlabel=f"seconds of {people} people", ylabel="memory, GB", ylim=(0, None))
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=110)


def rolled(
    model: magnet.Model, start: Scene, frames: int, stats: SamplingStats, progress: Callable[[int], None] | None
) -> Iterator[Scene]:
    """A crowd that goes on from a start, chunk by chunk."""
    generator = torch.Generator().manual_seed(1)
    how = model.sampler, generator, progress, stats
    return CrowdRollout(model.denoiser, start, JointFuture(), START, frames, *how).chunks()


def couples(model: magnet.Model, people: int) -> list[Scene]:
    """The couples that crowds of up to so many people begin with."""
    made = model.start_crowd(people, seed=0).plain()
    return [made.permute_agents(torch.arange(first, min(first + 2, people))) for first in range(0, people, 2)]


def sampled(
    model: magnet.Model, groups: list[Scene], people: int, frames: int, spacing: float, memory: Memory | None = None
) -> tuple[Scene, Cost]:
    """A crowd of couples that goes on for so many frames, and what that cost."""
    start = model.start_crowd(people, groups, spacing, seed=0).plain()
    stats, began, used = SamplingStats(), time.perf_counter(), time.process_time()
    pieces, done = [], 0
    for piece in rolled(model, start, frames, stats, None if memory is None else memory.step):
        done += piece.frames
        if memory is None:
            pieces.append(piece)
        else:
            memory.keep(piece)
        took, cpu = time.perf_counter() - began, time.process_time() - used
        print(
            f"  {people} people, {done} frames after {took:.0f} s, {cpu:.0f} s of processor, {held_gb():.2f} GB",
            flush=True,
        )
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    scene = cat_time(pieces if memory is None else [Scene.load(path) for path in memory.pieces])
    scene = settled_moments(scene) if people > model.denoiser.layout.agents else scene
    took, cpu = time.perf_counter() - began, time.process_time() - used
    views = stats.windows / stats.calls
    cost = Cost(people, stats.calls, views, 1000 * cpu / stats.calls, frames / took, frames / cpu, peak)
    return scene, cost


def company(scene: Scene) -> str:
    """How people who began as couples stand, at the start and over the last second, and how their feet do."""
    joints = magnet.api.Motion.of(scene).joints()[0].detach()[:, scene.present[0]]  # (T, P, 22, 3)
    people = joints.shape[1]
    ground = joints[:, :, 0, [0, 2]]
    away, couple = torch.cdist(ground, ground), torch.arange(people) // 2
    stranger = torch.where(couple[:, None] == couple, torch.inf, away).amin(dim=-1)
    own = (ground[:, 0 : people - 1 : 2] - ground[:, 1::2]).norm(dim=-1)
    speed, lowest = ground.diff(dim=0).norm(dim=-1) * FPS, joints[..., 1].amin(dim=-1)
    said = []
    for name, part in (("start", slice(START)), ("end", slice(-START, None))):
        near, height = stranger[part], 100 * lowest[part].mean()
        said.append(
            f"{name}: nearest stranger {near.mean():.2f} m, {100 * float((near < 1).float().mean()):.0f} % under 1 m, "
            f"own partner {own[part].median():.2f} m, {speed[part].mean():.2f} m/s, lowest joint {height:.1f} cm"
        )
    made, present = joints[START:], torch.ones(1, people, dtype=torch.bool)
    for metric in (FootSkating(), Floating()):
        metric.update(made[None, None], made[None], present)
        said += [f"{name} {float(value):.3f}" for name, value in metric.compute().items()]
    return "; ".join(said)


def depths(scene: Scene) -> str:
    """Shares of generated frames with two bodies over 10 cm in each other, counted in three ways."""
    joints = magnet.api.Motion.of(scene.slice(START)).joints()[0].detach()[:, scene.present[0]]
    ground, people = joints[:, :, 0, [0, 2]], joints.shape[1]
    near = (torch.cdist(ground, ground) < 2.2).any(dim=0).triu(1)
    over = torch.zeros(len(joints), people, dtype=torch.bool)
    count = 0
    pairs = near.nonzero().tolist()
    for i, j in pairs:
        deep = deepest(joints[:, i], joints[:, j])[:, 0] > DEEP
        count += int(deep.sum())
        over[:, i] |= deep
        over[:, j] |= deep
    every = len(joints) * people * (people - 1) / 2
    return (
        f"over {100 * DEEP:.0f} cm: {100 * count / every:.4f} % of frames and pairs, "
        f"{100 * count / max(len(joints) * len(pairs), 1):.3f} % of those of pairs who come near, "
        f"{100 * float(over.float().mean()):.3f} % of people's frames, {100 * float(over.any(1).float().mean()):.1f}"
        f" % of frames with anybody; pelvises {joints[..., 0, 1].min():.2f} to {joints[..., 0, 1].max():.2f} m high"
    )


def plotted(costs: list[Cost], path: Path) -> None:
    """Views, processor time a step and memory against people."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 2.9), layout="constrained")
    axes = figure.subplots(1, 3)
    people = [cost.people for cost in costs]
    for axis, label, line in (
        (axes[0], "views a step", [cost.views for cost in costs]),
        (axes[1], "processor time a step, ms", [cost.cpu_ms for cost in costs]),
        (axes[2], "peak memory, GB", [cost.peak_gb for cost in costs]),
    ):
        axis.plot(people, line, "o-")
        axis.set(xlabel="people", ylabel=label, ylim=(0, None))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--people", type=int, nargs="+", default=[2, 4, 8, 16, 32, 64, 128, 200])
    options.add_argument("--frames", type=int, default=16, help="after the first second")
    options.add_argument("--sampler", default="default", help="a preset")
    options.add_argument("--steps", type=int, default=16)
    options.add_argument("--spacing", type=float, default=3.0)
    options.add_argument("--settle", choices=("off", "light", "firm", "hold"), help="(default: as the model says)")
    options.add_argument("--plot", type=Path)
    options.add_argument("--memory", type=Path, help="plot memory over time, of the last number of people")
    options.add_argument("--out", type=Path, help="where the last crowd goes")
    chosen = options.parse_args()
    settle = {} if chosen.settle is None else {"settle": chosen.settle}
    model = magnet.Model(magnet.load().denoiser, SamplerOptions.preset(chosen.sampler, steps=chosen.steps, **settle))
    costs, groups = [], couples(model, max(chosen.people))
    for people in chosen.people:
        with TemporaryDirectory() as folder:
            memory = Memory(Path(folder)) if chosen.memory else None
            scene, cost = sampled(model, groups, people, chosen.frames, chosen.spacing, memory)
        costs.append(cost)
        if memory is not None:
            memory.plot(people, scene.frames, chosen.memory)
        print(
            f"{cost.people} people: {cost.views:.1f} views a step, {cost.cpu_ms:.0f} ms of processor a step, "
            f"{cost.fps:.2f} frames/s, {cost.cpu_fps:.2f} a second of processor; peak {cost.peak_gb:.2f} GB "
            f"({torch.get_num_threads()} threads, load {os.getloadavg()[0]:.1f})",
            flush=True,
        )
        if people > 1:
            print(f"{depths(scene)}\n{company(scene)}", flush=True)
        if chosen.out:
            scene.save(chosen.out)
    if chosen.plot:
        plotted(costs, chosen.plot)


if __name__ == "__main__":
    main()
