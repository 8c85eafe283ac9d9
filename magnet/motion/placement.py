"""Places agents in the world by predicted deltas and pairwise transforms: one function for each way (paper 3.1).

To add a placement, write its function, name it in `Placement`, and list it in `PLACEMENTS`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from magnet.motion.cholesky import factored, inverted
from magnet.motion.frames import from_planar, partners, project_se2, to_planar
from magnet.motion.planar import rotate_ground
from magnet.waiting import is_recording

Placement = Literal["integrate", "anchor", "fuse"]

TURN = 2 * math.pi

ROUNDS = 3
"""How often `fuse` counts whole turns while a CUDA graph is recorded, when it cannot see whether they still change.

Twice suffices where pairs and deltas agree; where they contradict each other, it may take dozens.
"""

FIXED = 1e9
"""Weight of a delta that is known: `fuse` moves such an agent by less than rounding does."""


@dataclass(frozen=True)
class Predicted:
    """What a placement works from, in float64; B scenes, T frames, P agents.

    Attributes:
        delta_yaw, delta_ground: (B, T, P) radians and (B, T, P, 2) metres, from the frame before.
        start_yaw, start_ground: (B, P), (B, P, 2) where everybody was before the first frame.
        T_self_partner: (B, T, P, K, 4, 4), of K partner slots.
        partner: (P, K) int, whom each slot points at; one's own number: at nobody.
        present: (B, P) bool.
        fixed: (P,) bool, agents whose deltas are known.
        anchor: (B,) int, an agent of each scene whom others may be placed by.
        pairwise_weight: weight of a pairwise transform against a delta.
    """

    delta_yaw: Tensor
    delta_ground: Tensor
    start_yaw: Tensor
    start_ground: Tensor
    T_self_partner: Tensor | None
    partner: Tensor
    present: Tensor
    fixed: Tensor
    anchor: Tensor
    pairwise_weight: float


def place(
    deltas: Tensor,
    T_self_partner: Tensor | None,
    T_world_start: Tensor,
    placement: Placement = "integrate",
    pairwise_weight: float = 0.003,
    present: Tensor | None = None,
    fixed: Tensor | None = None,
    anchor: Tensor | None = None,
    partner: Tensor | None = None,
) -> Tensor:
    """World canonical frames of a predicted stretch of motion.

    Args:
        deltas: (B, T, P, 4, 4), delta from the frame before; the first leads away from `T_world_start`.
        T_self_partner: (B, T, P, P - 1, 4, 4). None, or one agent alone: every agent integrates its own deltas.
        T_world_start: (B, P, 4, 4) canonical frames at the last known frame.
        placement: `integrate`: every agent integrates its own deltas (the reference's way; agents may
            drift apart slowly). `anchor`: one agent integrates, its pairwise transforms place the others
            (no drift apart, but their own deltas are ignored). `fuse` (ours): a least-squares compromise of
            all deltas and all pairwise transforms at each frame, equal for all agents.
        pairwise_weight: `fuse` only: weight of one pairwise transform against one delta. 0 is `integrate`.
        present: (B, P) bool; pairs with absent agents are not read. None: all are present.
        fixed: (P,) bool, `fuse` only: agents whose deltas are known and stay exact. None: nobody.
        anchor: (B,) int, `anchor` only: the agent of each scene that places the others. None: agent 0.
        partner: (P, K) int, whom the K partner slots of each agent point at (its own number: at nobody). None: at
            everybody else. With it `T_self_partner` has K slots, and `anchor` cannot be used.

    Returns:
        T_world_can (B, T, P, 4, 4), in the dtype of `deltas`; computed in float64 so that thousands of
        frames add up exactly.
    """
    B, _, P = deltas.shape[:3]
    device = deltas.device
    predicted = Predicted(
        *to_planar(deltas.double()),
        *to_planar(T_world_start.double()),
        None if T_self_partner is None else T_self_partner.double(),
        partners(P, device) if partner is None else partner,
        torch.ones(B, P, dtype=torch.bool, device=device) if present is None else present,
        torch.zeros(P, dtype=torch.bool, device=device) if fixed is None else fixed.to(device),
        torch.zeros(B, dtype=torch.long, device=device) if anchor is None else anchor.to(device),
        pairwise_weight,
    )
    alone = T_self_partner is None or P == 1
    return PLACEMENTS["integrate" if alone else placement](predicted).to(deltas)


def integrate(predicted: Predicted) -> Tensor:
    """Every agent adds up its own deltas. -> T_world_can (B, T, P, 4, 4)"""
    start_yaw, start_ground = predicted.start_yaw[:, None], predicted.start_ground[:, None]
    yaw = start_yaw + predicted.delta_yaw.cumsum(dim=1)
    before = torch.cat([start_yaw, yaw[:, :-1]], dim=1)
    return from_planar(yaw, start_ground + rotate_ground(before, predicted.delta_ground).cumsum(dim=1))


def anchored(predicted: Predicted) -> Tensor:
    """One agent of each scene integrates; the others stand where its pairwise transforms put them."""
    assert predicted.T_self_partner is not None
    T_world_can, anchor = integrate(predicted), predicted.anchor
    scene = torch.arange(len(anchor), device=anchor.device)
    T_anchor_others = project_se2(predicted.T_self_partner[scene, :, anchor])
    T_world_others = T_world_can[scene, :, anchor][:, :, None] @ T_anchor_others  # (B, T, P - 1, 4, 4)
    others = predicted.partner[anchor]
    T_world_can[scene[:, None], :, others] = T_world_others.transpose(1, 2)
    return T_world_can


def fuse(predicted: Predicted) -> Tensor:
    """Frame by frame: minimise own * |pose - stepped pose|^2 + pairwise_weight * sum |pair - predicted pair|^2.

    Yaws first, then positions with those yaws: two linear systems with the same constant matrix,
    diag(own) + 2 pairwise_weight (graph Laplacian of the people present). own (P,) is each agent's weight. Each
    frame's poses are thus a constant matrix times the poses before, plus what the frame adds; so all frames are
    computed at once, by doubling (`accumulated`).
    """
    assert predicted.T_self_partner is not None
    pair_yaw, pair_ground = to_planar(predicted.T_self_partner)
    present, start_yaw, frames = predicted.present, predicted.start_yaw, predicted.delta_yaw.shape[1]
    own = torch.where(predicted.fixed, FIXED, torch.ones_like(start_yaw[0]))
    partner = predicted.partner
    somebody = partner != torch.arange(len(partner), device=partner.device)[:, None]
    met = present[:, :, None] & present[:, partner] & somebody  # (B, P, K)
    # No weight makes nothing of NaN: pairs that are not read are replaced.
    pair_yaw = torch.where(met[:, None], pair_yaw, 0.0)
    pair_ground = torch.where(met[:, None, ..., None], pair_ground, 0.0)
    each = predicted.pairwise_weight * met.to(start_yaw)
    together = (
        torch.zeros_like(each[:, :, :1]).expand(-1, -1, len(partner)).scatter_add(2, partner.expand(each.shape), each)
    )
    laplacian = torch.diag_embed(together.sum(-1) + together.sum(-2)) - (together + together.mT)
    solve = inverted(factored(torch.diag(own.to(start_yaw)) + laplacian))[:, None]
    keep = torch.eye(len(own), dtype=solve.dtype, device=solve.device) - solve @ laplacian[:, None]
    weight = each[:, None, ..., None]  # (B, 1, P, K, 1)

    def pulled(pairs: Tensor) -> Tensor:
        """What pairs (B, T, P, K, C) add to each agent: those that point at it, less its own. -> (B, T, P, C)"""
        weighted = weight * pairs
        return solve @ (-weighted.sum(dim=3)).index_add(2, partner.flatten(), weighted.flatten(2, 3))

    steps, begins = predicted.delta_yaw[..., None], start_yaw[:, None, :, None]
    turned = start_yaw[:, None] + predicted.delta_yaw.cumsum(dim=1)
    turns, recording = None, is_recording(turned.device)
    # A pair's heading counts the short way round: by whole turns that follow from the frames before. So those of the
    # first frame are right at once, and each round makes right those of one frame more, if not of all.
    for _ in range(ROUNDS if recording else max(frames, 1)):
        new = ((pair_yaw - (turned[:, :, partner] - turned[..., None])) / TURN).round()
        new = new.nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)  # NaN would never equal itself
        if turns is not None and not recording and torch.equal(new, turns):
            break
        turns = new
        yaw = accumulated(keep, keep @ steps + pulled((pair_yaw - TURN * turns)[..., None]), begins)[..., 0]
        turned = torch.cat([start_yaw[:, None], yaw[:, :-1]], dim=1) + predicted.delta_yaw
    before = torch.cat([start_yaw[:, None], yaw[:, :-1]], dim=1)
    moves = keep @ rotate_ground(before, predicted.delta_ground) + pulled(rotate_ground(yaw[..., None], pair_ground))
    return from_planar(yaw, accumulated(keep, moves, predicted.start_ground[:, None]))


def accumulated(keep: Tensor, added: Tensor, start: Tensor) -> Tensor:
    """x_t = keep x_{t-1} + added_t from a start, by doubling: log2 T products in place of T.

    keep (B, 1, P, P), added (B, T, P, C), start (B, 1, P, C) -> (B, T, P, C)
    """
    x = torch.cat([added[:, :1] + keep @ start, added[:, 1:]], dim=1)
    reach, power = 1, keep
    while reach < x.shape[1]:
        x = torch.cat([x[:, :reach], x[:, reach:] + power @ x[:, :-reach]], dim=1)
        reach, power = 2 * reach, power @ power
    return x


PLACEMENTS: dict[Placement, Callable[[Predicted], Tensor]] = {"integrate": integrate, "anchor": anchored, "fuse": fuse}
"""What each placement does, by name."""
