"""How long a partner in real time takes to answer, beside how long the motion lasts that is answered.

    python benchmarks/partner.py --threads 2

Medians over `--rounds` answers, after one that is not counted.
"""

from __future__ import annotations

import argparse
import statistics
import time

import torch

import magnet


def main() -> None:
    """Measure, print a table."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--model", default="duet")
    options.add_argument("--threads", type=int, default=torch.get_num_threads())
    options.add_argument("--rounds", type=int, default=15)
    given = options.parse_args()
    torch.set_num_threads(given.threads)
    print("| denoising steps | frames | answered in, ms | they last, ms | share |\n|---:|---:|---:|---:|---:|")
    for steps in (4, 6, 10):
        model = magnet.load(given.model, steps=steps)
        past = model.generate(people=2, frames=32, seed=0)
        partner = model.partner(past, agents=0, seed=0)
        for frames in (4, 8):
            coming = past.slice(past.frames - frames)
            partner.answer(coming)
            took = []
            for _ in range(given.rounds):
                began = time.perf_counter()
                partner.answer(coming)
                took.append(time.perf_counter() - began)
            answered, last = statistics.median(took), frames / past.fps
            print(f"| {steps} | {frames} | {1000 * answered:.0f} | {1000 * last:.0f} | {answered / last:.2f} |")


if __name__ == "__main__":
    main()
