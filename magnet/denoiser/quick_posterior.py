"""`PairwisePosterior` for a few scenes on a CPU: the same numbers to rounding, in a third of the time.

There a posterior is so small that it costs as much as its operators are many. So this reads the numbers of a transform
that count in one go, computes with NumPy's arrays, whose operators cost less, and has one matrix for each solve.
Transforms of P people are (P, P) here: an agent's own delta on the diagonal, and beside it where it sees the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from magnet.denoiser.posterior_setting import Setting
from magnet.motion.tokens import TOKEN_FRAMES, TokenLayout

Array = NDArray[Any]

MOST_UNKNOWN = 256
"""Frames times people, up to which a solve is a product with an inverse."""

READ = 0, 2, 6, 8
"""Numbers of a transform that tell its turn, exp(-i yaw), and its move x + i z; all others are the same for all."""


@dataclass(frozen=True)
class QuickSetting:
    """What a `Setting` of scenes that are alike says, in the order in which it is read here.

    Attributes:
        read: (2, T, P, P, 2) int, where in a scene's tokens turns and moves are.
        mean: (2, T, P, P, 2) of these.
        scale: (2, 1, 2, T, P, P, 2) what predicted and shown numbers are multiplied by.
        std: (2, T, P, P, 2).
        given: (2, T, P, P, 2) bool, deltas that are shown clean, which replace those told.
        write: (K,) int, where in a scene's tokens the result goes; `made` (K,) int, which of its numbers.
        fixed, values: (F,) int and the numbers that are there whatever is shown.
        kept: (H,) int, deltas of the first frame that are those shown.
        tied: (2, T, P, P) precisions of pairwise transforms, 0 on the diagonal.
        share: (2, T, P, P) weight of shown pairwise transforms against predicted ones.
        second: (2, T, P) precisions of shown deltas.
        solve: (2, T P, T P), see `inverses`.
    """

    read: Array
    mean: Array
    scale: Array
    std: Array
    given: Array
    write: Array
    made: Array
    fixed: Array
    values: Array
    kept: Array
    tied: Array
    share: Array
    second: Array
    solve: Array

    @classmethod
    def of(cls, known: Setting, layout: TokenLayout) -> QuickSetting | None:
        """None where it would take too much memory, or scenes differ."""
        _, T, P = known.second[0].shape
        if T * P > MOST_UNKNOWN or len(known.people.slots) > 1:
            return None
        steps, (own, order) = T // TOKEN_FRAMES, in_order(P)
        slots, groups = known.people.slots[0].numpy(), known.people.groups[0].numpy()
        each = np.arange(9 * T * P * P).reshape(steps, P, P, TOKEN_FRAMES, 9)
        # Where each of these lies in a scene's tokens (N, P of the batch, D).
        token = np.arange(steps)[:, None, None, None, None] * layout.agents + slots[:, None, None, None]
        inside = (groups[:, :, None] * TOKEN_FRAMES + np.arange(TOKEN_FRAMES))[..., None] * 9 + np.arange(9)
        place = token * layout.width + layout.latent + inside

        def read(values: Array) -> Array:
            """(N, P, P, 4, 9), others in the order of `groups` -> (2, T, P, P, 2), in the order of people"""
            framed = np.broadcast_to(values, each.shape).transpose(0, 3, 1, 2, 4).reshape(T, P, P, 9)[:, own, order]
            return np.ascontiguousarray(framed[..., READ].reshape(T, P, P, 2, 2).transpose(3, 0, 1, 2, 4))

        def paired(others: Tensor) -> Array:
            """(2, 1, T, P, P - 1) -> (2, T, P, P), 0 for oneself"""
            return torch.nn.functional.pad(others[:, 0], (1, 0)).numpy()[:, :, own, order]

        mean, std, rescaling = (x[0].numpy() for x in (known.mean, known.std, known.rescaling))
        shown, met = known.deltas[0].numpy(), np.broadcast_to(known.met[0].numpy(), each.shape)
        first = np.zeros(each.shape, dtype=bool)
        first[0, :, 0, 0] = True
        clean = np.broadcast_to(shown, each.shape)
        number = np.broadcast_to(np.arange(9), each.shape)
        moves = np.isin(number, READ)
        fixed = met & ~first & ~moves
        write = read(met & ~first)
        still = (np.where(number == 4, 1.0, 0.0) - mean) / std
        return cls(
            read=read(place),
            mean=read(mean),
            scale=np.stack([read(std), read(rescaling)])[:, None],
            std=read(std),
            given=read(clean),
            write=read(place)[write],
            made=np.flatnonzero(write),
            fixed=place[fixed],
            values=still[fixed].astype(np.float32),
            kept=place[met & first & clean],
            tied=paired(known.graph.tied),
            share=paired(known.share),
            second=known.second[:, 0].numpy(),
            solve=inverses(known, T * P),
        )


def in_order(P: int) -> tuple[Array, Array]:
    """Index that takes each agent's own and the others' from where an agent's own comes first. (P, 1), (P, P) int"""
    own, other = np.arange(P)[:, None], np.arange(P)
    return own, np.where(own == other, 0, 1 + other - (other > own))


