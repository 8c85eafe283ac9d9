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
from magnet.motion.tokens import STRIDE

Decode = Callable[[Tensor, Tensor, Tensor], Tensor]
"""latent (B, n, P, C), betas (B, P, 10), deltas (B, n, P, 4, 9) -> poses (B, 4 n, P, 135)"""


@lru_cache(maxsize=4)
def _body(device: torch.device) -> Body:
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
) -> Tensor:
    """Canonical frames of some rows of tokens with the new people moved so far that bodies do not collide.

    Bodies are those of the open body: where capsules lie is told well enough by anybody's shape numbers and joints.

    Args:
        decode: the tokenizer's.
        latent: (B, n, P, C) of the rows.
        deltas: (B, n, P, 4, 9) of the rows.
        T_world_can: (B, 4 n, P, 4, 4) where people stand.
        given: (B, 4 n) the rows of the scene, for shapes and who is there.
        new: (n, P) bool, who may be moved, by row.
        how: a name in `APART`.
        begun: somebody stood in front of these rows, whence the new ones go on.

    Returns:
        (B, 4 n, P, 4, 4); others stay where they are, bit for bit.
    """
    features = decode(latent, given.betas, deltas)
    joints = _body(latent.device).joints(posed(features, T_world_can, given).replace(body="open-1"))
    fixed = ~new.repeat_interleave(STRIDE, dim=0)
    moved = kept_apart(joints, given.present, fixed, APART[how], begun)
    T_new_world = from_planar(torch.zeros_like(moved[..., 0]), moved)
    still = (moved == 0).all(dim=-1)[..., None, None]
    return torch.where(still, T_world_can, T_new_world @ T_world_can)
