"""Whether a denoiser is as lively as what it is shown: how far its predictions spread, at each noise level.

    MAGNET_CMU=... python benchmarks/calm.py --ckpt_path duet --takes 5 10 15

The first half of a window is clean, the second at one level. Of what is predicted there, beside the recording: spread,
its standard deviation over the recorded one, and `slope`, by how much it should be multiplied to err least (regression
of the recording on it). A prediction is an average, so its spread falls with noise. One whose slope is over 1 is calmer
than it need be, and what is sampled with it is calm.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import torch
from pairwise_error import windows
from torch import Tensor

from magnet.cli.provenance import machine
from magnet.denoiser.module import Denoiser
from magnet.motion.tokens import TokenLayout
from magnet.sampling.noise import add_noise

LEVELS = (200, 500, 700, 800, 900, 950, 1000)
GROUND = [6, 8]
"""Of the nine numbers of a transform, its place on the ground."""


def parts(layout: TokenLayout, tokens: Tensor, present: Tensor) -> dict[str, Tensor]:
    """What is compared, of those present and of the second half: latents, and places on the ground. (B, N, P, D)"""
    half = tokens.shape[1] // 2
    latent, deltas, pairs = layout.unpack(tokens)
    last = pairs[:, half - 1 : half, :, :, -1:]
    there = layout.group_present(present)[:, None].expand(-1, half, -1, -1)
    return {
        "latents": latent[:, half:][there[..., 0]],
        "deltas": deltas[:, half:][there[..., 0]][..., GROUND],
        "pairwise": (pairs[:, half:] - last)[there[..., 1:]][..., GROUND],
    }


def spread_and_slope(predicted: Tensor, recorded: Tensor) -> tuple[float, float]:
    """Standard deviation over the recorded one, and slope of the recording on what is predicted. (M, ..., D) each

    >>> spread_and_slope(torch.tensor([[-1.0], [1.0]]), torch.tensor([[-2.0], [2.0]]))
    (0.5, 2.0)
    """
    x, y = predicted - predicted.mean(0), recorded - recorded.mean(0)
    return float((x.square().mean() / y.square().mean()).sqrt()), float((x * y).mean() / x.square().mean())


@torch.no_grad()
def main() -> None:
    """Print a line a level."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ckpt_path", default="duet")
    parser.add_argument("--takes", type=int, nargs="+", default=[5, 10, 15])
    parser.add_argument("--out", type=Path, help="JSON to write")
    options = parser.parse_args()
    model = Denoiser.load(options.ckpt_path)
    scenes = windows(model, options.takes, overlap=2)
    truth = model.normalizer.normalize(model.tokenize(scenes)[0])
    wanted = parts(model.layout, truth, scenes.present)
    generator, rows = torch.Generator().manual_seed(0), {}
    for level in LEVELS:
        levels = torch.zeros(truth.shape[:3], dtype=torch.long)
        levels[:, model.window // 2 :] = level
        noise = torch.randn(truth.shape, generator=generator)
        noisy = add_noise(truth, noise, model.layout.spread(model.layout.group_levels(levels)))
        found = parts(model.layout, model.denoise(noisy, levels, scenes.present), scenes.present)
        rows[level] = {name: spread_and_slope(found[name], wanted[name]) for name in wanted}
        told = " | ".join(f"{name} spread {a:.2f} slope {b:.2f}" for name, (a, b) in rows[level].items())
        print(f"level {level}: {told}", flush=True)
    if options.out:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(
            json.dumps({"machine": machine(), "ckpt_path": options.ckpt_path, "levels": rows}, indent=1)
        )


if __name__ == "__main__":
    main()
