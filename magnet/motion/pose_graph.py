"""Poses on the ground from deltas and pairwise transforms: one least-squares solve.

The unknowns are the headings and ground positions of all agents over consecutive frames. Deltas relate an agent's
frames to each other, pairwise transforms relate agents to each other, and each has a precision (one over its variance).
Errors of predicted deltas are alike in neighbouring frames (somebody walks a little too fast for a while), so the
correction can be smooth: then high frequencies come from the deltas and low ones from the pairs.
Headings are solved first, then positions with those headings: two linear systems in closed form, without iterations.
Each frame is tied only to the two before it. So whole runs of frames are eliminated at once, in few batched operations.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from magnet.motion.cholesky import factored, solved
from magnet.motion.frames import partners

GAUGE = 1e-6
"""Small precision of the integrated deltas, which decides where nothing else determines a position; so all
matrices are positive definite."""

WHOLE = 2 * 128**3
"""A batch of matrices is factored whole if their number times their size cubed is at most this; else reduced first."""

RUN = 4
"""Blocks of two frames in a run, all but the last of which are eliminated at once."""


@dataclass(frozen=True)
class PoseGraph:
    """Headings and positions that fit deltas and pairwise transforms best, each by its precision.

    Minimises three sums of squares: how far consecutive poses are from the deltas, how much that error changes from
    frame to frame, and how far the agents of a frame are from their pairwise transforms. With pairwise precisions of 0
    the answer is the plain integration of the deltas. A graph holds what depends on the precisions alone, and can be
    solved for several motions.

    Attributes:
        tied: (2, B, T, P, P - 1) precisions of pairwise transforms: of their yaws, then of their ground positions. B
            may be 1, for any number of scenes.
        systems: the two factored matrices.
    """

    tied: Tensor
    systems: BlockTridiagonal

    @classmethod
    def of(cls, held: Tensor, smooth: Tensor, tied: Tensor) -> PoseGraph:
        """From precisions in float64, 1 / rad^2 and 1 / m^2; 0 where nothing is known.

        Args:
            held: (2, B, T, P) of deltas; that of the first delta says how firmly the start holds.
            smooth: (2, B, T, P) of the change of a delta's error since the frame before; 0: errors are independent. The
                first frame's is not read.
            tied: as above.
        """
        return cls(tied, factor(*_in_twos(*_bands(held, smooth, tied))))

    def solve(
        self,
        delta_yaw: Tensor,
        delta_ground: Tensor,
        pair_yaw: Tensor,
        pair_ground: Tensor,
        start_yaw: Tensor,
        start_ground: Tensor,
        yaw_pull: Tensor | float = 0.0,
        ground_pull: Tensor | float = 0.0,
    ) -> tuple[Tensor, Tensor]:
        """The least-squares answer. (x, z) is one complex number here, which a turn by a yaw multiplies by exp(-i yaw).

        Args:
            delta_yaw, delta_ground: (B, T, P) radians and (B, T, P, 2) metres (x, z), T_prev_now of each agent; the
                first leads away from the start.
            pair_yaw, pair_ground: (B, T, P, P - 1) and (B, T, P, P - 1, 2), T_self_partner in the order of `partners`.
            start_yaw, start_ground: (B, P) and (B, P, 2), before the first frame.
            yaw_pull, ground_pull: see below.

        Returns:
            yaw (B, T, P) and ground (B, T, P, 2), in float64.

        Pulls are for deltas that were observed twice. Then `held` is the sum of both precisions, and a pull is the
        second precision times how far the second observation is from the first: yaw (B, T, P), ground (B, T, P)
        complex. The first observation's error counts as smooth, the second one's as independent from frame to frame.
        """
        partner = partners(delta_yaw.shape[2], delta_yaw.device)
        start_yaw, start_ground = start_yaw.double(), torch.view_as_complex(start_ground.double().contiguous())
        yaw = start_yaw[:, None] + delta_yaw.double().cumsum(dim=1)
        off = pair_yaw.double() - (yaw[:, :, partner] - yaw[..., None])
        off = torch.atan2(off.sin(), off.cos())
        yaw = yaw + self._corrections(0, off[..., None], _each(yaw_pull, yaw)[..., None])[..., 0]
        turn = torch.exp(-1j * torch.cat([start_yaw[:, None], yaw], dim=1))
        steps = turn[:, :-1] * torch.view_as_complex(delta_ground.double().contiguous())
        ground = start_ground[:, None] + steps.cumsum(dim=1)
        seen = turn[:, 1:, :, None] * torch.view_as_complex(pair_ground.double().contiguous())
        away = torch.view_as_real(seen - (ground[:, :, partner] - ground[..., None]))
        force = torch.view_as_real(turn[:, :-1] * _each(ground_pull, steps))
        return yaw, torch.view_as_real(ground) + self._corrections(1, away, force)

    def _corrections(self, which: int, off: Tensor, force: Tensor) -> Tensor:
        """Correction of each agent's integrated path in each frame, of yaws (0) or of ground positions (1).

        off (B, T, P, P - 1, C), how far each pairwise transform is from the integrated paths, force (B, T, P, C), what
        pulls deltas -> (B, T, P, C)
        """
        B, T, P, _, C = off.shape
        tied, system = self.tied[which], self.systems[which]
        pull = tied[..., None] * off
        partner = partners(P, off.device).flatten()
        right = (-pull.sum(dim=3)).index_add(2, partner, pull.flatten(2, 3)) + force
        right[:, :-1] -= force[:, 1:]
        if T % 2:
            right = pad(right, (0, 0, 0, 0, 0, 1))
        right = right.view(B, -1, 2 * P, C)
        if len(tied) < B:  # scenes of one matrix are columns of one right side
            columns = right.movedim(0, -1).flatten(-2)[None]
            solved = system.solve(columns)[0].unflatten(-1, (C, B)).movedim(-1, 0)
        else:
            solved = system.solve(right)
        return solved.reshape(B, -1, P, C)[:, :T]


def _each(pull: Tensor | float, like: Tensor) -> Tensor:
    return pull.to(like.dtype) if isinstance(pull, Tensor) else torch.full_like(like, pull)


def _bands(held: Tensor, smooth: Tensor, tied: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The matrix whose solutions are corrections: each frame is tied to the two before it.

    held, smooth (..., T, P) precisions of deltas and of their changes, tied (..., T, P, P - 1) of pairs -> each frame's
    own block (..., T, P, P), and what ties agents to themselves one and two frames before, (..., T, P) each
    """
    P = held.shape[-1]
    partner = partners(P, held.device)
    # Ordered pairs both ways as one symmetric matrix a frame: (..., T, P, P).
    both = torch.zeros(*held.shape, P, dtype=held.dtype, device=held.device)
    both = both.scatter(-1, partner.expand(tied.shape), tied)
    both = both + both.transpose(-1, -2)
    # (c[t] - 2 c[t - 1] + c[t - 2])^2, each times smooth[t]
    bend = torch.cat([torch.zeros_like(smooth[..., :2, :]), smooth[..., 2:, :]], dim=-2)[..., : held.shape[-2], :]
    bend_next, bend_after = _ahead(bend, 1), _ahead(bend, 2)
    own = held + _ahead(held, 1) + bend + 4 * bend_next + bend_after + GAUGE + both.sum(dim=-1)
    return torch.diag_embed(own) - both, -held - 2 * (bend + bend_next), bend


