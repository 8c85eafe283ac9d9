"""What people, free slots, the window and the past cost: a plot and its numbers, by one command.

    OMP_NUM_THREADS=1 python benchmarks/cost.py --out docs/pictures/cost.svg

One evaluation of an untrained network of the shipped size, as it is sampled with (`lean`), for so many people, so
many slots with two people in them, and so many token steps; and a live partner's answers after so many others.
Milliseconds of processor time of one thread, medians; the rounds go through all cases in turn.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median

import torch

import magnet
from magnet.bench.speed import standing
from magnet.denoiser.lean import lean
from magnet.denoiser.options import TransformerOptions
from magnet.denoiser.transformer import Transformer
from magnet.generation.partner import Partner
from magnet.motion.tokens import TOKEN_FRAMES, TokenLayout
from magnet.sampling.options import SamplerOptions

COUNTS = (1, 2, 4, 8, 16, 32)
WINDOWS = (8, 16, 32, 64, 128)
PAST = (10, 50, 100, 200)


def evaluation(people: int, slots: int, window: int, width: int) -> Callable[[], object]:
    """One run of a network; its weights are packed before."""
    layout = TokenLayout(agents=slots)
    network = lean(Transformer(layout, TransformerOptions(width=width, rope="heads")).eval())
    noisy = torch.randn(1, window, slots, layout.width)
    levels = torch.full((1, window, slots), 500)
    return partial(network, noisy, levels, (torch.arange(slots) < people)[None])


def milliseconds(runs: dict[int, Callable[[], object]], rounds: int) -> dict[int, float]:
    """The median of each, run in turn, after two rounds that do not count."""
    times: dict[int, list[float]] = {number: [] for number in runs}
    for _ in range(rounds + 2):
        for number, run in runs.items():
            begun = time.process_time()
            run()
            times[number].append(1000 * (time.process_time() - begun))
    return {number: median(each[2:]) for number, each in times.items()}


def answers(steps: int, span: int = 10) -> dict[int, float]:
    """A live answer of the shipped model after so many others, the median of `span`."""
    model = magnet.load("duet").denoiser
    past = standing(1, 32, 2, model.device)
    how = SamplerOptions(steps=steps)
    partner, coming = Partner(model, past, (0,), how), past.slice(past.frames - TOKEN_FRAMES)
    times = []
    for _ in range(max(PAST) + span):
        begun = time.process_time()
        partner.answer(coming)
        times.append(1000 * (time.process_time() - begun))
    return {number: median(times[number : number + span]) for number in PAST}


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("cost.svg"))
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--width", type=int, default=256)
    parser.add_argument("--steps", type=int, default=4)
    options = parser.parse_args()
    width = options.width
    found = {
        "people": milliseconds({n: evaluation(n, n, 16, width) for n in COUNTS}, options.rounds),
        "slots, 2 of them taken": milliseconds({n: evaluation(2, n, 16, width) for n in COUNTS[1:]}, options.rounds),
        "token steps in the window": milliseconds({n: evaluation(2, 2, n, width) for n in WINDOWS}, options.rounds),
        "tokens answered before": answers(options.steps),
    }
    print(json.dumps(found, indent=1))
    import matplotlib

    matplotlib.use("svg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, len(found), figsize=(12, 3), layout="constrained")
    for axis, (label, line) in zip(axes, found.items(), strict=True):
        axis.plot(list(line), list(line.values()), marker="o", color="#2b6cb0")
        axis.set(xlabel=label, xlim=(0, None), ylim=(0, 1.1 * max(line.values())))
    axes[0].set_ylabel("ms an evaluation")
    axes[-1].set_ylabel("ms an answer")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.out, metadata={"Date": None})


if __name__ == "__main__":
    main()
