"""New people are kept out of others' bodies before the model goes on from where they stand."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import torch
from torch import Tensor

from magnet.body import Body, load_body
from magnet.body.apart import APART, kept_apart
from magnet.motion.frames import from_planar, posed
from magnet.motion.scene import Scene
from magnet.motion.tokens import TOKEN_FRAMES

Decode = Callable[[Tensor, Tensor, Tensor], Tensor]
"""latent (B, n, P, C), betas (B, P, 10), deltas (B, n, P, 4, 9) -> poses (B, 4 n, P, 135)"""


@lru_cache(maxsize=4)
def open_body_on(device: torch.device) -> Body:
    """Bodies while sampling are the open body's: where the skin lies is told well enough by anybody's shape numbers."""
    return load_body().requires_grad_(False).to(device)


@torch.no_grad()
def separated(
    decode: Decode,
    latent: Tensor,
    deltas: Tensor,
    T_world_can: Tensor,
    given: Scene,
    new: Tensor,
    how: str,
    begun: bool,
    known: Tensor,
    unseen: Tensor,
    decentralized: bool = False,
) -> Tensor:
    """Canonical frames of some rows of tokens with the new people moved so far that bodies do not collide.

    Bodies are those of the open body: its capsules are close enough for any shape numbers and joints.

    Args:
        decode: the tokenizer's.
        latent: (B, n, P, C) of the rows.
        deltas: (B, n, P, 4, 9) of the rows.
        T_world_can: (B, 4 n, P, 4, 4) where people stand.
        given: (B, 4 n) the rows of the scene: its shapes, who is there, and the poses of those who are known.
        new: (n, P) bool, who may be moved, by row.
        how: a name in `APART`.
        begun: the first row is one of before, whence the new ones go on.
        known: (n, P) bool, whose poses are in `given`.
        unseen: (P,) bool, whose motion the new ones may know no further than the first row: they are taken to stand
            still from there on.
        decentralized: the new ones do not see each other either; each makes way alone.

    Returns:
        (B, 4 n, P, 4, 4); others stay where they are, bit for bit.
    """

    def bodies(rows: slice) -> Tensor:
        """Joints in some of the rows, decoded from these alone. -> (B, 4 n, P, 22, 3)"""
        frames = slice((rows.start or 0) * TOKEN_FRAMES, None if rows.stop is None else rows.stop * TOKEN_FRAMES)
        recorded = given.frames_at(frames)
        made = posed(decode(latent[:, rows], given.betas, deltas[:, rows]), T_world_can[:, frames], recorded)
        body, there = open_body_on(latent.device), known[rows].repeat_interleave(TOKEN_FRAMES, dim=0)
        real, decoded = (body.joints(scene.replace(body=body.id)) for scene in (recorded, made))
        return torch.where(there[..., None, None], real, decoded)

    joints, rows = bodies(slice(None)), new.repeat_interleave(TOKEN_FRAMES, dim=0)
    still = joints
    if begun:
        last = bodies(slice(0, 1))[:, -1:]
        still = torch.cat(
            [joints[:, :TOKEN_FRAMES], last.expand(-1, joints.shape[1] - TOKEN_FRAMES, -1, -1, -1)], dim=1
        )
    moved = torch.zeros_like(T_world_can[..., :2, 3])
    agents = torch.arange(new.shape[1], device=new.device)
    for who in [agents == agent for agent in agents[new.any(dim=0)]] if decentralized else [new.any(dim=0)]:
        hidden = unseen | (new.any(dim=0) & ~who)
        present = given.present if begun else given.present & ~hidden
        seen = torch.where(hidden[:, None, None], still, joints)
        moved = moved + kept_apart(seen, present, ~(rows & who), APART[how], begun)
    T_new_world = from_planar(torch.zeros_like(moved[..., 0]), moved)
    return torch.where((moved == 0).all(dim=-1)[..., None, None], T_world_can, T_new_world @ T_world_can)
