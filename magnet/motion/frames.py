"""Frames of reference: root, canonical and partner frames (paper 3.1); `placement` leads back into the world.

A transform carries the names of its two frames and the names cancel:
`T_self_partner = inverse(T_world_self) @ T_world_partner`. Transforms are (..., 4, 4), metres, y up.
A canonical frame stands on the ground under the pelvis and is turned about the vertical only, so it
is fully described by a yaw and a ground position: its *planar* form.
"""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from magnet.motion.planar import rotate_ground
from magnet.motion.rotations import from_6d, to_6d, yaw_of
from magnet.motion.scene import Scene

UPRIGHT = 1e-3
"""Where the left axis is horizontally shorter than this, the person lies on the side and the axis gives no yaw."""


# -- transforms --------------------------------------------------------------------------------


def inverse(T_a_b: Tensor) -> Tensor:
    """T_b_a of a rigid transform, exact and cheaper than a matrix inverse. (..., 4, 4) -> (..., 4, 4)

    >>> T_world_ann = from_planar(torch.tensor(1.0), torch.tensor([2.0, 3.0]))
    >>> torch.allclose(inverse(T_world_ann) @ T_world_ann, torch.eye(4), atol=1e-6)
    True
    """
    R_b_a = T_a_b[..., :3, :3].transpose(-1, -2)
    return _with_last_row(torch.cat([R_b_a, -(R_b_a @ T_a_b[..., :3, 3:])], dim=-1))


def rigid(R_a_b: Tensor, t_a_b: Tensor) -> Tensor:
    """T_a_b from a rotation and the origin of b in a. (..., 3, 3), (..., 3) -> (..., 4, 4)"""
    return _with_last_row(torch.cat([R_a_b, t_a_b[..., None]], dim=-1))


def _with_last_row(top: Tensor) -> Tensor:
    """(..., 3, 4) -> (..., 4, 4)"""
    return torch.cat([top, _last_row(top.dtype, top.device).expand(*top.shape[:-2], 1, 4)], dim=-2)


@functools.cache
def _last_row(dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):  # or training, later, could not use it
        return torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=dtype, device=device)


def to_9d(T_a_b: Tensor) -> Tensor:
    """Rotation in 6-D, then translation in metres. (..., 4, 4) -> (..., 9)

    >>> to_9d(rigid(torch.eye(3), torch.tensor([0.5, 0.0, 2.0])))
    tensor([1.0000, 0.0000, 0.0000, 0.0000, 1.0000, 0.0000, 0.5000, 0.0000, 2.0000])
    """
    columns = T_a_b[..., :3, :].transpose(-1, -2)
    return torch.cat([columns[..., :2, :], columns[..., 3:, :]], dim=-2).flatten(-2)


def from_9d(nine: Tensor) -> Tensor:
    """The rigid transform nearest to nine numbers. (..., 9) -> (..., 4, 4)"""
    return rigid(from_6d(nine[..., :6]), nine[..., 6:])


def to_planar(T_a_b: Tensor) -> tuple[Tensor, Tensor]:
    """Yaw (...) in radians and ground position (..., 2) as (x, z) in metres; height and tilt are dropped.

    >>> yaw, ground = to_planar(from_planar(torch.tensor(0.3), torch.tensor([1.0, 2.0])))
    >>> yaw, ground
    (tensor(0.3000), tensor([1., 2.]))
    """
    return yaw_of(T_a_b[..., :3, :3]), T_a_b[..., 0:3:2, 3]


def from_planar(yaw: Tensor, ground: Tensor) -> Tensor:
    """Inverse of `to_planar`. (...), (..., 2) -> (..., 4, 4)"""
    return _on_ground(yaw.sin(), yaw.cos(), ground)


def _on_ground(sin: Tensor, cos: Tensor, ground: Tensor) -> Tensor:
    """A turn about the vertical and a place, number by number. (...), (...), (..., 2) -> (..., 4, 4)"""
    zero, one, (x, z) = torch.zeros_like(sin), torch.ones_like(sin), ground.unbind(-1)
    rows = [cos, zero, sin, x, zero, one, zero, zero, -sin, zero, cos, z, zero, zero, zero, one]
    return torch.stack(rows, dim=-1).unflatten(-1, (4, 4))


# -- from a scene to what tokens hold ----------------------------------------------------------


def canonical_frame(T_world_root: Tensor) -> Tensor:
    """Frame on the ground under the pelvis, facing where the pelvis faces. (..., 4, 4) -> same

    The yaw comes from the pelvis's left axis, which stays horizontal in bows and dips where a forward
    axis would flip. For a person lying exactly on the side it comes from the forward axis, then horizontal. Each frame
    is computed alone, so that it does not depend on which others are known.

    >>> T_world_root = from_planar(torch.tensor(0.3), torch.tensor([1.0, 2.0]))
    >>> T_world_root[1, 3] = 0.9  # a pelvis 0.9 m up
    >>> canonical_frame(T_world_root)[:3, 3]
    tensor([1., 0., 2.])
    """
    left, forward = T_world_root[..., :3, 0], T_world_root[..., :3, 2]
    upright = left[..., 0:3:2].norm(dim=-1) >= UPRIGHT
    sine = torch.where(upright, -left[..., 2], forward[..., 0])
    cosine = torch.where(upright, left[..., 0], forward[..., 2])
    # No angle is taken: sines, unlike roots, may be rounded otherwise in another place of a batch.
    length = (sine * sine + cosine * cosine).sqrt().clamp_min(1e-12)
    return _on_ground(sine / length, cosine / length, T_world_root[..., 0:3:2, 3])


