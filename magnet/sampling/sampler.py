"""The sampling loop of all tasks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import pairwise

import torch
from torch import Tensor

from magnet.motion.tokens import TokenLayout
from magnet.sampling.guidance import DenoiseFn, Guidance
from magnet.sampling.noise import LEVELS, NoiseStream
from magnet.sampling.planned_stage import Correct, run_planned_stage, views_to_read
from magnet.sampling.schedule import MaskSchedule, Stage, initial_levels
from magnet.sampling.solvers import History, Solver, solver_step

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
    noise = noise or NoiseStream((B, P, D), generator, tokens.device, tokens.dtype)
    init_noise, mask_noise = noise.draw(N)
    tokens = begin(tokens, init_noise, schedule.known, layout)
    history = None if solver == "ddim" else History.empty(tokens)
    return run_stages(
        denoise,
        schedule.stages,
        tokens,
        mask_noise,
        present,
        layout,
        on_stage_end,
        progress,
        guidance,
        noise,
        history=history,
    )


def begin(tokens: Tensor, noise: Tensor, known: Tensor, layout: TokenLayout) -> Tensor:
    """Noise wherever something is not known. tokens, noise (B, N, P, D), known (N, P) bool -> (B, N, P, D)"""
    clean = layout.spread(layout.group_levels(initial_levels(known)) == 0).to(tokens.device)
    return torch.where(clean, tokens, noise)


@torch.no_grad()
def run_stages(
    denoise: DenoiseFn,
    stages: Iterable[Stage],
    tokens: Tensor,
    mask_noise: Tensor,
    present: Tensor,
    layout: TokenLayout,
    on_stage_end: StageCallback | None = None,
    progress: Callable[[int], None] | None = None,
    guidance: Guidance | None = None,
    noise: NoiseStream | None = None,
    offset: int = 0,
    history: History | None = None,
    correct: Correct | None = None,
) -> Tensor:
    """Run stages in their order. tokens, mask_noise (B, N, P, D) -> (B, N, P, D)

    Arguments as for `sample`. `noise` gives the step noise; `offset` is the token step, of all its token steps, that
    `tokens` begin with. With a `history` of the tokens the solver is a multistep one, which updates it;
    `correct` changes what each step predicts.
    """
    tokens, guidance = tokens.clone(), guidance or Guidance()
    # Smoothing moves noisy tokens by a gradient in each step, which no plan knows of.
    run = run_stage if guidance.smooth else run_planned_stage
    for stage in stages:
        window = slice(stage.start, stage.stop)
        tokens[:, window] = run(
            denoise,
            stage,
            tokens[:, window],
            mask_noise[:, window],
            present,
            layout,
            progress,
            guidance,
            noise,
            offset + stage.start,
            None if history is None else history.window(window),
            correct,
        )
        if on_stage_end is not None:
            finished = torch.zeros(tokens.shape[1:3], dtype=torch.bool)
            finished[window] = (stage.levels[-1] == 0) & (stage.levels[0] > 0)
            tokens = on_stage_end(tokens, finished, stage.decentralized)
    return tokens


def run_stage(
    denoise: DenoiseFn,
    stage: Stage,
    tokens: Tensor,
    mask_noise: Tensor,
    present: Tensor,
    layout: TokenLayout,
    progress: Callable[[int], None] | None,
    guidance: Guidance,
    noise: NoiseStream | None = None,
    first: int = 0,
    history: History | None = None,
    correct: Correct | None = None,
) -> Tensor:
    """The denoising steps of one window position. tokens, mask_noise (B, W, P, D) -> (B, W, P, D)

    The plain loop, which works out everything in each step; `run_planned_stage` is held to its results.

    `first` is the row of `noise` that the window begins with; `history` is that of the window.
    """
    device = tokens.device
    levels = stage.levels.to(device).long()
    hidden = None if stage.visibility is None else ~stage.visibility.to(device)
    for now, after in pairwise(levels):
        group, group_after = (layout.spread(layout.group_levels(x)) for x in (now, after))
        moves = group != group_after
        eta = noise.eta if noise is not None else 0.0
        step_noise = noise.step_noise(first, group, moves) if noise is not None and eta else None
        if hidden is None:
            each = now.expand(len(tokens), -1, -1)
            tokens, clean = guidance.apply(denoise, tokens, each, present, mask_noise, layout, moves)
            clean = clean if correct is None else correct(clean, now[None], None, first)
        else:
            in_views = None if correct is None else partial(correct, first=first)
            tokens, clean, group, group_after = _predict_in_views(
                denoise, tokens, mask_noise, now, after, hidden, present, layout, guidance, in_views
            )
        tokens = solver_step(tokens, clean, group, group_after, eta, step_noise, history)
        if progress is not None:
            progress(1)
    return tokens


def _predict_in_views(
    denoise: DenoiseFn,
    tokens: Tensor,
    mask_noise: Tensor,
    now: Tensor,
    after: Tensor,
    hidden: Tensor,
    present: Tensor,
    layout: TokenLayout,
    guidance: Guidance,
    correct: Callable[..., Tensor] | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Predict each agent's tokens in its own view, in which hidden tokens are unknown. hidden (P, W, P)

    Agents that see the same share a view. A pairwise transform to somebody hidden is unknown too. It is read from the
    other agent's view if that one sees both, and stays noise otherwise.

    Returns:
        The noisy tokens that the next step starts from and their clean prediction (B, W, P, D), and the levels of their
        numbers before and after it (W, P, D).
    """
    B, W, P, _ = tokens.shape
    views_hidden, view_of = hidden.unique(dim=0, return_inverse=True)
    V = len(views_hidden)
    seen_now = torch.where(views_hidden, LEVELS, now)  # (V, W, P)
    seen_after = torch.where(views_hidden, LEVELS, after)
    group = layout.spread(layout.group_levels(seen_now))  # (V, W, P, D)
    group_after = layout.spread(layout.group_levels(seen_after))
    # Numbers about somebody hidden are shown as mask noise: their own noise would reveal what they become.
    masked_levels = torch.where(views_hidden, LEVELS, 0)
    unknown = layout.spread(layout.group_levels(masked_levels)) == LEVELS
    views = torch.where(unknown, mask_noise[:, None], tokens[:, None])  # (B, V, W, P, D)
    moved, clean = guidance.apply(
        denoise,
        views.flatten(0, 1),
        seen_now.expand(B, V, W, P).flatten(0, 1),
        present[:, None].expand(B, V, P).flatten(0, 1),
        mask_noise[:, None].expand_as(views).flatten(0, 1),
        layout,
        (group != group_after).expand_as(views).flatten(0, 1),
    )
    clean = clean if correct is None else correct(clean, seen_now, views_hidden)
    moved, clean = moved.unflatten(0, (B, V)), clean.unflatten(0, (B, V))
    moved = torch.where(unknown, tokens[:, None], moved)
    source = layout.spread(views_to_read(hidden, view_of, layout))  # (W, P, D)

    def read(views: Tensor) -> Tensor:
        """From each number's own view. (..., V, W, P, D) -> (..., W, P, D)"""
        return views.gather(-4, source.expand(*views.shape[:-4], 1, W, P, -1)).squeeze(-4)

    return read(moved), read(clean), read(group), read(group_after)