def _ahead(frames: Tensor, count: int) -> Tensor:
    """Each frame's value some frames later, 0 beyond the end. (..., T, P) -> same"""
    return pad(frames[..., count:, :], (0, 0, 0, count))[..., : frames.shape[-2], :]


def _in_twos(own: Tensor, before: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Bands of single frames as blocks of two frames, each tied only to the block before it.

    An odd last frame is paired with one that is tied to nothing.
    own (..., T, P, P), before and second (..., T, P) -> (..., T / 2, 2 P, 2 P) each: own blocks, ties
    """
    if own.shape[-3] % 2:
        own = _with_unit_blocks(own, 1)
        before, second = (pad(each, (0, 0, 0, 1)) for each in (before, second))
    near, far = torch.diag_embed(before), torch.diag_embed(second)
    inside, nothing = near[..., 1::2, :, :], torch.zeros_like(far[..., 1::2, :, :])
    upper = torch.cat([own[..., ::2, :, :], inside], dim=-1)
    lower = torch.cat([inside, own[..., 1::2, :, :]], dim=-1)
    lead = torch.cat([far[..., ::2, :, :], near[..., ::2, :, :]], dim=-1)
    tail = torch.cat([nothing, far[..., 1::2, :, :]], dim=-1)
    return torch.cat([upper, lower], dim=-2), torch.cat([lead, tail], dim=-2)


def _with_unit_blocks(blocks: Tensor, count: int) -> Tensor:
    """Blocks (..., T, P, P) with some more at the end that are tied to nothing."""
    unit = torch.eye(blocks.shape[-1], dtype=blocks.dtype, device=blocks.device)
    return torch.cat([blocks, unit.expand(*blocks.shape[:-3], count, -1, -1)], dim=-3)


@dataclass(frozen=True)
class BlockTridiagonal:
    """A factored symmetric positive definite matrix, whose blocks are tied to neighbouring ones only; see `factor`.

    Attributes:
        inner: Cholesky factors of what is eliminated: the whole matrix (..., T P, T P), or the first blocks of each run
            (..., S, (RUN - 1) P, (RUN - 1) P).
        reach: (..., S, (RUN - 1) P, 2 P) how the eliminated blocks depend on the last block of the run before and on
            the last one of their own run; None: nothing is left.
        rest: the matrix of what is left, the last block of each run.
    """

    inner: Tensor
    reach: Tensor | None = None
    rest: BlockTridiagonal | None = None

    def __getitem__(self, index: int) -> BlockTridiagonal:
        """One of several matrices that were factored together."""
        if self.reach is None or self.rest is None:
            return BlockTridiagonal(self.inner[index])
        return BlockTridiagonal(self.inner[index], self.reach[index], self.rest[index])

    def solve(self, right: Tensor) -> Tensor:
        """(..., T, P, C) -> (..., T, P, C)"""
        if self.reach is None or self.rest is None:
            return solved(right.flatten(-3, -2), self.inner).view(right.shape)
        T, P = right.shape[-3:-1]
        runs = pad(right, (0, 0, 0, 0, 0, -T % RUN)).unflatten(-3, (-1, RUN))
        first = runs[..., :-1, :, :].flatten(-3, -2)
        carried = self.reach.transpose(-1, -2) @ first
        onto = pad(carried[..., 1:, :P, :], (0, 0, 0, 0, 0, 1)) + carried[..., P:, :]
        last = self.rest.solve(runs[..., -1, :, :] - onto)
        around = torch.cat([pad(last, (0, 0, 0, 0, 1, -1)), last], dim=-2)
        first = solved(first, self.inner) - self.reach @ around
        both = torch.cat([first.unflatten(-2, (-1, P)), last.unsqueeze(-3)], dim=-3)
        return both.flatten(-4, -3)[..., :T, :, :]


def factor(diagonal: Tensor, before: Tensor) -> BlockTridiagonal:
    """Factor a symmetric positive definite matrix whose blocks are tied to neighbouring ones only.

    All but the last block of each run are eliminated at once. What is left is a matrix of the same kind, `RUN` times
    smaller; so T blocks take log T rounds of batched products.

    Args:
        diagonal: (..., T, P, P) each block on the diagonal.
        before: (..., T, P, P) what ties a block to the one before it; that of the first is not read.
    """
    T, P = diagonal.shape[-3:-1]
    if T == 1 or diagonal.shape[:-3].numel() * (T * P) ** 3 <= WHOLE:
        return BlockTridiagonal(factored(_whole(diagonal, before)))
    if T % RUN:
        diagonal = _with_unit_blocks(diagonal, -T % RUN)
        before = pad(before, (0, 0, 0, 0, 0, -T % RUN))
    before = torch.cat([torch.zeros_like(before[..., :1, :, :]), before[..., 1:, :, :]], dim=-3)
    diagonal, before = diagonal.unflatten(-3, (-1, RUN)), before.unflatten(-3, (-1, RUN))
    inner = factored(_whole(diagonal[..., :-1, :, :], before[..., :-1, :, :]))
    # What ties the first blocks of a run to the last one of the run before and to that of their own.
    entry, leave = before[..., 0, :, :], before[..., -1, :, :].transpose(-1, -2)
    further = (RUN - 2) * P
    ties = torch.cat([pad(entry, (0, 0, 0, further)), pad(leave, (0, 0, further, 0))], dim=-1)
    reach = solved(ties, inner)
    left = ties.transpose(-1, -2) @ reach
    onto = pad(left[..., 1:, :P, :P], (0, 0, 0, 0, 0, 1)) + left[..., P:, P:]
    return BlockTridiagonal(inner, reach, factor(diagonal[..., -1, :, :] - onto, -left[..., P:, :P]))


def _whole(diagonal: Tensor, before: Tensor) -> Tensor:
    """The matrix that blocks stand for. (..., T, P, P) x 2 -> (..., T P, T P)"""
    size = diagonal.shape[-3] * diagonal.shape[-1]
    below = torch.diag_embed(before[..., 1:, :, :].movedim(-3, -1), offset=-1, dim1=-4, dim2=-2)
    own = torch.diag_embed(diagonal.movedim(-3, -1), dim1=-4, dim2=-2)
    below, own = (each.reshape(*diagonal.shape[:-3], size, size) for each in (below, own))
    return own + below + below.transpose(-1, -2)
