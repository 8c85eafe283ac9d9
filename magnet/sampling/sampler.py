"""The sampling loop of all tasks."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence

import torch
from torch import Tensor

from magnet.motion.tokens import TokenLayout
from magnet.sampling.faint import faint_levels
from magnet.sampling.guidance import DenoiseFn, Guidance
from magnet.sampling.noise import NoiseStream
from magnet.sampling.planned_stage import Denoising, run_planned_stage
from magnet.sampling.schedule import MaskSchedule, Stage, initial_levels
from magnet.sampling.solvers import History, Solver

Faint = Callable[[Stage], Tensor | None]
"""The levels at which finished tokens are shown in a stage, as `faint_levels` has them."""

StageCallback = Callable[[Tensor, Tensor, bool], Tensor]
"""Called after each stage with the tokens (B, N, P, D), which of them it finished (N, P) bool, and whether it was
decentralized (`Stage.decentralized`). Returns the tokens with the finished ones made self-consistent: latents moved to
their nearest codes, transforms recomputed from world poses."""


@torch.no_grad()
def sample(
    denoise: DenoiseFn,
    schedule: MaskSchedule,
    tokens: Tensor,
    present: Tensor,
    layout: TokenLayout,
    generator: torch.Generator | Sequence[torch.Generator] | None = None,
    on_stage_end: StageCallback | None = None,
    progress: Callable[[int], None] | None = None,
    guidance: Guidance | None = None,
    noise: NoiseStream | None = None,
    solver: Solver = "ddim",
) -> Tensor:
    """Fill in what a schedule leaves open.

    Args:
        denoise: the model.
        schedule: the plan.
        tokens: (B, N, P, D) normalized tokens. Only those the schedule knows are read, and of those only
            pairs whose both ends are known; the rest may hold anything.
        present: (B, P) bool.
        layout: which numbers of a token share a level.
        generator: source of all noise, on the tokens' device; or one for each scene, see `NoiseStream`.
        on_stage_end: see `StageCallback`.
        progress: told 1 after each denoising step.
        guidance: what the prediction is pushed toward.
        noise: instead of `generator`.
        solver: `ddim`, or the second-order `dpmpp_2m`; see `magnet.sampling.solvers`.

    Returns:
        (B, N, P, D). Known tokens come back bit-identical.
    """
    B, N, P, D = tokens.shape
    if (schedule.tokens, schedule.agents) != (N, P):
        raise ValueError(f"tokens are {N} x {P} (time x agents), the schedule {schedule.tokens} x {schedule.agents}")
    guidance = guidance or Guidance()
    noise = noise or NoiseStream((B, P, D), generator, tokens.device, tokens.dtype)
    init_noise, mask_noise = noise.draw(N)
    tokens = begin(tokens, init_noise, schedule.known, layout)
    history = None if solver == "ddim" else History.empty(tokens)
    how = Denoising(denoise, present, layout, guidance, noise, progress=progress)
    faint = functools.partial(faint_levels, guidance, schedule.known, live=schedule.causal)
    return run_stages(how, schedule.stages, tokens, mask_noise, on_stage_end, history=history, faint=faint)


def begin(tokens: Tensor, noise: Tensor, known: Tensor, layout: TokenLayout) -> Tensor:
    """Noise wherever something is not known. tokens, noise (B, N, P, D), known (N, P) bool -> (B, N, P, D)"""
    clean = layout.spread(layout.group_levels(initial_levels(known)) == 0).to(tokens.device)
    return torch.where(clean, tokens, noise)


@torch.no_grad()
def run_stages(
    how: Denoising,
    stages: Iterable[Stage],
    tokens: Tensor,
    mask_noise: Tensor,
    on_stage_end: StageCallback | None = None,
    offset: int = 0,
    history: History | None = None,
    faint: Faint | None = None,
) -> Tensor:
    """Run stages in their order. tokens, mask_noise (B, N, P, D) -> (B, N, P, D)

    Arguments as for `sample`. `offset` is the token step, of all those of `how.noise`, that `tokens` begin with. With a
    `history` of the tokens the solver is a multistep one, which updates it; `faint` says how noisy finished tokens are
    shown, `None`: clean.
    """
    tokens = tokens.clone()
    for stage in stages:
        window = slice(stage.start, stage.stop)
        levels = None if faint is None else faint(stage)
        if levels is not None:
            levels = levels[window].to(tokens.device) if bool(levels[window].any()) else None
        past = None if history is None else history.window(window)
        held, masked = tokens[:, window], mask_noise[:, window]
        tokens[:, window] = run_planned_stage(how, stage, held, masked, offset + stage.start, past, levels)
        if on_stage_end is not None:
            finished = torch.zeros(tokens.shape[1:3], dtype=torch.bool)
            finished[window] = (stage.levels[-1] == 0) & (stage.levels[0] > 0)
            tokens = on_stage_end(tokens, finished, stage.decentralized)
    return tokens
