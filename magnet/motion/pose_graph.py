"""Poses on the ground from deltas and pairwise transforms: one least-squares solve.

The unknowns are the headings and ground positions of all agents over consecutive frames. Deltas relate an agent's
frames to each other, pairwise transforms relate agents to each other, and each has a precision (one over its variance).
Errors of predicted deltas are alike in neighbouring frames (somebody walks a little too fast for a while), so a
correction may be asked to be smooth: then high frequencies come from the deltas, and low ones from the pairs.
Headings are solved first, then positions with those headings: two linear systems in closed form, without iterations.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from magnet.motion.frames import partners
from magnet.motion.planar import rotate_ground

GAUGE = 1e-6
"""Small precision of the integrated deltas, which decides where nothing else determines a position."""


@dataclass(frozen=True)
class Planar:
    """Turns about the vertical and moves over the ground, with how sure they are.

    Attributes:
        yaw: (...) radians.
        ground: (..., 2) metres, (x, z).
        yaw_precision: (...) 1 / rad^2; 0 where nothing is known.
        ground_precision: (...) 1 / m^2.
        yaw_smoothness, ground_smoothness: (...) of deltas: precision of the change of a delta's error from the frame
            before, 1 / rad^2 and 1 / m^2; that of the first frame is not read. None: errors are independent.
    """

    yaw: Tensor
    ground: Tensor
    yaw_precision: Tensor
    ground_precision: Tensor
    yaw_smoothness: Tensor | None = None
    ground_smoothness: Tensor | None = None


def solve_pose_graph(deltas: Planar, pairs: Planar, start_yaw: Tensor, start_ground: Tensor) -> tuple[Tensor, Tensor]:
    """Headings and positions that fit deltas and pairwise transforms best, each by its precision.

    Minimises the squared differences between consecutive poses and the deltas, their changes from frame to frame, and
    the differences between the agents of a frame and the pairwise transforms. With pairwise precisions of 0 it is the
    plain integration of the deltas.

    Args:
        deltas: (B, T, P): T_prev_now of each agent; the first leads away from the start.
        pairs: (B, T, P, P - 1): T_self_partner, in the order of `partners`.
        start_yaw: (B, P) headings before the first frame. How firmly they hold is the first delta's precision.
        start_ground: (B, P, 2) positions before the first frame.

    Returns:
        yaw (B, T, P) and ground (B, T, P, 2), in float64.
    """
    start_yaw, start_ground = start_yaw.double(), start_ground.double()
    partner = partners(deltas.yaw.shape[2], deltas.yaw.device)
    yaw = start_yaw[:, None] + deltas.yaw.double().cumsum(dim=1)
    off = pairs.yaw.double() - (yaw[:, :, partner] - yaw[..., None])
    off = torch.atan2(off.sin(), off.cos())
    correction = _correct(deltas.yaw_precision, deltas.yaw_smoothness, pairs.yaw_precision, off[..., None])
    yaw = yaw + correction[..., 0]
    before = torch.cat([start_yaw[:, None], yaw[:, :-1]], dim=1)
    ground = start_ground[:, None] + rotate_ground(before, deltas.ground.double()).cumsum(dim=1)
    seen = rotate_ground(yaw[..., None], pairs.ground.double())
    away = seen - (ground[:, :, partner] - ground[:, :, :, None])
    return yaw, ground + _correct(deltas.ground_precision, deltas.ground_smoothness, pairs.ground_precision, away)


def _correct(delta_precision: Tensor, smoothness: Tensor | None, pair_precision: Tensor, off: Tensor) -> Tensor:
    """Correction of each agent's integrated path in each frame.

    delta_precision, smoothness (B, T, P), pair_precision (B, T, P, P - 1), off (B, T, P, P - 1, C), how far each
    pairwise transform is from the integrated paths -> (B, T, P, C)
    """
    B, T, P = delta_precision.shape
    delta, pair = delta_precision.double(), pair_precision.double()
    partner = partners(P, delta.device)
    pull = pair[..., None] * off
    right = (-pull.sum(dim=3)).index_add(2, partner.flatten(), pull.flatten(2, 3))
    # Ordered pairs both ways as one symmetric matrix a frame: (B, T, P, P).
    tie = torch.zeros(B, T, P, P, dtype=delta.dtype, device=delta.device).scatter(3, partner.expand(B, T, P, -1), pair)
    tie = tie + tie.transpose(2, 3)
    own = delta + _ahead(delta, 1) + GAUGE
    if smoothness is None:
        return solve_block_tridiagonal(_tied(own, tie), torch.diag_embed(-delta), right)
    # (c[t] - 2 c[t - 1] + c[t - 2])^2, each times smoothness[t]: frames are coupled with the two before them.
    bend = torch.nn.functional.pad(smoothness.double()[:, 2:], (0, 0, 2, 0))[:, :T]
    own = own + bend + 4 * _ahead(bend, 1) + _ahead(bend, 2)
    return _solve_in_twos(_tied(own, tie), -delta - 2 * bend - 2 * _ahead(bend, 1), bend, right)


def _tied(own: Tensor, tie: Tensor) -> Tensor:
    """own (B, T, P) and what ties agents to each other (B, T, P, P) -> each frame's own block (B, T, P, P)"""
    return torch.diag_embed(own + tie.sum(dim=3)) - tie


