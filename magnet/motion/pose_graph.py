"""Poses on the ground from deltas and pairwise transforms: one least-squares solve.

The unknowns are the headings and ground positions of all agents over consecutive frames. Deltas relate an agent's
frames to each other, pairwise transforms relate agents to each other, and each has a precision (one over its variance).
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
    """

    yaw: Tensor
    ground: Tensor
    yaw_precision: Tensor
    ground_precision: Tensor


def solve_pose_graph(deltas: Planar, pairs: Planar, start_yaw: Tensor, start_ground: Tensor) -> tuple[Tensor, Tensor]:
    """Headings and positions that fit deltas and pairwise transforms best, each by its precision.

    Minimises the squared differences between consecutive poses and the deltas, and between the agents of a frame
    and the pairwise transforms. With pairwise precisions of 0 it is the plain integration of the deltas.

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
    correction = _correct(deltas.yaw_precision, pairs.yaw_precision, off[..., None])
    yaw = yaw + correction[..., 0]
    before = torch.cat([start_yaw[:, None], yaw[:, :-1]], dim=1)
    ground = start_ground[:, None] + rotate_ground(before, deltas.ground.double()).cumsum(dim=1)
    seen = rotate_ground(yaw[..., None], pairs.ground.double())
    away = seen - (ground[:, :, partner] - ground[:, :, :, None])
    return yaw, ground + _correct(deltas.ground_precision, pairs.ground_precision, away)


def _correct(delta_precision: Tensor, pair_precision: Tensor, off: Tensor) -> Tensor:
    """Correction of each agent's integrated path in each frame.

    delta_precision (B, T, P), pair_precision (B, T, P, P - 1), off (B, T, P, P - 1, C), how far each pairwise transform
    is from the integrated paths -> (B, T, P, C)
    """
    B, T, P = delta_precision.shape
    delta, pair = delta_precision.double(), pair_precision.double()
    partner = partners(P, delta.device)
    pull = pair[..., None] * off
    right = (-pull.sum(dim=3)).index_add(2, partner.flatten(), pull.flatten(2, 3))
    # Ordered pairs both ways as one symmetric matrix a frame: (B, T, P, P).
    tie = torch.zeros(B, T, P, P, dtype=delta.dtype, device=delta.device).scatter(3, partner.expand(B, T, P, -1), pair)
    tie = tie + tie.transpose(2, 3)
    following = torch.nn.functional.pad(delta[:, 1:], (0, 0, 0, 1))
    frames = torch.diag_embed(delta + following + GAUGE + tie.sum(dim=3)) - tie
    return solve_block_tridiagonal(frames, torch.diag_embed(-delta), right)


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
