"""How long `PairwisePosterior` takes beside the network, in processor time of one thread.

    OMP_NUM_THREADS=1 python benchmarks/posterior_time.py --ckpt_path duet

One line for each number of people and of samples: the network as it was trained, its lean form with which samples are
drawn, the posterior at levels that it has seen before, and at new ones. All are timed in turn; medians. Processor time,
so that other programs hardly count; on an idle machine it is the time that passes.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from functools import partial

import torch

from magnet.denoiser.lean import lean
from magnet.denoiser.module import Denoiser
from magnet.denoiser.pairwise_posterior import PairwisePosterior
from magnet.sampling.noise import LEVELS


def medians(rounds: int, *timed: Callable[[], object]) -> list[float]:
    """Milliseconds of each, called in turn, after three rounds that do not count."""
    each: list[list[float]] = [[] for _ in timed]
    for _ in range(rounds + 3):
        for call, times in zip(timed, each, strict=True):
            start = time.thread_time()
            call()
            times.append(1e3 * (time.thread_time() - start))
    return [statistics.median(times[3:]) for times in each]


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ckpt_path", default="duet")
    parser.add_argument("--people", type=int, nargs="+", default=[2])
    parser.add_argument("--samples", type=int, nargs="+", default=[1, 10])
    parser.add_argument("--rounds", type=int, default=40)
    options = parser.parse_args()
    model = Denoiser.load(options.ckpt_path)
    model.posterior = None
    posterior, network = PairwisePosterior(model.layout), lean(model.transformer)
    agents, generator = model.layout.agents, torch.Generator().manual_seed(0)
    for people in options.people:
        for samples in options.samples:
            present = (torch.arange(agents) < people).expand(samples, -1).contiguous()
            noisy = torch.randn(samples, model.window, agents, model.layout.width, generator=generator)

            def levels(samples: int = samples) -> torch.Tensor:
                drawn = torch.randint(LEVELS + 1, (1, model.window, agents), generator=generator)
                return drawn.expand(samples, -1, -1).contiguous()

            same = noisy, levels(), present
            clean = model.denoise(*same)

            def at_new_levels(
                x: torch.Tensor = noisy, present: torch.Tensor = present, clean: torch.Tensor = clean
            ) -> torch.Tensor:
                return posterior(clean, x, levels(len(x)), present, model.normalizer)

            plain, packed, again, new = medians(
                options.rounds,
                partial(model.denoise, *same),
                partial(model.denoise, *same, network=network),
                partial(posterior, clean, *same, model.normalizer),
                at_new_levels,
            )
            print(
                f"people {people}, samples {samples}: network {plain:.1f} ms, lean {packed:.1f} ms, "
                f"posterior {again:.2f} ms, at new levels {new:.2f} ms"
            )


if __name__ == "__main__":
    main()
