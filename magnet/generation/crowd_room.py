"""Strangers in a crowd keep some room: who walks near somebody who is no partner walks a little further off."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool1d, pad

ROOM = 2.5
"""Metres to a stranger within which people give way."""

SHARE = 0.3
"""Most metres that somebody gives way in a metre walked: nobody is moved who stands."""

SMOOTHED = 8
"""Frames before and after that steps are averaged over."""


def room_made(T_world_can: Tensor, new: Tensor, bonds: Tensor, present: Tensor) -> Tensor:
    """Canonical frames of some rows of tokens with those who walk turned a little away from strangers.

    Two people of a bond step aside together, as far as both walk on average, so that pairs stay as they are.

    Args:
        T_world_can: (1, T, P, 4, 4) where people stand.
        new: (T, P) bool, who may be moved, by frame; others stay where they are, bit for bit.
        bonds: (P, P) bool, who belong together.
        present: (P,) bool.

    Returns:
        (1, T, P, 4, 4)
    """
    ground = T_world_can[0][..., [0, 2], 3]  # (T, P, 2)
    together = bonds | torch.eye(len(bonds), dtype=torch.bool, device=bonds.device)
    between = ground[:, :, None] - ground[:, None]  # (T, P, P, 2), from the other to the one
    away = between.norm(dim=-1, keepdim=True).clamp_min(1e-6)
    strangers = (present[:, None] & present & ~together)[..., None]
    push = (between / away * (1 - away / ROOM).clamp_min(0.0) * strangers).sum(dim=2)  # (T, P, 2)
    steps = pad(ground.diff(dim=0).norm(dim=-1), (0, 0, 1, 0))
    width = 2 * SMOOTHED + 1
    steps = avg_pool1d(pad(steps.T[:, None], (SMOOTHED, SMOOTHED), mode="replicate"), width, stride=1)[:, 0].T
    group = together.to(ground) / together.sum(dim=1, keepdim=True)
    push, steps = torch.einsum("pq,tqd->tpd", group, push), steps @ group.T
    push = push / push.norm(dim=-1, keepdim=True).clamp_min(1.0)
    moved = (SHARE * steps[..., None] * push * new[..., None]).cumsum(dim=0)
    made = T_world_can.clone()
    made[0, :, :, 0, 3] += torch.where(new, moved[..., 0], 0.0)
    made[0, :, :, 2, 3] += torch.where(new, moved[..., 1], 0.0)
    return made
