"""How well a denoiser gives pairwise transforms and deltas back at each noise level, on recorded test takes.

    MAGNET_CMU=... python benchmarks/pairwise_error.py --ckpt_path duet

Every token of a window is shown at one level; in the last row eight tokens are clean, four are at level 800 and are
measured, and four are unknown. One line a level: what is shown, what the network returns, and what its posterior is.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import torch
from torch import Tensor

from magnet.cli.provenance import machine
from magnet.datamodules.cmu import CMU
from magnet.datamodules.options import HeldOutScenes
from magnet.denoiser.module import Denoiser
from magnet.denoiser.pairwise_posterior import PairwisePosterior
from magnet.motion.frames import from_9d, to_planar
from magnet.motion.scene import Scene, concatenate
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.sampling.noise import LEVELS, add_noise

SHOWN = (5, 20, 50, 100, 300, 500)


def windows(model: Denoiser, takes: list[int], overlap: int = 1) -> Scene:
    """Recorded windows of CMU's couples, as long as the model's; with `overlap` 2 each begins amid another."""
    frames = model.window * TOKEN_FRAMES
    test = HeldOutScenes(stride=frames // overlap, horizon_frames=frames - 32)
    data = CMU(singles=False, test_takes=takes, test=test, batch_size=16)
    data.prepare_data()
    data.setup("test")
    return concatenate(list(data.test_dataloader())).pad_agents(model.layout.agents)


def plans(window: int) -> dict[str, tuple[Tensor, slice]]:
    """Levels of a window (N,), and which tokens are measured, by name."""
    block = torch.full((window,), LEVELS)
    block[: window // 2], block[window // 2 : 3 * window // 4] = 0, 800
    even = {str(level): (torch.full((window,), level), slice(None)) for level in SHOWN}
    return {**even, "block at 800": (block, slice(window // 2, 3 * window // 4))}


def errors(model: Denoiser, tokens: Tensor, truth: Tensor, present: Tensor, part: slice) -> tuple[float, float, float]:
    """Mean errors: of pairwise transforms in centimetres and degrees, of deltas in millimetres. (B, N, P, D) x 2"""
    pairs = [
        to_planar(from_9d(model.layout.unpack(model.normalizer.denormalize(x[:, part]))[2])) for x in (tokens, truth)
    ]
    there = model.layout.group_present(present)[:, None, :, 1:, None].expand(pairs[0][0].shape)
    turned = pairs[0][0] - pairs[1][0]
    turned = torch.atan2(turned.sin(), turned.cos()).abs()[there]
    moved = (pairs[0][1] - pairs[1][1]).norm(dim=-1)[there]
    deltas = [
        to_planar(from_9d(model.layout.unpack(model.normalizer.denormalize(x[:, part]))[1]))[1] for x in (tokens, truth)
    ]
    stepped = (deltas[0] - deltas[1]).norm(dim=-1)[present[:, None, :, None].expand(deltas[0].shape[:-1])]
    return 100 * float(moved.mean()), float(turned.mean().rad2deg()), 1000 * float(stepped.mean())


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ckpt_path", default="duet")
    parser.add_argument("--takes", type=int, nargs="+", default=[5, 10, 15])
    parser.add_argument("--out", type=Path, help="JSON to write")
    options = parser.parse_args()
    model = Denoiser.load(options.ckpt_path)
    scenes = windows(model, options.takes)
    truth = model.normalizer.normalize(model.tokenize(scenes)[0])
    posterior = model.posterior or PairwisePosterior(model.layout)
    model.posterior = None
    generator = torch.Generator().manual_seed(0)
    rows = {}
    for name, (plan, part) in plans(model.window).items():
        levels = plan[None, :, None].expand(truth.shape[:3])
        noise = torch.randn(truth.shape, generator=generator)
        noisy = add_noise(truth, noise, model.layout.spread(model.layout.group_levels(levels)))
        alone = model.denoise(noisy, levels, scenes.present)
        fused = posterior(alone, noisy, levels, scenes.present, model.normalizer)
        each = {"shown": noisy, "network": alone, "posterior": fused}
        rows[name] = {how: errors(model, tokens, truth, scenes.present, part) for how, tokens in each.items()}
        told = " | ".join(f"{how} {cm:.1f} cm {deg:.1f} deg, {mm:.1f} mm" for how, (cm, deg, mm) in rows[name].items())
        print(f"level {name}: {told}")
    if options.out:
        facts = {"scenes": scenes.scenes, "checkpoint": options.ckpt_path, "takes": options.takes, **machine()}
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps({"rows": rows, "meta": facts}, indent=1))


if __name__ == "__main__":
    main()