def canonical_deltas(T_world_can: Tensor) -> Tensor:
    """dT_can(t) = inverse(T_can(t-1)) @ T_can(t), the identity at the first frame. (..., T, P, 4, 4) -> same

    >>> T_world_can = torch.eye(4).repeat(3, 1, 1, 1)  # three frames of one person
    >>> T_world_can[:, 0, 2, 3] = torch.tensor([0.0, 0.1, 0.3])  # who walks forward, along z
    >>> canonical_deltas(T_world_can)[:, 0, 2, 3]
    tensor([0.0000, 0.1000, 0.2000])
    """
    before = torch.cat([T_world_can[..., :1, :, :, :], T_world_can[..., :-1, :, :, :]], dim=-4)
    deltas = inverse(before) @ T_world_can
    deltas[..., :1, :, :, :] = torch.eye(4, dtype=deltas.dtype, device=deltas.device)
    return deltas


def partners(agents: int, device: torch.device | None = None) -> Tensor:
    """Which agent each partner slot of an agent points at: everybody else, in order. (P, P - 1) int

    >>> partners(3)
    tensor([[1, 2],
            [0, 2],
            [0, 1]])
    """
    return _partners(agents, device)


@functools.cache
def _partners(agents: int, device: torch.device | None) -> Tensor:
    with torch.inference_mode(False):  # or training, later, could not use it
        slot = torch.arange(max(agents - 1, 0), device=device).expand(agents, -1)
        return slot + (slot >= torch.arange(agents, device=device)[:, None])


def pairwise(T_world_can: Tensor, partner: Tensor | None = None) -> Tensor:
    """T_self_partner of every agent and partner slot. (..., P, 4, 4) -> (..., P, P - 1, 4, 4)

    partner (P, K) int: whom each slot points at, by default as `partners` has it.

    >>> yaws, ground = torch.tensor([0.0, torch.pi]), torch.tensor([[0.0, 0.0], [0.0, 2.0]])
    >>> T_self_partner = pairwise(from_planar(yaws, ground))  # two people face each other, 2 m apart
    >>> T_self_partner[:, 0, 2, 3]  # so each has the other 2 m in front
    tensor([2., 2.])
    """
    partner = partners(T_world_can.shape[-3], T_world_can.device) if partner is None else partner
    T_world_partner = T_world_can[..., partner, :, :]
    return inverse(T_world_can)[..., None, :, :] @ T_world_partner


def pose_features(scene: Scene) -> Tensor:
    """What the tokenizer sees of a body: 21 joint rotations in 6-D and T_can_root in 9-D. -> (B, T, P, 135)"""
    T_can_root = inverse(canonical_frame(scene.T_world_root)) @ scene.T_world_root
    return torch.cat([to_6d(scene.body_rot).flatten(-2), to_9d(T_can_root)], dim=-1)


POSE_FEATURES = 21 * 6 + 9


def posed(features: Tensor, T_world_can: Tensor, like: Scene) -> Scene:
    """Inverse of `pose_features`: bodies placed at canonical frames. (B, T, P, 135), (B, T, P, 4, 4)

    Shapes, presence, names and body come from `like`; nothing else of it is read.
    """
    body_rot = from_6d(features[..., : 21 * 6].unflatten(-1, (21, 6)))
    T_world_root = T_world_can @ from_9d(features[..., 21 * 6 :])
    there = like.present[:, None, :, None, None]
    eye = torch.eye(4, dtype=features.dtype, device=features.device)
    return like.replace(
        body_rot=torch.where(there[..., None], body_rot, eye[:3, :3]),
        T_world_root=torch.where(there, T_world_root, eye),
        valid=None,
    )


def align_planar(path: Tensor, target: Tensor) -> Tensor:
    """The planar transform that best aligns a path with another: headings first, then positions.

    (..., T, 4, 4), (..., T, 4, 4) -> (..., 4, 4); the result times `path` is about `target`.
    """
    (yaw, ground), (yaw_target, ground_target) = to_planar(path), to_planar(target)
    off = yaw_target - yaw
    turned = torch.atan2(off.sin().mean(dim=-1), off.cos().mean(dim=-1))
    return from_planar(turned, (ground_target - rotate_ground(turned[..., None], ground)).mean(dim=-2))


def project_se2(T: Tensor) -> Tensor:
    """Nearest transform that only turns about the vertical and moves on the ground. (..., 4, 4) -> same"""
    return from_planar(*to_planar(T))
