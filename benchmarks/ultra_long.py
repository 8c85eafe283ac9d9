"""Memory and speed of scenes of any length, and whether their people are still upright and together at the end.

    python benchmarks/ultra_long.py                                  # an untrained toy: 1,800 and 20,000 frames
    python benchmarks/ultra_long.py --model duet --frames 1800       # the model that comes with the package

Each line is a run in a process of its own. `grown` is by how much the process was at most larger than after its
first chunk of frames: it says whether a longer scene needs more memory. `plan` is what came before that.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time
from typing import Any

import torch

from magnet.datamodules.synthetic import Synthetic
from magnet.denoiser.module import Denoiser
from magnet.generation.blending import cat_time
from magnet.generation.rollout import stream
from magnet.generation.stats import SamplingStats
from magnet.motion.scene import Scene
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.sampling.options import SamplerOptions
from magnet.sampling.schedule import Grid
from magnet.tasks import Task, registry
from magnet.testing import random_scene, tiny_denoiser

TOY = "toy"
CONTEXT = 4  # frames, as in the paper's ultra-long runs
CLIP = 300  # frames of the synthetic clip that a context is cut from
MIB = 2**20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", default=TOY, help="name or checkpoint of a trained model, or `toy`")
    parser.add_argument("--frames", type=int, nargs="+", default=[1800, 20_000], help="lengths to measure")
    parser.add_argument("--task", default="joint_future", help="name of a task, as `magnet tasks` lists them")
    parser.add_argument("--steps", type=int, help="denoising steps; the toy's default is 2, a model's 30")
    parser.add_argument("--pyramid_offset", type=int, default=None, help="denoising steps between a token and the next")
    parser.add_argument("--coupling", default="circle", help="what the synthetic people in the context do")
    parser.add_argument("--people", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--save", help="write the scene there, as npz; it is then held in memory whole")
    options = parser.parse_args()
    if len(options.frames) == 1:
        measure(options)
        return
    for frames in options.frames:
        subprocess.run([sys.executable, __file__, *words({**vars(options), "frames": frames})], check=True)


def words(options: dict[str, Any]) -> list[str]:
    """Options as one writes them."""
    given = {name: value for name, value in options.items() if value is not None}
    return [word for name, value in given.items() for word in (f"--{name}", str(value))]


def measure(options: argparse.Namespace) -> None:
    """One run, one line."""
    (frames,) = options.frames
    task = registry.get(options.task)()
    model = tiny_denoiser(max_agents=2, window=16) if options.model == TOY else Denoiser.load(options.model)
    context = 0 if options.task == "generation" else CONTEXT
    sampler = SamplerOptions(
        steps=options.steps or (2 if options.model == TOY else 30), pyramid_offset=options.pyramid_offset
    )
    stats = SamplingStats()
    scene = recorded(options, frames if given_later(task, context) else context)
    empty = resident()
    began = time.perf_counter()
    chunks = stream(
        model,
        scene,
        task,
        context,
        frames - context,
        options=sampler,
        generator=torch.Generator().manual_seed(options.seed),
        stats=stats,
    )
    first = last = next(chunks)
    kept: list[Scene] = [first]
    planned = most = resident()
    seen, finite = first.frames, True
    for chunk in chunks:
        most, seen, last = max(most, resident()), seen + chunk.frames, chunk
        if options.save:
            kept.append(chunk)
        finite &= bool(chunk.T_world_root.isfinite().all() and chunk.body_rot.isfinite().all())
    seconds = time.perf_counter() - began
    assert seen == frames, f"{seen} frames instead of {frames}"
    print(
        f"{options.model} {options.task}: {frames} frames, {frames / seconds:.1f} frames/s, "
        f"plan {(planned - empty) / MIB:.0f} MiB, grown {(most - planned) / MIB:.0f} MiB, "
        f"peak {peak() / MIB:.0f} MiB, finite {finite}, {stats.means()}"
    )
    for name, chunk in (("first", first.slice(context)), ("last", last)):
        print(f"  {name} chunk: {looks(chunk)}")
    if options.save:
        print(f"  saved: {cat_time(kept).save(options.save)}")


def given_later(task: Task, context: int) -> bool:
    """Whether the task is given motion after the context too, to the end of the scene."""
    past = context // TOKEN_FRAMES
    return bool(task.schedule(Grid(past + 32, 2, past)).known[past:].any())


def recorded(options: argparse.Namespace, frames: int) -> Scene:
    """What the task may be given, and no more; at least a few frames, for who is there."""
    frames = max(-(-frames // TOKEN_FRAMES) * TOKEN_FRAMES, CONTEXT)
    if options.model == TOY:
        return random_scene(1, frames, 2, torch.Generator().manual_seed(1))
    clip = max(frames, CLIP)
    data = Synthetic(couplings=[options.coupling], people=[options.people], test_clips=1, clip_frames=clip)
    return data.clips("test")[0].scene.slice(0, frames)


def looks(scene: Scene) -> str:
    """Pelvis heights, how upright people are, how fast, how far from each other."""
    there = scene.present[0]
    root = scene.T_world_root[0][:, there]
    height, up, place = root[..., 1, 3], root[..., 1, 1], root[..., [0, 2], 3]
    speed = (place[1:] - place[:-1]).norm(dim=-1) * scene.fps
    text = (
        f"pelvis {height.min():.2f} to {height.max():.2f} m high, upright at least {up.min():.2f}, "
        f"speed {speed.mean():.2f} m/s"
    )
    if int(there.sum()) > 1:
        apart = torch.cdist(place, place)[:, *torch.triu_indices(int(there.sum()), int(there.sum()), 1)]
        text += f", {apart.median():.2f} m apart"
    return text


def resident() -> int:
    """Bytes that this process holds now."""
    with open("/proc/self/statm", encoding="utf-8") as file:
        return int(file.read().split()[1]) * resource.getpagesize()


def peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


if __name__ == "__main__":
    main()
