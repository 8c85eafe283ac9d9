"""What a crowd costs, from two people to two hundred, and how deep its people are in each other.

    python benchmarks/crowd.py --people 2 4 8 16 32 64 128 200 --plot crowd.png
    python benchmarks/crowd.py --people 200 --frames 900 --out crowd.npz

Views a step are what the network looks at; time is that of the processor and of the clock, of sampling alone.
"""

from __future__ import annotations

import argparse
import os
import resource
import time
from pathlib import Path
from typing import NamedTuple

import torch

import magnet
from magnet.generation.crowd import CrowdRollout
from magnet.generation.crowd_settling import settled_moments
from magnet.generation.crowd_start import START
from magnet.generation.stats import SamplingStats
from magnet.metrics.body_depth import DEEP, deepest
from magnet.motion.scene import Scene, cat_time
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


def sampled(model: magnet.Model, people: int, frames: int, spacing: float) -> tuple[Scene, Cost]:
    """A crowd of couples that goes on for so many frames, and what that cost."""
    start = model.start_crowd(people, spacing=spacing, seed=0).plain()
    stats, began, used = SamplingStats(), time.perf_counter(), time.process_time()
    generator = torch.Generator().manual_seed(1)
    rollout = CrowdRollout(model.denoiser, start, JointFuture(), START, frames, model.sampler, generator, stats=stats)
    pieces = []
    for piece in rollout.chunks():
        pieces.append(piece)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        done = sum(each.frames for each in pieces)
        print(f"  {people} people, {done} frames after {time.perf_counter() - began:.0f} s, {peak:.2f} GB", flush=True)
    scene = cat_time(pieces)
    scene = settled_moments(scene) if people > model.denoiser.layout.agents else scene
    took, cpu = time.perf_counter() - began, time.process_time() - used
    views = stats.windows / stats.calls
    cost = Cost(people, stats.calls, views, 1000 * cpu / stats.calls, frames / took, frames / cpu, peak)
    return scene, cost


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
    """Views and processor time a step against people."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    people = [cost.people for cost in costs]
    left.plot(people, [cost.views for cost in costs], "o-")
    left.set(xlabel="people", ylabel="views a step")
    right.plot(people, [cost.cpu_ms for cost in costs], "o-")
    right.set(xlabel="people", ylabel="processor time a step, ms")
    figure.savefig(path, dpi=110)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--people", type=int, nargs="+", default=[2, 4, 8, 16, 32, 64, 128, 200])
    options.add_argument("--frames", type=int, default=16, help="after the first second")
    options.add_argument("--sampler", default="default", help="a preset")
    options.add_argument("--steps", type=int, default=16)
    options.add_argument("--spacing", type=float, default=3.0)
    options.add_argument("--plot", type=Path)
    options.add_argument("--out", type=Path, help="where the last crowd goes")
    chosen = options.parse_args()
    model = magnet.Model(magnet.load().denoiser, SamplerOptions.preset(chosen.sampler, steps=chosen.steps))
    costs = []
    for people in chosen.people:
        scene, cost = sampled(model, people, chosen.frames, chosen.spacing)
        costs.append(cost)
        print(
            f"{cost.people} people: {cost.views:.1f} views a step, {cost.cpu_ms:.0f} ms of processor a step, "
            f"{cost.fps:.2f} frames/s, {cost.cpu_fps:.2f} a second of processor; peak {cost.peak_gb:.2f} GB "
            f"({torch.get_num_threads()} threads, load {os.getloadavg()[0]:.1f})",
            flush=True,
        )
        if people > 1:
            print(depths(scene), flush=True)
        if chosen.out:
            scene.save(chosen.out)
    if chosen.plot:
        plotted(costs, chosen.plot)


if __name__ == "__main__":
    main()
