"""Goals that stay the same from step to step of a correction: which points shall be where, and how much that counts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from magnet.body.indices import indices, pairs_of
from magnet.body.joints import ANKLES, FEET, TOES, WRISTS
from magnet.body.settle_options import Settle
from magnet.body.settle_wishes import Wishes

WEIGHTS = {"between": 200.0, "within": 15.0, "hold": 10.0, "stand": 60.0, "height": 30.0, "floor": 30.0, "float": 60.0}
"""Cost of a squared metre of each kind."""

HAND = 22
"""Number of a left hand among a body's points, behind those of its joints; the right hand is the next."""

BONES = (*range(HAND), *WRISTS)
"""The bone that each point is fixed to."""


class Rows(NamedTuple):
    """M goals: along . (point - other point) shall be `goal` metres, or for one-sided ones at most that."""

    node: Tensor  # (M,) int, one person in one frame, in the order (B, T, P)
    place: Tensor  # (M,) int, a joint or a hand
    other: Tensor  # (M,) int
    other_place: Tensor
    along: Tensor  # (M, 3) of unit length
    goal: Tensor  # (M,)
    root_weight: Tensor  # (M,)
    two: Tensor  # (M,) 1: the other point moves, too; 0: there is none
    one_sided: Tensor  # (M,) bool


@dataclass(frozen=True)
class Goals:
    """What people who are free shall fulfil, as rows; depth apart.

    Attributes:
        rows: three of each pair of hands that hold, then those of feet, last the floor under the four joints of each
            free node's.
        holds: how many pairs of hands.
        float_node: (F,) nodes whose lower foot shall not be too high.
        clearance: (F, 4) height of their feet's joints over the sole, metres.
        highest: (F,) metres over the floor.
        both: (B, T, Q) bool, pairs of people who may be deep in each other.
        own: b, t, p of each free node.
        before: (B, 1, P, 22, 3) joints in the frame before; None: there is none.
        fps: frames a second.
        settle: what each kind costs.
    """

    rows: Rows
    holds: int
    float_node: Tensor
    clearance: Tensor
    highest: Tensor
    both: Tensor
    own: tuple[Tensor, Tensor, Tensor]
    before: Tensor | None
    fps: float
    settle: Settle

    @classmethod
    def of(cls, wishes: Wishes, free: Tensor, settle: Settle) -> Goals:
        """The goals of people who are free (B, T, P) bool. wishes: `Wishes.of_those` who are free"""
        T, P = free.shape[1:]
        first, second = pairs_of(P, free.device)

        def node(b: Tensor, t: Tensor, p: Tensor) -> Tensor:
            return (b * T + t) * P + p

        b, t, pair, i, j = wishes.held.nonzero(as_tuple=True)
        reach = node(b, t, second[pair]), HAND + j
        hands = wishes.between[b, t, pair, i, j]
        parts = [rows_of("hold", node(b, t, first[pair]), HAND + i, (0, 1, 2), hands, settle.hold, reach)]
        feet, toes = (indices(joints, free.device) for joints in (FEET, TOES))
        b, t, p, i = wishes.stands.nonzero(as_tuple=True)
        still, before = wishes.between.new_zeros(len(b), 2), (node(b, t, p), feet[i])
        parts.append(rows_of("stand", node(b, t + 1, p), feet[i], (0, 2), still, settle.stand, before))
        if wishes.stood is not None:
            b, p, i = wishes.stood.isfinite().all(dim=-1).nonzero(as_tuple=True)
            parts.append(rows_of("stand", node(b, b * 0, p), feet[i], (0, 2), wishes.stood[b, p, i], settle.stand))
        keep = wishes.heights.isfinite()
        if settle.swing:  # toes that stand neither before nor after are to be lifted
            standing = wishes.stands[..., len(ANKLES) :]
            keep = keep & (F.pad(standing, (0, 0, 0, 0, 1, 0)) | F.pad(standing, (0, 0, 0, 0, 0, 1)))
        b, t, p, i = keep.nonzero(as_tuple=True)
        parts.append(rows_of("height", node(b, t, p), toes[i], (1,), wishes.heights[b, t, p, i][:, None]))
        b, t, p = free.nonzero(as_tuple=True)
        own, low = (b, t, p), -wishes.clearance[b, p].view(-1, 1)
        soles = node(b, t, p).repeat_interleave(len(feet)), feet.repeat(len(b))
        parts.append(rows_of("floor", *soles, (1,), low, down=True))
        b, t, p = (free & wishes.highest.isfinite()).nonzero(as_tuple=True)
        return cls(
            rows=Rows(*(torch.cat(each) for each in zip(*parts, strict=True))),
            holds=len(hands),
            float_node=node(b, t, p),
            clearance=wishes.clearance[b, p],
            highest=wishes.highest[b, t, p],
            both=(wishes.present[:, first] & wishes.present[:, second])[:, None]
            & (free[..., first] | free[..., second]),
            own=own,
            before=wishes.before,
            fps=wishes.fps,
            settle=settle,
        )


def rows_of(
    kind: str,
    node: Tensor,
    place: Tensor,
    axes: tuple[int, ...],
    goal: Tensor,
    factor: float = 1.0,
    other: tuple[Tensor, Tensor] | None = None,
    down: bool = False,
) -> Rows:
    """Goals of one kind along some of the world's axes.

    Args:
        kind: a name in `WEIGHTS`.
        node, place: (M,) int.
        axes: A of them.
        goal: (M, A) metres.
        factor: of the kind's cost.
        other: node and place of the point that it is measured from; None: the origin.
        down: against the axes.
    """
    node, place, far, far_place = (x.repeat_interleave(len(axes)) for x in (node, place, *(other or (node, place))))
    along = torch.eye(3, dtype=goal.dtype, device=goal.device)[list(axes)].repeat(len(goal), 1)
    flat = goal.flatten()
    weight = torch.full_like(flat, (WEIGHTS[kind] * factor) ** 0.5)
    one_sided = torch.full_like(flat, kind == "floor", dtype=torch.bool)
    two = torch.full_like(flat, float(other is not None))
    return Rows(node, place, far, far_place, -along if down else along, flat, weight, two, one_sided)
