"""Parts of plans: levels of each token, positions of the window, blocks of time steps."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from magnet.motion.runs import true_runs
from magnet.sampling.grid import Grid
from magnet.sampling.noise import (
    HIGHEST_NOISE,
    LEVELS,
    LOWEST_NOISE,
    ddim_levels,
    log_snr_levels,
    nearest_levels,
    opening_levels,
    shifted,
)
from magnet.seeding import derive


def token_levels(grid: Grid) -> Tensor:
    """The levels that each token passes: before its first denoising step and after each. -> (S + 1, W, P) int

    Column n % W is that of token step n.

    `joint`: the levels of `ddim_levels` or `log_snr_levels` for all tokens; agents at a time step share their level.
    `independent`: each token of each agent has levels of its own between K and 0, drawn evenly from 1..K-1 (and then
    `shifted`), or evenly in log-SNR. They are drawn from a fixed seed, the same for every scene.

    Paper A.6.2 compares the two. It can be read as a choice when training (`noise.distribution` of the denoiser) or
    when sampling. It is a choice when sampling here, because the paper trains with independent levels (3.2).
    """
    in_log_snr = grid.spacing == "log_snr"
    plan = log_snr_levels(grid.steps) if in_log_snr else ddim_levels(grid.steps, grid.shift)
    if grid.noise_sampling == "joint":
        return plan[:, None, None].expand(-1, grid.window, grid.agents)
    drawn = torch.empty(grid.steps + 1, grid.window, grid.agents, dtype=torch.long)
    for row in range(grid.window):
        for agent in range(grid.agents):
            generator = torch.Generator().manual_seed(derive("independent noise sampling", row, agent))
            if in_log_snr:
                places = torch.rand(grid.steps - 1, generator=generator, dtype=torch.float64).sort().values
                drawn[:, row, agent] = nearest_levels(HIGHEST_NOISE + (LOWEST_NOISE - HIGHEST_NOISE) * places)
                continue
            between = 1 + torch.randperm(LEVELS - 1, generator=generator)[: grid.steps - 1]
            own = torch.cat([torch.tensor([0, LEVELS]), between]).sort(descending=True).values
            drawn[:, row, agent] = shifted(own, grid.shift)
    return drawn


def levels_at(levels: Tensor, turn: Tensor, start: int, stop: int) -> Tensor:
    """Levels of the token steps [start, stop) after so many of their own denoising steps.

    levels (S + 1, W, P) as of `token_levels`; turn (R, stop - start or 1, P or 1) int, clamped to 0..S
    -> (R, stop - start, P)
    """
    own = levels[:, torch.arange(start, stop) % levels.shape[1]]
    return own.gather(0, turn.clamp(0, len(levels) - 1).expand(-1, *own.shape[1:]))


def changing(levels: Tensor) -> Tensor:
    """The levels of a plan without denoising steps that change nothing. (S + 1, W, P) -> (at most as many, W, P)"""
    changes = (levels.diff(dim=0) != 0).flatten(1).any(dim=1)
    return torch.cat([levels[:1], levels[1:][changes]])


def opened(levels: Tensor, count: int) -> Tensor:
    """A stage's levels with an opening: `count` more steps at high noise, where nothing of its window is known.

    Hundreds of noisy numbers tell together what people do and how far apart they are. So that is decided at levels at
    which each number by itself looks like pure noise, higher than the first that a plan of few steps reaches; a single
    step there from pure noise ends in the mean of all that could be. Where a past is known, it has decided already.
    (S + 1, W, P) -> (at most S + 1 + count, W, P)
    """
    if not count or bool((levels[0] < LEVELS).any()):
        return levels
    moves = levels[1] < LEVELS
    more = opening_levels(int(levels[1][moves].max()), count)
    between = torch.where(moves, more[:, None, None].to(levels), levels[0])
    return torch.cat([levels[:1], between, levels[1:]])


def blocks(target: Tensor, block: int) -> Iterator[tuple[int, int]]:
    """Time steps with targets, at most `block` at a time. target (N, P) bool -> (first, one past the last)"""
    for start, stop in true_runs(target.any(dim=1).tolist()):
        for first in range(start, stop, block):
            yield first, min(first + block, stop)


def initial_levels(known: Tensor) -> Tensor:
    """Known tokens are clean, all others pure noise. (N, P) bool -> (N, P) int"""
    return torch.where(known, 0, LEVELS)


def window_positions(target: Tensor, grid: Grid) -> Iterator[tuple[int, int, int]]:
    """Positions of the window: (start, first token step to denoise, one past the last), until all targets are done.

    The first window is filled to its end; each later one keeps window - stride finished steps in view.
    """
    wanted = target.any(dim=1).nonzero()[:, 0].tolist()
    if not wanted:
        return
    first, end = wanted[0], wanted[-1] + 1
    # Leave room for at least one stride of new tokens behind the recorded ones.
    start = max(0, min(first - (grid.window - grid.stride), grid.tokens - grid.window))
    last = min(start + grid.window, end)
    while True:
        yield start, first, last
        if last >= end:
            return
        first, last = last, min(last + grid.stride, end)
        start = max(0, last - grid.window)