def inverses(known: Setting, unknowns: int) -> Array:
    """Inverses of a graph's two matrices but for where all of it stands, which nothing that is made depends on.

    By that the matrices are nearly singular: with it, rounding would be a thousand times as great. -> (2, U, U)
    """
    centre = torch.eye(unknowns, dtype=torch.double) - 1 / unknowns
    blocks = centre.view(1, -1, 2 * len(known.people.slots[0]), unknowns)
    solved = [known.graph.systems[which].solve(blocks).reshape(unknowns, unknowns) for which in (0, 1)]
    return np.stack([(each - each.mean(dim=0)).numpy() for each in solved])


def quickly_fused(clean: Tensor, noisy: Tensor, known: QuickSetting) -> Tensor:
    """As `PairwisePosterior.forward`. clean, noisy (B, N, P, D) float32 -> (B, N, P, D)"""
    B = len(clean)
    better = clean.clone(memory_format=torch.contiguous_format)
    made: Array = better.view(B, -1).numpy()
    shown: Array = noisy.reshape(B, -1).numpy()
    read: Array = np.stack([made.take(known.read, axis=1), shown.take(known.read, axis=1)])
    numbers: Array = (known.mean + known.scale * read).astype(np.float64)  # (2, B, 2, T, P, P, 2)
    np.copyto(numbers[0], numbers[1], where=known.given)
    whole = numbers.view(np.complex128)[..., 0]
    fused = poses_fused(whole[:, :, 0], whole[:, :, 1], known)
    result: Array = fused.view(np.float64).reshape(*fused.shape, 2).astype(np.float32)
    result = ((result - known.mean) / known.std).reshape(B, -1)
    made[:, known.write] = result.take(known.made, axis=1)
    made[:, known.fixed] = known.values
    if len(known.kept):
        made[:, known.kept] = shown.take(known.kept, axis=1)
    return better


def poses_fused(turn: Array, move: Array, known: QuickSetting) -> Array:
    """Transforms of the motion that fits best what was told and what was shown.

    turn, move (2, B, T, P, P) complex: told, shown -> (B, 2, T, P, P) complex: turns, moves
    """
    B, T, P = turn.shape[1:4]
    told = -np.arctan2(turn[0].imag, turn[0].real)
    around = turn[0] * turn[1].conj()
    further = np.arctan2(around.imag, around.real)
    pairs = told + known.share[0] * further
    step, aside = diagonal(move[0]), move[1] - move[0]
    pulls = known.second[0] * diagonal(further), known.second[1] * diagonal(aside)
    seen = move[0] + known.share[1] * aside
    # Headings at the start, by the first agent's view of the others.
    along = diagonal(told).cumsum(axis=1)
    looks = known.tied[0, :, 0] * np.exp(1j * (pairs[:, :, 0] - along + along[..., :1]))
    looks = looks.sum(axis=1)
    start = np.arctan2(looks.imag, looks.real)[:, None]
    start[..., 0] = 0.0
    heading = start + along
    off = pairs - (heading[:, :, None, :] - heading[..., None])
    off -= 2 * np.pi * np.round(off / (2 * np.pi))
    heading += corrections(known, 0, off, pulls[0])
    pose = np.exp(-1j * np.concatenate([start, heading], axis=1))
    before, here = pose[:, :-1], pose[:, 1:]
    place = (before * step).cumsum(axis=1)
    away = here[..., None] * seen - (place[:, :, None, :] - place[..., None])
    place += corrections(known, 1, away, before * pulls[1])
    # From the frame before to this one on the diagonal, and from an agent to the others.
    turned, moved = (np.repeat(x[..., None], P, axis=-1) for x in (here.conj(), place))
    own = np.arange(P)
    turned[:, 1:, own, own], moved[:, 1:, own, own] = here[:, :-1].conj(), place[:, :-1]
    fused = np.empty((B, 2, T, P, P), dtype=np.complex128)
    np.multiply(here[:, :, None, :], turned, out=fused[:, 0])
    np.multiply(place[:, :, None, :] - moved, turned, out=fused[:, 1])
    return fused


def diagonal(pairs: Array) -> Array:
    """What is an agent's own. (B, T, P, P) -> (B, T, P), a view"""
    return pairs.diagonal(axis1=2, axis2=3)


def corrections(known: QuickSetting, which: int, off: Array, force: Array) -> Array:
    """As `PoseGraph`'s, of headings (0) or of places (1). off (B, T, P, P), force (B, T, P) -> (B, T, P)"""
    pull = known.tied[which] * off
    right = pull.sum(axis=2) - pull.sum(axis=3) + force
    right[:, :-1] -= force[:, 1:]
    B, unknowns = len(right), known.solve.shape[-1]
    # Scenes, and the two numbers of a place, are columns of one right side.
    columns = right.view(np.float64).reshape(B, unknowns, -1)
    solved = known.solve[which] @ columns if B == 1 else by_columns(known.solve[which], columns)
    return np.ascontiguousarray(solved).view(right.dtype).reshape(right.shape)


def by_columns(matrix: Array, columns: Array) -> Array:
    """One product for all scenes. (U, U), (B, U, C) -> (B, U, C)"""
    B, U, C = columns.shape
    return (matrix @ columns.transpose(1, 0, 2).reshape(U, B * C)).reshape(U, B, C).transpose(1, 0, 2)
