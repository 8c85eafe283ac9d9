"""Where people stand just before they are generated."""

from __future__ import annotations

import torch
from torch import Tensor

from magnet.motion.frames import align_planar, inverse, project_se2
from magnet.motion.placement import place


def starts(
    T_world_before: Tensor,
    T_world_first: Tensor,
    there: Tensor,
    now: Tensor,
    new: Tensor,
    present: Tensor,
    T_prev_can: Tensor,
    T_self_partner: Tensor | None,
) -> Tensor:
    """Canonical frames just before a token, such that the first delta leads to the right place. -> (B, P, 4, 4)

    Agents that were placed before continue from there. A new agent is placed so that its pairwise transforms to an
    anchor fit best over the window. The anchor is somebody who is known at the first frame, else somebody who was
    placed before, else the first new agent, who starts at the origin; in each scene somebody who is present.

    Args:
        T_world_before: (B, P, 4, 4) canonical frames of those placed before, in the frame before.
        T_world_first: (B, P, 4, 4) of those known at the first frame, there.
        there, now, new: (P,) bool, who was placed before, who is known at the first frame, who is generated.
        present: (B, P) bool.
        T_prev_can: (B, T, P, 4, 4) deltas.
        T_self_partner: (B, T, P, K, 4, 4) pairwise transforms; None: not predicted.
    """
    T_world_start = T_world_before.clone()
    if bool((there | ~present).all()):
        return T_world_start
    anchor = (present * (4 * now.int() + 2 * there.int() + new.int())).argmax(dim=1)
    scene = torch.arange(len(present), device=present.device)
    onward = T_world_start[scene, anchor] @ T_prev_can[scene, 0, anchor]
    onward = torch.where(there[anchor, None, None], onward, torch.eye(4, dtype=onward.dtype, device=onward.device))
    T_world_anchor = torch.where(now[anchor, None, None], T_world_first[scene, anchor], onward)
    for agent in (~there).nonzero()[:, 0].tolist():
        stands = T_world_first[:, agent] if bool(now[agent]) else T_world_anchor
        T_world_start[:, agent] = stands @ inverse(T_prev_can[:, 0, agent])
    if T_self_partner is None:
        return T_world_start
    ways = place(T_prev_can, None, T_world_start)
    for agent in (~there & ~now).nonzero()[:, 0].tolist():
        slot = (agent - (agent > anchor).int()).clamp(max=T_self_partner.shape[3] - 1)
        hung = ways[scene, :, anchor] @ project_se2(T_self_partner[scene, :, anchor, slot])
        shift = align_planar(ways[:, :, agent], hung)
        own = T_world_start[:, agent]
        T_world_start[:, agent] = torch.where((anchor == agent)[:, None, None], own, shift @ own)
    return T_world_start
