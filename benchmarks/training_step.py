"""How long a training step at the paper's sizes takes: forward, backward, clipping and AdamW, in processor time.

    OMP_NUM_THREADS=1 python benchmarks/training_step.py --precision bf16

It needs nothing of this repository that its first version has not, so PYTHONPATH may name a worktree of 6e17881, which
takes as long as the reference (docs/speed.md). Random weights on smooth random motion: they say time alone.
"""

from __future__ import annotations

import argparse
import statistics
import time
from typing import Any

import roma
import torch

from magnet.denoiser.module import Denoiser
from magnet.motion.scene import Scene
from magnet.tokenizer.module import Tokenizer


def moving(batch: int, people: int, frames: int = 64) -> Scene:
    """People who sway about where they are."""
    seconds = torch.arange(frames) / 30
    bend = torch.sin(2 * torch.randn(batch, 1, people, 21, 3) * seconds.view(1, -1, 1, 1, 1))
    turn = torch.sin(torch.randn(batch, 1, people, 3) + seconds.view(1, -1, 1, 1))
    root = torch.eye(4).expand(batch, frames, people, 4, 4).clone()
    root[..., :3, :3] = roma.rotvec_to_rotmat(0.5 * turn)
    root[..., :3, 3] = torch.randn(batch, 1, people, 3) + 0.3 * turn
    present = torch.ones(batch, people, dtype=torch.bool)
    return Scene(roma.rotvec_to_rotmat(0.5 * bend), root, torch.zeros(batch, people, 10), present)


def trained(what: str, scene: Scene) -> Any:
    """A model of the paper's sizes, ready to be trained."""
    tokenizer: Any = Tokenizer()
    if what == "tokenizer":
        (tokenizer.fit_normalizers if hasattr(tokenizer, "fit_normalizers") else tokenizer.set_statistics)([scene])
        return tokenizer
    model: Any = Denoiser(max_agents=scene.present.shape[1])
    model.build(tokenizer)
    with torch.no_grad():
        tokens = model.tokenize(scene)
        (model.fit_normalizer if hasattr(model, "fit_normalizer") else model.statistics.fit)(*tokens)
    return model


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--what", choices=["denoiser", "tokenizer"], default="denoiser")
    parser.add_argument("--precision", choices=["float32", "bf16"], default="float32")
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--people", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=7)
    given = parser.parse_args()
    torch.manual_seed(0)
    scene = moving(given.batch, given.people)
    model = trained(given.what, scene).train()
    weights = list((model if given.what == "tokenizer" else model.transformer).parameters())
    optimizer, generator = torch.optim.AdamW(weights, lr=1e-4), torch.Generator().manual_seed(0)
    losses = getattr(model, "losses", None) or model._losses
    times = []
    for _ in range(given.rounds + 2):
        start = time.process_time()
        optimizer.zero_grad(set_to_none=True)
        with torch.autocast("cpu", torch.bfloat16, enabled=given.precision == "bf16"):
            loss = model.training_step(scene, 0) if given.what == "tokenizer" else losses(scene, generator)["loss"]
        loss.backward()
        torch.nn.utils.clip_grad_norm_(weights, 0.5)
        optimizer.step()
        times.append(1e3 * (time.process_time() - start))
    millions = sum(weight.numel() for weight in weights) / 1e6
    print(f"{given.what}, {given.precision}: {statistics.median(times[2:]):.0f} ms a step, {millions:.1f} M numbers")


if __name__ == "__main__":
    main()