def _ahead(frames: Tensor, count: int) -> Tensor:
    """Each frame's value some frames later, 0 beyond the end. (B, T, P) -> same"""
    return torch.nn.functional.pad(frames[:, count:], (0, 0, 0, count))[:, : frames.shape[1]]


def _solve_in_twos(diagonal: Tensor, before: Tensor, second: Tensor, right: Tensor) -> Tensor:
    """Solve a system that couples each frame with the two before it, as one of blocks of two frames.

    diagonal (B, T, P, P), before and second (B, T, P), what couples an agent with itself one and two frames before,
    right (B, T, P, C) -> (B, T, P, C)
    """
    B, T, P = right.shape[:3]
    if T % 2:  # one frame more, tied to nothing
        eye = torch.eye(P, dtype=diagonal.dtype, device=diagonal.device).expand(B, 1, P, P)
        diagonal = torch.cat([diagonal, eye], dim=1)
        before, second, right = (torch.cat([x, torch.zeros_like(x[:, :1])], dim=1) for x in (before, second, right))
    near, far = torch.diag_embed(before), torch.diag_embed(second)
    nothing = torch.zeros_like(near[:, ::2])
    upper = torch.cat([diagonal[:, ::2], near[:, 1::2]], dim=3)
    lower = torch.cat([near[:, 1::2], diagonal[:, 1::2]], dim=3)
    lead = torch.cat([far[:, ::2], near[:, ::2]], dim=3)
    tail = torch.cat([nothing, far[:, 1::2]], dim=3)
    blocks = torch.cat([upper, lower], dim=2), torch.cat([lead, tail], dim=2)
    solved = solve_block_tridiagonal(*blocks, right.unflatten(1, (-1, 2)).flatten(2, 3))
    return solved.unflatten(2, (2, P)).flatten(1, 2)[:, :T]


def solve_block_tridiagonal(diagonal: Tensor, before: Tensor, right: Tensor) -> Tensor:
    """Solve a symmetric positive definite system whose blocks couple neighbouring frames only, by cyclic reduction.

    Every second frame is eliminated at once, so that T frames take log2 T rounds of batched small products.

    Args:
        diagonal: (B, T, P, P) each frame's own block.
        before: (B, T, P, P) block that ties a frame to the one before it; that of the first frame is not read.
        right: (B, T, P, C).

    Returns:
        (B, T, P, C).
    """
    T = diagonal.shape[1]
    if T == 1:
        return torch.linalg.solve(diagonal, right)
    before = torch.cat([torch.zeros_like(before[:, :1]), before[:, 1:]], dim=1)
    if T % 2:  # one frame more, tied to nothing
        eye = torch.eye(diagonal.shape[-1], dtype=diagonal.dtype, device=diagonal.device)
        diagonal = torch.cat([diagonal, eye.expand_as(diagonal[:, :1])], dim=1)
        before, right = (torch.cat([each, torch.zeros_like(each[:, :1])], dim=1) for each in (before, right))
    lead, tail = before[:, 0::2], before[:, 1::2]  # into even frames from odd ones, into odd frames from even ones
    inverse = torch.linalg.inv(diagonal[:, 1::2])
    # What an even frame gets from the odd frame behind it, and from the odd frame ahead of it.
    ahead = tail.transpose(-1, -2) @ inverse
    behind = lead[:, 1:] @ inverse[:, :-1]
    odd = right[:, 1::2]
    kept = diagonal[:, 0::2] - ahead @ tail
    kept_right = right[:, 0::2] - ahead @ odd
    kept = torch.cat([kept[:, :1], kept[:, 1:] - behind @ lead[:, 1:].transpose(-1, -2)], dim=1)
    kept_right = torch.cat([kept_right[:, :1], kept_right[:, 1:] - behind @ odd[:, :-1]], dim=1)
    tied = torch.cat([torch.zeros_like(lead[:, :1]), -behind @ tail[:, :-1]], dim=1)
    even = solve_block_tridiagonal(kept, tied, kept_right)
    following = torch.cat([lead[:, 1:].transpose(-1, -2) @ even[:, 1:], torch.zeros_like(even[:, :1])], dim=1)
    between = inverse @ (odd - tail @ even - following)
    return torch.stack([even, between], dim=2).flatten(1, 2)[:, :T]
