"""The denoising steps of a stage, planned once.

What follows from the plan alone (levels, factors of the solver, views) is worked out for all steps before the first
one and kept for the next stage like it. Only token steps that the stage changes are touched.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Protocol

import torch
from torch import Tensor

from magnet.motion.tokens import TokenLayout
from magnet.sampling.guidance import DenoiseFn, Guidance
from magnet.sampling.noise import LEVELS, NoiseStream, half_log_snr, step_factors
from magnet.sampling.schedule import Stage
from magnet.sampling.solvers import History


class Correct(Protocol):
    """Changes what a step predicts.

    clean (B V, W, P, D) tokens of V views, the levels now (V, W, P) they were predicted at, what each view hides
    (V, W, P) bool or None, and the token step that the window begins with -> (B V, W, P, D)
    """

    def __call__(self, clean: Tensor, now: Tensor, hidden: Tensor | None, first: int) -> Tensor: ...


@dataclass(frozen=True)
class Denoising:
    """What all stages of a sample share.

    Attributes:
        denoise: the model.
        present: (B, P) bool.
        layout: which numbers of a token share a level.
        guidance: what the prediction is pushed toward.
        noise: gives the step noise; None: there is none.
        correct: changes what each step predicts.
        progress: told 1 after each denoising step.
    """

    denoise: DenoiseFn
    present: Tensor
    layout: TokenLayout
    guidance: Guidance = field(default_factory=Guidance)
    noise: NoiseStream | None = None
    correct: Correct | None = None
    progress: Callable[[int], None] | None = None


@dataclass(frozen=True)
class Views:
    """What each agent sees where some are hidden; agents that see the same share a view (V of them).

    Attributes:
        unknown: (V, W, P, 1 + slots) bool, shown as mask noise: their own noise would reveal what they become.
        source: (W, P, 1 + slots) int, the view that each group is read from.
    """

    unknown: Tensor
    source: Tensor


@dataclass(frozen=True)
class StagePlan:
    """All that the steps of a stage need and that motion does not change. Rows are those that the stage changes.

    Attributes:
        rows: which rows of the window.
        levels: (S, V, W, P) int before each step, as each view is shown them; V is 1 where nobody is hidden.
        views: where somebody is hidden.
        numbers: (S, 6, rows, P, 1 + slots): share of the extrapolation, then the five of `step_factors`.
        stays, ends: (S, rows, P, 1 + slots) bool, whose level stays, and who becomes clean.
        draws: for each step the (row, level) pairs that new noise is drawn for, and where several levels share a row.
        last: (rows, P, 1 + slots) int, levels at which each group was predicted last, -1 where it never was; on CPU.
    """

    rows: slice
    levels: Tensor
    views: Views | None
    numbers: Tensor
    stays: Tensor
    ends: Tensor
    draws: tuple[tuple[tuple[int, int, Tensor | None], ...], ...]
    last: Tensor


@torch.inference_mode()
def run_planned_stage(
    how: Denoising,
    stage: Stage,
    tokens: Tensor,
    mask_noise: Tensor,
    first: int = 0,
    history: History | None = None,
    faint: Tensor | None = None,
) -> Tensor:
    """The denoising steps of one window position. tokens, mask_noise (B, W, P, D) -> (B, W, P, D)

    `first` is the row of `how.noise` that the window begins with; `history` is that of the window; `faint` (W, P) int
    are the levels at which finished tokens are shown. Agents that see the same share a view, and all views run as one
    batch.
    """
    B, W, P, _ = tokens.shape
    present, layout, noise = how.present, how.layout, how.noise
    eta = noise.eta if noise is not None else 0.0
    plan = plan_of(stage, layout, eta, history, tokens.device)
    groups, rows, V = layout.groups(tokens.device), plan.rows, plan.levels.shape[1]
    tokens = tokens.clone()
    part, views, shown_noise, hidden = tokens[:, rows], plan.views, mask_noise, None
    if views is not None:
        hidden, unknown, source = views.unknown[..., 0], views.unknown[..., groups], views.source[rows][..., groups]
        source = source.expand(B, 1, *source.shape)
        present = present[:, None].expand(B, V, P).flatten(0, 1)
        shown_noise = mask_noise[:, None].expand(B, V, *mask_noise.shape[1:]).flatten(0, 1)

    def read(each: Tensor) -> Tensor:
        """What the stage changes, each number from its own view. (B V, W, P, D) -> (B, rows, P, D)"""
        return each[:, rows] if views is None else each.unflatten(0, (B, V))[:, :, rows].gather(1, source)[:, 0]

    for step, levels in enumerate(plan.levels):
        numbers, stays, ends = (of[step][..., groups] for of in (plan.numbers, plan.stays, plan.ends))
        shown = tokens
        if views is not None:
            shown = torch.where(unknown, mask_noise[:, None], tokens[:, None]).flatten(0, 1)
        each = levels.expand(B, V, W, P).flatten(0, 1)
        pushed, clean = how.guidance.apply(how.denoise, shown, each, present, shown_noise, layout, faint)
        if how.guidance.smooth:
            part = torch.where(stays, part, read(pushed))
        clean = read(clean if how.correct is None else how.correct(clean, levels, hidden, first))
        carry, signal, left, old, new, signal_after = numbers
        ahead = clean
        if history is not None:
            ahead = clean + carry * (clean - history.clean[:, rows])
            history.clean[:, rows] = torch.where(stays, history.clean[:, rows], clean)
        rest = old * ((part - signal * ahead) / left)
        if noise is not None and eta:
            rest = rest + new * noise.drawn(first + rows.start, len(plan.last), plan.draws[step])
        moved = torch.where(ends, ahead, signal_after * ahead + rest)
        part = torch.where(stays, part, moved)
        tokens[:, rows] = part
        if how.progress is not None:
            how.progress(1)
    if history is not None:
        history.levels[rows] = plan.last[..., layout.groups()]
    return tokens


def plan_of(stage: Stage, layout: TokenLayout, eta: float, history: History | None, device: torch.device) -> StagePlan:
    """The plan of a stage; that of a stage like an earlier one is not made again."""
    begins, ends = (row - stage.start for row in stage.active)
    levels = stage.levels.to("cpu", torch.int16).contiguous()
    hidden = None if stage.visibility is None else (~stage.visibility).cpu().contiguous()
    before = None
    if history is not None:
        firsts = torch.searchsorted(layout.groups(), torch.arange(1 + layout.slots))
        before = history.levels[begins:ends][..., firsts].contiguous()
    return _plan(
        (levels.numpy().tobytes(), tuple(levels.shape)),
        None if hidden is None else hidden.numpy().tobytes(),
        None if before is None else before.numpy().tobytes(),
        (begins, ends),
        layout,
        eta,
        device,
    )


@functools.lru_cache(maxsize=128)
def _plan(
    levels: tuple[bytes, tuple[int, ...]],
    hidden: bytes | None,
    before: bytes | None,
    changed: tuple[int, int],
    layout: TokenLayout,
    eta: float,
    device: torch.device,
) -> StagePlan:
    with torch.inference_mode(False):
        table = torch.frombuffer(bytearray(levels[0]), dtype=torch.int16).view(levels[1]).long()
        _, W, P = table.shape
        slots, rows, count = 1 + layout.slots, slice(*changed), changed[1] - changed[0]
        views = source = None
        if hidden is not None:
            concealed = torch.frombuffer(bytearray(hidden), dtype=torch.bool).view(P, W, P)
            kinds, view_of = concealed.unique(dim=0, return_inverse=True)
            shown = torch.where(kinds, LEVELS, table[:, None])  # (S + 1, V, W, P)
            unknown = layout.group_levels(torch.where(kinds, LEVELS, 0)) == LEVELS
            source = views_to_read(concealed, view_of, layout)
            views = Views(unknown.to(device), source.to(device))
            each = layout.group_levels(shown)
            group = each.gather(1, source.expand(len(each), 1, *source.shape))[:, 0]
        else:
            shown = table[:, None]
            group = layout.group_levels(table)
        group = group[:, rows]  # (S + 1, rows, P, 1 + slots)
        past = torch.full((count, P, slots), -1)
        if before is not None:
            past = torch.frombuffer(bytearray(before), dtype=torch.long).view(count, P, slots).clone()
        numbers, draws = [], []
        for now, after in pairwise(group):
            moves = now != after
            carry = carried_share(now, after, past) if before is not None else torch.zeros(now.shape)
            numbers.append(torch.stack([carry, *step_factors(now, after, eta)]))
            draws.append(draws_of(now, moves, layout, device))
            past = torch.where(moves, now, past)
        stays, ends = group[:-1] == group[1:], group[1:] == 0
        return StagePlan(
            rows,
            shown[:-1].to(device),
            views,
            torch.stack(numbers).to(device),
            stays.to(device),
            ends.to(device),
            tuple(draws),
            past,
        )


def carried_share(now: Tensor, after: Tensor, past: Tensor) -> Tensor:
    """How far a prediction is extrapolated, in changes since the last one; 0 where it is not. (...) int each -> (...)

    It is DPM-Solver++(2M) (Lu et al. 2022, arXiv 2211.01095, algorithm 2, data prediction): a DDIM step with the
    prediction extrapolated to the middle of the step. The first step of a number and the step to level 0 are those of
    DDIM. Level K has an infinite log-SNR and counts as one step of the same length. The extrapolation is at most the
    whole change, so that noise does not grow where levels of a token lie close together.
    """
    length = half_log_snr(after) - half_log_snr(now)
    since = torch.where(past == LEVELS, length, half_log_snr(now) - half_log_snr(past.clamp_min(0)))
    share = (length / (2 * since)).clamp(max=1.0)
    return torch.where((now != after) & (after > 0) & (past >= 0), share, 0.0)


def draws_of(
    now: Tensor, moves: Tensor, layout: TokenLayout, device: torch.device
) -> tuple[tuple[int, int, Tensor | None], ...]:
    """What new noise a step needs: (row, level, which numbers (P, D) have it, None: all that move)."""
    found = []
    for row in moves.flatten(1).any(dim=1).nonzero()[:, 0].tolist():
        levels = now[row][moves[row]].unique().tolist()
        for level in levels:
            where = layout.spread(now[row] == level).to(device) if len(levels) > 1 else None
            found.append((row, level, where))
    return tuple(found)


def views_to_read(hidden: Tensor, view_of: Tensor, layout: TokenLayout) -> Tensor:
    """The view that each group of each token is read from. hidden (P, W, P), view_of (P,) -> (W, P, 1 + slots) int"""
    P, W = hidden.shape[:2]
    own = view_of.expand(W, P)[..., None]
    if not layout.slots:
        return own
    partner = layout.partners(hidden.device)  # (P, slots)
    unseen = hidden.transpose(0, 1)  # (W, P viewer, P viewed)
    agent = torch.arange(P, device=hidden.device)[:, None]
    blind = unseen[:, agent, partner] & ~unseen[:, partner, agent]  # who sees one is not seen
    return torch.cat([own, torch.where(blind, view_of[partner], own)], dim=-1)
