"""Bodies together before and after, same seeds: shipped weights as they are best sampled, beside `--sampler plain`.

    MAGNET_CMU=... python benchmarks/bodies.py --scenes 9 --samples 1 --frames 96 --out runs/results/bodies.json
    python benchmarks/bodies.py --ways plain "settle light" "settle firm" shipped "guidance firm" --tasks joint_future

Recorded test takes of two people, which do not overlap; three and four people (`--people`) from nothing, and tasks that
know the past on synthetic scenes. Numbers are those of docs/metrics.md, of generated people alone.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import torch

import magnet
from magnet.body import load_body
from magnet.datamodules.base import MotionDataModule
from magnet.datamodules.cmu import CMU
from magnet.datamodules.synthetic import Synthetic
from magnet.generation.rollout import generate
from magnet.metrics import all_metrics, ground_truth_metrics
from magnet.motion.scene import Scene, concatenate, empty_scene
from magnet.sampling.options import SamplerOptions
from magnet.tasks import registry

SHOWN = [
    "depth_body_over_5cm", "depth_body_over_10cm", "depth_over_10cm", "fs", "toe_still", "toe_speed", "floating",
    "ground_penetration", "fd_pair", "fd", "mpjpe@1s", "div", "hand_contact", "jitter", "border_acceleration",
]  # fmt: skip
CONTEXT = 32


def ways(options: SamplerOptions, which: list[str]) -> dict[str, SamplerOptions]:
    """How is sampled, by the name of its column."""
    plain = replace(options, settle="off", smooth_path=False)
    every = {
        "plain": plain,
        "shipped": options,
        "settle light": replace(options, settle="light"),
        "settle firm": replace(options, settle="firm"),
        "settle blocks": replace(options, settle_blocks=True),
        "guidance light": replace(plain, body_guidance="light"),
        "guidance firm": replace(plain, body_guidance="firm"),
        "both firm": replace(options, body_guidance="firm"),
    }
    return {name: way for name, way in every.items() if name in which}


def held_out(data: MotionDataModule, count: int) -> Scene:
    """Test scenes spread over those of a data set."""
    data.prepare_data()
    data.setup("test")
    scenes = concatenate(list(data.test_dataloader()))
    return scenes.select(torch.linspace(0, scenes.scenes - 1, count).round().long())


def cases(tasks: list[str], people: list[int], count: int) -> list[tuple[str, str, Scene]]:
    """Title, task and scenes of each block of the table."""
    found: list[tuple[str, str, Scene]] = []
    for size in people:
        empty = empty_scene(count, 0, size, torch.zeros(1))
        there = torch.ones(count, size, dtype=torch.bool)
        some = None if size == 2 else held_out(Synthetic(people=[size], test_clips=count), count)
        for name in tasks:
            scenes = empty.replace(present=there) if name == "generation" else some
            if scenes is not None:
                found.append((f"{name}, {size} people", name, scenes))
    if not people:
        takes = held_out(CMU(singles=False), count)
        found = [(name, name, takes) for name in tasks]
    return found


def measured(model, scene: Scene, name: str, frames: int, samples: int, options: SamplerOptions):  # type: ignore[no-untyped-def]
    """Numbers of one task, by name, and its seconds."""
    context = 0 if name == "generation" else CONTEXT
    generators = [torch.Generator().manual_seed(seed) for seed in range(scene.scenes * samples)]
    begun = time.process_time()
    made = generate(model, scene, registry.get(name)(), context, frames, samples, options, generators)
    seconds = time.process_time() - begun
    made = made.permute_agents(torch.arange(scene.agents)).slice(context)
    body = load_body()
    joints = body.joints(made.replace(given=None)).unflatten(0, (scene.scenes, samples)).transpose(0, 1)
    assert made.given is not None
    scored = ~made.given[0]
    metrics = all_metrics()
    truth = body.joints(scene.slice(context, context + frames)) if scene.frames >= context + frames else joints[0]
    metrics.update(joints, truth, scene.present, agents=scored)
    return {key: float(value) for key, value in metrics.compute().items() if value.ndim == 0}, seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=list(registry.names()))
    parser.add_argument("--people", type=int, nargs="+", default=[], help="so many, in place of recorded takes")
    parser.add_argument("--scenes", type=int, default=9)
    parser.add_argument("--samples", type=int, default=1)
    parser.add_argument("--frames", type=int, default=96)
    parser.add_argument("--steps", type=int, help="denoising steps; else as many as the model takes")
    parser.add_argument("--ways", nargs="+", default=["plain", "shipped"])
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    duet = magnet.load("duet")
    sampler = replace(duet.sampler, steps=options.steps or duet.sampler.steps)
    rows, told_of = {}, None
    for title, name, scene in cases(options.tasks, options.people, options.scenes):
        if scene is not told_of and scene.frames:
            truth, told_of = ground_truth_metrics(), scene
            joints = load_body().joints(scene.slice(CONTEXT, CONTEXT + options.frames))
            truth.update(joints[None], joints, scene.present)
            told("recorded", "", {key: float(value) for key, value in truth.compute().items() if value.ndim == 0})
        for way, how in ways(sampler, options.ways).items():
            numbers, seconds = measured(duet.denoiser, scene, name, options.frames, options.samples, how)
            rows[f"{title} | {way}"] = {**numbers, "seconds": seconds}
            told(title, way, rows[f"{title} | {way}"])
    if options.out:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(rows, indent=1))


def told(title: str, way: str, numbers: dict[str, float]) -> None:
    """One row of the table."""
    cells = [f"{numbers[name]:.3f}" if name in numbers else "-" for name in [*SHOWN, "seconds"]]
    print(f"| {title} | {way} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    print(f"| task | way | {' | '.join([*SHOWN, 'seconds'])} |\n|{'---|' * (len(SHOWN) + 3)}")
    main()
