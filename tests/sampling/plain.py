"""The denoising steps of a stage as a plain loop, which works everything out in each step: what samples are held to."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor

from magnet.motion.tokens import TokenLayout
from magnet.sampling.guidance import DenoiseFn, Guidance
from magnet.sampling.noise import LEVELS, NoiseStream, ddim_step, half_log_snr
from magnet.sampling.planned_stage import Denoising, views_to_read
from magnet.sampling.schedule import Stage
from magnet.sampling.solvers import History


def run_stage(
    how: Denoising,
    stage: Stage,
    tokens: Tensor,
    mask_noise: Tensor,
    first: int = 0,
    history: History | None = None,
) -> Tensor:
    """As `magnet.sampling.planned_stage.run_planned_stage`. tokens, mask_noise (B, W, P, D) -> (B, W, P, D)"""
    denoise, present, layout, guidance, noise = how.denoise, how.present, how.layout, how.guidance, how.noise
    hidden = None if stage.visibility is None else ~stage.visibility
    for now, after in pairwise(stage.levels.long()):
        group, group_after = (layout.spread(layout.group_levels(x)) for x in (now, after))
        eta = noise.eta if noise is not None else 0.0
        new = step_noise(noise, first, group, group != group_after) if noise is not None and eta else None
        if hidden is None:
            each = now.expand(len(tokens), -1, -1)
            pushed, clean = guidance.apply(denoise, tokens, each, present, mask_noise, layout)
            tokens = torch.where(group != group_after, pushed, tokens)
        else:
            tokens, clean, group, group_after = predict_in_views(
                denoise, tokens, mask_noise, now, after, hidden, present, layout, guidance
            )
        tokens = solver_step(tokens, clean, group, group_after, eta, new, history)
        if how.progress is not None:
            how.progress(1)
    return tokens


def predict_in_views(
    denoise: DenoiseFn,
    tokens: Tensor,
    mask_noise: Tensor,
    now: Tensor,
    after: Tensor,
    hidden: Tensor,
    present: Tensor,
    layout: TokenLayout,
    guidance: Guidance,
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
    pushed, clean = guidance.apply(
        denoise,
        views.flatten(0, 1),
        seen_now.expand(B, V, W, P).flatten(0, 1),
        present[:, None].expand(B, V, P).flatten(0, 1),
        mask_noise[:, None].expand_as(views).flatten(0, 1),
        layout,
    )
    pushed, clean = pushed.unflatten(0, (B, V)), clean.unflatten(0, (B, V))
    moved = torch.where(group == group_after, views, pushed)
    moved = torch.where(unknown, tokens[:, None], moved)
    source = layout.spread(views_to_read(hidden, view_of, layout))  # (W, P, D)

    def read(views: Tensor) -> Tensor:
        """From each number's own view. (..., V, W, P, D) -> (..., W, P, D)"""
        return views.gather(-4, source.expand(*views.shape[:-4], 1, W, P, -1)).squeeze(-4)

    return read(moved), read(clean), read(group), read(group_after)


def step_noise(stream: NoiseStream, first: int, levels: Tensor, moves: Tensor) -> Tensor:
    """New noise of the steps that leave these levels, of the token steps from `first` on; drawn level by level.

    levels (W, P, D) int, moves (W, P, D) bool, where it is needed; elsewhere 0 -> (B, W, P, D)
    """
    noise = torch.zeros(stream.shape[0], *levels.shape, dtype=stream.dtype)
    for row in range(len(levels)):
        for level in levels[row][moves[row]].unique().tolist():
            drawn = stream.drawn(first + row, 1, [(0, level, None)])[:, 0]
            noise[:, row] = torch.where(moves[row] & (levels[row] == level), drawn, noise[:, row])
    return noise


def solver_step(
    noisy: Tensor,
    clean: Tensor,
    now: Tensor,
    after: Tensor,
    eta: float = 0.0,
    step_noise: Tensor | None = None,
    history: History | None = None,
) -> Tensor:
    """One step of every number from its level `now` down to its level `after`, given the predicted clean values.

    Without a history this is DDIM. With one, which is brought up to date, it is DPM-Solver++(2M).
    noisy, clean (B, N, P, D), now, after (N, P, D) int -> (B, N, P, D)
    """
    if history is None:
        return ddim_step(noisy, clean, now, after, eta, step_noise)
    moves = now != after
    ahead = torch.where(moves & (after > 0), carried_on(clean, now, after, history), clean)
    history.clean.copy_(torch.where(moves, clean, history.clean))
    history.levels.copy_(torch.where(moves, now, history.levels))
    return ddim_step(noisy, ahead, now, after, eta, step_noise)


def carried_on(clean: Tensor, now: Tensor, after: Tensor, history: History) -> Tensor:
    """The clean prediction extrapolated by half a step, from its change since the last one."""
    length = half_log_snr(after) - half_log_snr(now)
    past = history.levels
    since = torch.where(past == LEVELS, length, half_log_snr(now) - half_log_snr(past.clamp_min(0)))
    share = (length / (2 * since)).clamp(max=1.0)
    return torch.where(past < 0, clean, clean + share * (clean - history.clean))
