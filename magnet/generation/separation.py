"""New people are kept out of others' bodies before the model goes on from where they stand."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
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


@dataclass(frozen=True)
class MadeRows:
    """Rows of tokens that a stage has finished, and in front of them `lead` rows that they go on from.

    Attributes:
        first: number of the first row among those that the world holds.
        latent: (B, n, P, C).
        deltas: (B, n, P, 4, 9).
        T_world_can: (B, 4 n, P, 4, 4) where people stand.
        given: (B, 4 n) the rows of the scene: its shapes, who is there, and the poses of those who are known.
        new: (n, P) bool, who may be moved, by row.
        known: (n, P) bool, whose poses are in `given`.
        unseen: (P,) bool, whose motion the new ones may know no further than the lead; without one, they are not there.
        lead: rows.
        decentralized: the new ones do not see each other either; each makes way alone.
    """

    first: int
    latent: Tensor
    deltas: Tensor
    T_world_can: Tensor
    given: Scene
    new: Tensor
    known: Tensor
    unseen: Tensor
    lead: int
    decentralized: bool

    @property
    def frames(self) -> slice:
        """The rows' frames in the world."""
        return slice(self.first * TOKEN_FRAMES, (self.first + len(self.new)) * TOKEN_FRAMES)

    def bodies(self, decode: Decode, count: int) -> Scene:
        """Bodies of the first rows, decoded from these alone. -> (B, 4 count, P)"""
        given = self.given.slice(0, count * TOKEN_FRAMES)
        poses = decode(self.latent[:, :count], given.betas, self.deltas[:, :count])
        there = self.known[:count].repeat_interleave(TOKEN_FRAMES, dim=0)
        made = posed(poses, self.T_world_can[:, : given.frames], given)
        return made.with_poses(there, given.body_rot, given.T_world_root)

    def views(self) -> Iterator[tuple[Tensor, Tensor]]:
        """Who is moved together, and who is hidden from them. -> (P,) bool twice"""
        moving, agents = self.new.any(dim=0), torch.arange(self.new.shape[1], device=self.new.device)
        for who in [agents == agent for agent in agents[moving]] if self.decentralized else [moving]:
            yield who, self.unseen | (moving & ~who)


@torch.no_grad()
def separated(decode: Decode, rows: MadeRows, how: str) -> Tensor:
    """Canonical frames of some rows with the new people moved so far that bodies do not collide.

    Bodies are those of the open body: its capsules are close enough for any shape numbers and joints. Who is unseen is
    taken to stand still after the lead.

    Args:
        decode: the tokenizer's.
        rows: with a lead of one row, or none at the beginning of a scene.
        how: a name in `APART`.

    Returns:
        (B, 4 n, P, 4, 4); others stay where they are, bit for bit.
    """
    body, begun = open_body_on(rows.latent.device), bool(rows.lead)
    joints = body.joints(rows.bodies(decode, len(rows.new)).replace(body=body.id))
    still, may = joints, rows.new.repeat_interleave(TOKEN_FRAMES, dim=0)
    if begun:
        last = body.joints(rows.bodies(decode, 1).replace(body=body.id))[:, -1:]
        held = last.expand(-1, joints.shape[1] - TOKEN_FRAMES, -1, -1, -1)
        still = torch.cat([joints[:, :TOKEN_FRAMES], held], dim=1)
    moved = torch.zeros_like(rows.T_world_can[..., :2, 3])
    for who, hidden in rows.views():
        present = rows.given.present if begun else rows.given.present & ~hidden
        seen = torch.where(hidden[:, None, None], still, joints)
        moved = moved + kept_apart(seen, present, ~(may & who), APART[how], begun)
    T_new_world = from_planar(torch.zeros_like(moved[..., 0]), moved)
    return torch.where((moved == 0).all(dim=-1)[..., None, None], rows.T_world_can, T_new_world @ rows.T_world_can)
