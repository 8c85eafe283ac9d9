"""What `--sampler.precision` costs in poses, and the time of an evaluation: each beside the network as it was trained.

    MAGNET_CMU=... python benchmarks/precision.py --ckpt_path duet

Recorded windows of test takes, whose first half is clean and whose second half has one noise level. Of what is
predicted there: the network's output, joints in each person's own frame, and where the partner is. Times are medians in
turn, of the model's sizes and of the paper's.
"""

from __future__ import annotations

import argparse
import functools
import json
import statistics
import time
from collections.abc import Callable

import torch
from pairwise_error import windows
from torch import Tensor

from magnet.cli.provenance import machine
from magnet.denoiser.lean import lean
from magnet.denoiser.module import Denoiser
from magnet.denoiser.options import TransformerOptions
from magnet.denoiser.transformer import Transformer
from magnet.motion.frames import from_9d, to_planar
from magnet.motion.scene import Scene
from magnet.motion.tokens import TokenLayout
from magnet.sampling.noise import add_noise
from magnet.tokenizer.losses import matrices

LEVELS = (20, 100, 300, 600, 1000)


def networks(made: Transformer) -> dict[str, Callable[..., Tensor]]:
    """What predicts with each choice. The last is what `--sampler.precision int8 --sampler.compile true` does."""
    int8 = lean(made, "int8")
    return {
        "float32": lean(made),
        "bf16": lean(made, "bf16"),
        "int8": int8,
        "int8 compiled": functools.partial(int8, compiled=True),
    }


def bodies(model: Denoiser, scene: Scene, clean: Tensor) -> tuple[Tensor, Tensor]:
    """Joints in each person's own frame (B, T, P, 22, 3), and places of partners (B, N, P, S, 4, 2). (B, N, P, D) ->"""
    tokens = model.normalizer.denormalize(clean)
    latent, deltas, pairs = model.layout.unpack(tokens)
    poses = model.tokenizer.decode(latent, scene.betas, deltas)
    turned, frame = matrices(poses)
    joints = model.require_body().forward_kinematics(turned, frame, scene.betas[:, None].expand(*poses.shape[:3], -1))
    return joints, to_planar(from_9d(pairs))[1]


@torch.no_grad()
def errors(model: Denoiser, scene: Scene) -> dict[str, dict[str, float]]:
    """Of each precision against `reference`: share of the output, and centimetres (mean and 99 %, and of partners)."""
    truth = model.normalizer.normalize(model.tokenize(scene)[0])
    half, there = truth.shape[1] // 2, scene.present
    choices = networks(model.transformer)
    found: dict[str, list[tuple[Tensor, Tensor, Tensor]]] = {name: [] for name in choices}
    for level in LEVELS:
        levels = torch.zeros(truth.shape[:3], dtype=torch.long)
        levels[:, half:] = level
        noise = torch.randn(truth.shape, generator=torch.Generator().manual_seed(level))
        noisy = add_noise(truth, noise, model.layout.spread(model.layout.group_levels(levels)))
        whole = model.denoise(noisy, levels, there)
        exact, pairs = bodies(model, scene, whole)
        for name, network in choices.items():
            made = model.denoise(noisy, levels, there, network=network)
            joints, other = bodies(model, scene, made)
            off = (joints - exact).norm(dim=-1)[:, 4 * half :].transpose(1, 2)[there]
            seen = model.layout.group_present(there)[:, None, :, 1:].expand(pairs.shape[:4])[:, half:]
            apart = (other - pairs).norm(dim=-1)[:, half:][seen]
            share = ((made - whole)[:, half:].transpose(1, 2)[there], whole[:, half:].transpose(1, 2)[there])
            found[name].append((share[0].norm() / share[1].norm(), off.flatten(), apart.flatten()))
    return {
        name: {
            "output": float(torch.stack([share for share, _, _ in each]).mean()),
            "joints_cm": 100 * float(torch.cat([off for _, off, _ in each]).mean()),
            "joints_cm_p99": 100 * float(torch.cat([off for _, off, _ in each]).quantile(0.99)),
            "partner_cm": 100 * float(torch.cat([apart for _, _, apart in each]).mean()),
        }
        for name, each in found.items()
    }


@torch.inference_mode()
def times(made: Transformer, scenes: int, rounds: int = 40) -> dict[str, float]:
    """Milliseconds of an evaluation of windows of two people, medians of rounds in turn."""
    layout = made.layout
    present = torch.zeros(scenes, layout.agents, dtype=torch.bool)
    present[:, :2] = True
    noisy = torch.randn(scenes, 16, layout.agents, layout.width)
    levels = torch.full(noisy.shape[:3], 500)
    each: dict[str, Callable[..., Tensor]] = {"reference": made, **networks(made)}
    spent: dict[str, list[float]] = {name: [] for name in each}
    for _ in range(rounds):
        for name, run in each.items():
            begun = time.perf_counter()
            run(noisy, levels, present)
            spent[name].append(time.perf_counter() - begun)
    return {name: 1000 * statistics.median(some[3:]) for name, some in spent.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ckpt_path", default="duet")
    parser.add_argument("--takes", type=int, nargs="+", default=[5, 10, 15])
    parser.add_argument("--limit", type=int, default=24, help="windows at most")
    options = parser.parse_args()
    model = Denoiser.load(options.ckpt_path).eval()
    scene = windows(model, options.takes)
    print(json.dumps(machine()))
    for name, row in errors(model, scene.select(torch.arange(min(options.limit, len(scene.present))))).items():
        print(f"{name}: " + ", ".join(f"{key} {value:.3f}" for key, value in row.items()), flush=True)
    layout = TokenLayout(model.layout.latent, 4, True)
    paper = Transformer(layout, TransformerOptions()).eval()
    for name, made in (("its sizes", model.transformer), ("the paper's sizes", paper)):
        for scenes in (1, 10):
            row = times(made, scenes)
            print(f"{name}, {scenes} scenes, ms: " + ", ".join(f"{key} {value:.1f}" for key, value in row.items()))


if __name__ == "__main__":
    main()
