"""Frames of reference: root, canonical and partner frames, and the way back into the world (paper 3.1).

A transform carries the names of its two frames and the names cancel:
`T_self_partner = inverse(T_world_self) @ T_world_partner`. Transforms are (..., 4, 4), metres, y up.
A canonical frame stands on the ground under the pelvis and is turned about the vertical only, so it
is fully described by a yaw and a ground position: its *planar* form.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from magnet.motion.planar import rotate_ground
from magnet.motion.rotations import about_y, about_y_of, from_6d, to_6d, yaw_of
from magnet.motion.scene import Scene

Placement = Literal["integrate", "anchor", "fuse"]

FIXED = 1e9
"""Weight of a delta that is known: `fuse` moves such an agent by less than rounding does."""

UPRIGHT = 1e-3
"""Below this horizontal length of the left axis the person lies on the side, and the axis tells no yaw."""


# -- transforms --------------------------------------------------------------------------------


def inverse(T_a_b: Tensor) -> Tensor:
    """T_b_a of a rigid transform, exact and cheaper than a matrix inverse. (..., 4, 4) -> (..., 4, 4)

    >>> T_world_ann = rigid(about_y(torch.tensor(1.0)), torch.tensor([2.0, 0.0, 3.0]))
    >>> torch.allclose(inverse(T_world_ann) @ T_world_ann, torch.eye(4), atol=1e-6)
    True
    """
    R_b_a = T_a_b[..., :3, :3].transpose(-1, -2)
    return rigid(R_b_a, -(R_b_a @ T_a_b[..., :3, 3:])[..., 0])


def rigid(R_a_b: Tensor, t_a_b: Tensor) -> Tensor:
    """T_a_b from a rotation and the origin of b in a. (..., 3, 3), (..., 3) -> (..., 4, 4)"""
    top = torch.cat([R_a_b, t_a_b[..., None]], dim=-1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 3] = 1.0
    return torch.cat([top, bottom], dim=-2)


def to_9d(T_a_b: Tensor) -> Tensor:
    """Rotation in 6-D, then translation in metres. (..., 4, 4) -> (..., 9)

    >>> to_9d(rigid(torch.eye(3), torch.tensor([0.5, 0.0, 2.0])))
    tensor([1.0000, 0.0000, 0.0000, 0.0000, 1.0000, 0.0000, 0.5000, 0.0000, 2.0000])
    """
    return torch.cat([to_6d(T_a_b[..., :3, :3]), T_a_b[..., :3, 3]], dim=-1)


def from_9d(nine: Tensor) -> Tensor:
    """The rigid transform nearest to nine numbers. (..., 9) -> (..., 4, 4)"""
    return rigid(from_6d(nine[..., :6]), nine[..., 6:])


def to_planar(T_a_b: Tensor) -> tuple[Tensor, Tensor]:
    """Yaw (...) in radians and ground position (..., 2) as (x, z) in metres; height and tilt are dropped.

    >>> yaw, ground = to_planar(rigid(about_y(torch.tensor(0.3)), torch.tensor([1.0, 0.9, 2.0])))
    >>> yaw, ground
    (tensor(0.3000), tensor([1., 2.]))
    """
    return yaw_of(T_a_b[..., :3, :3]), T_a_b[..., [0, 2], 3]


def from_planar(yaw: Tensor, ground: Tensor) -> Tensor:
    """Inverse of `to_planar`. (...), (..., 2) -> (..., 4, 4)"""
    return _on_ground(about_y(yaw), ground)


def _on_ground(rotation: Tensor, ground: Tensor) -> Tensor:
    """(..., 3, 3), (..., 2) -> (..., 4, 4)"""
    x, z = ground.unbind(-1)
    return rigid(rotation, torch.stack([x, torch.zeros_like(x), z], dim=-1))


# -- from a scene to what tokens hold ----------------------------------------------------------


def canonical_frame(T_world_root: Tensor) -> Tensor:
    """Frame on the ground under the pelvis, facing where the pelvis faces. (..., 4, 4) -> same

    The yaw comes from the pelvis's left axis, which stays horizontal in bows and dips where a forward
    axis would flip. Of a person lying exactly on the side the forward axis, then horizontal, decides. Each frame
    is judged by itself, so that it does not matter which others are known.

    >>> T_world_root = rigid(about_y(torch.tensor(0.3)), torch.tensor([1.0, 0.9, 2.0]))  # a pelvis 0.9 m up
    >>> canonical_frame(T_world_root)[:3, 3]
    tensor([1., 0., 2.])
    """
    left, forward = T_world_root[..., :3, 0], T_world_root[..., :3, 2]
    upright = left[..., [0, 2]].norm(dim=-1) >= UPRIGHT
    sine = torch.where(upright, -left[..., 2], forward[..., 0])
    cosine = torch.where(upright, left[..., 0], forward[..., 2])
    # No angle is taken: sines, unlike roots, may be rounded otherwise in another place of a batch.
    length = (sine * sine + cosine * cosine).sqrt().clamp_min(1e-12)
    return _on_ground(about_y_of(sine / length, cosine / length), T_world_root[..., [0, 2], 3])


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
    everyone = torch.arange(agents, device=device).expand(agents, agents)
    return everyone[~torch.eye(agents, dtype=torch.bool, device=device)].view(agents, agents - 1)


def pairwise(T_world_can: Tensor) -> Tensor:
    """T_self_partner of every agent and partner slot. (..., P, 4, 4) -> (..., P, P - 1, 4, 4)

    >>> yaws, ground = torch.tensor([0.0, torch.pi]), torch.tensor([[0.0, 0.0], [0.0, 2.0]])
    >>> T_self_partner = pairwise(from_planar(yaws, ground))  # two people face each other, 2 m apart
    >>> T_self_partner[:, 0, 2, 3]  # so each has the other 2 m in front
    tensor([2., 2.])
    """
    T_world_partner = T_world_can[..., partners(T_world_can.shape[-3], T_world_can.device), :, :]
    return inverse(T_world_can)[..., None, :, :] @ T_world_partner


def propagate_pairwise(T_self_partner: Tensor, deltas: Tensor) -> Tensor:
    """Each frame's pairwise transform as the frame before and the deltas imply it (right side of paper Eq. 11).

    T_self_partner (..., T, P, P - 1, 4, 4), deltas (..., T, P, 4, 4) -> (..., T - 1, P, P - 1, 4, 4),
    to be compared with frames 1 to T - 1. On real motion the two are equal.
    """
    now = deltas[..., 1:, :, :, :]
    step_partner = now[..., partners(now.shape[-3], now.device), :, :]
    return inverse(now)[..., None, :, :] @ T_self_partner[..., :-1, :, :, :, :] @ step_partner


def pose_features(scene: Scene) -> Tensor:
    """What the tokenizer sees of a body: 21 joint rotations in 6-D and T_can_root in 9-D. -> (B, T, P, 135)"""
    T_can_root = inverse(canonical_frame(scene.T_world_root)) @ scene.T_world_root
    return torch.cat([to_6d(scene.body_rot).flatten(-2), to_9d(T_can_root)], dim=-1)


POSE_FEATURES = 21 * 6 + 9


def posed(features: Tensor, T_world_can: Tensor, like: Scene) -> Scene:
    """Inverse of `pose_features`: bodies put at canonical frames. (B, T, P, 135), (B, T, P, 4, 4)

    Shapes, presence, names and body come from `like`, of which nothing else is read.
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
    """The turn and move over the ground that best lay a path onto another: headings first, then positions.

    (..., T, 4, 4), (..., T, 4, 4) -> (..., 4, 4), such that shift @ path is about target.
    """
    (yaw, ground), (yaw_target, ground_target) = to_planar(path), to_planar(target)
    off = yaw_target - yaw
    turned = torch.atan2(off.sin().mean(dim=-1), off.cos().mean(dim=-1))
    return from_planar(turned, (ground_target - rotate_ground(turned[..., None], ground)).mean(dim=-2))


# -- from predicted tokens back into the world -------------------------------------------------


def project_se2(T: Tensor) -> Tensor:
    """Nearest transform that only turns about the vertical and moves on the ground. (..., 4, 4) -> same"""
    return from_planar(*to_planar(T))


def place(
    deltas: Tensor,
    T_self_partner: Tensor | None,
    T_world_start: Tensor,
    placement: Placement = "integrate",
    pairwise_weight: float = 0.003,
    present: Tensor | None = None,
    fixed: Tensor | None = None,
    anchor: Tensor | None = None,
) -> Tensor:
    """World canonical frames of a predicted stretch of motion.

    Args:
        deltas: (B, T, P, 4, 4), delta from the frame before; the first leads away from `T_world_start`.
        T_self_partner: (B, T, P, P - 1, 4, 4); `integrate` does not read it and takes None.
        T_world_start: (B, P, 4, 4) canonical frames at the last known frame.
        placement: `integrate`: every agent integrates its own deltas (the reference's way; agents may
            drift apart slowly). `anchor`: one agent integrates, the others hang off it by its pairwise
            transforms (no drift apart, but their own deltas are ignored). `fuse` (ours): at each frame
            the least-squares compromise of all deltas and all pairwise transforms, equal for all agents.
        pairwise_weight: `fuse` only: weight of one pairwise transform against one delta. 0 is `integrate`.
        present: (B, P) bool; pairs to absent agents are not read. None: all are there.
        fixed: (P,) bool, `fuse` only: agents whose deltas are known and must not be compromised. None: nobody.
        anchor: (B,) int, `anchor` only: the agent that each scene's others hang off. None: agent 0.

    Returns:
        T_world_can (B, T, P, 4, 4), in the dtype of `deltas`; computed in float64 so that thousands of
        frames add up exactly.
    """
    delta_yaw, delta_ground = to_planar(deltas.double())
    start_yaw, start_ground = to_planar(T_world_start.double())
    if placement == "fuse" and T_self_partner is not None and deltas.shape[2] > 1:
        if present is None:
            present = torch.ones(deltas.shape[0], deltas.shape[2], dtype=torch.bool, device=deltas.device)
        weight = torch.ones_like(start_yaw[0]) if fixed is None else torch.where(fixed.to(deltas.device), FIXED, 1.0)
        pairs = to_planar(T_self_partner.double())
        deltas_planar = (delta_yaw, delta_ground)
        return from_planar(
            *_fuse(*deltas_planar, *pairs, start_yaw, start_ground, pairwise_weight, present, weight)
        ).to(deltas)
    yaw = start_yaw[:, None] + delta_yaw.cumsum(dim=1)
    before = torch.cat([start_yaw[:, None], yaw[:, :-1]], dim=1)
    ground = start_ground[:, None] + rotate_ground(before, delta_ground).cumsum(dim=1)
    T_world_can = from_planar(yaw, ground)
    if placement == "anchor" and T_self_partner is not None:
        scene = torch.arange(len(deltas), device=deltas.device)
        anchor = torch.zeros_like(scene) if anchor is None else anchor.to(deltas.device)
        T_anchor_others = project_se2(T_self_partner[scene, :, anchor].double())
        T_world_others = T_world_can[scene, :, anchor][:, :, None] @ T_anchor_others  # (B, T, P - 1, 4, 4)
        others = partners(deltas.shape[2], deltas.device)[anchor]
        T_world_can[scene[:, None], :, others] = T_world_others.transpose(1, 2)
    return T_world_can.to(deltas)


def _fuse(
    delta_yaw: Tensor,
    delta_ground: Tensor,
    pair_yaw: Tensor,
    pair_ground: Tensor,
    yaw: Tensor,
    ground: Tensor,
    pairwise_weight: float,
    present: Tensor,
    own: Tensor,
) -> tuple[Tensor, Tensor]:
    """Frame by frame: minimise own * |pose - stepped pose|^2 + pairwise_weight * sum |pair - predicted pair|^2.

    Yaws first, then positions with those yaws: two linear systems with the same constant matrix,
    diag(own) + 2 pairwise_weight (graph Laplacian of the people present). own (P,) is each agent's weight.
    """
    partner = partners(present.shape[1], present.device)
    together = pairwise_weight * (present[:, :, None] & present[:, None]).to(delta_yaw)
    together.diagonal(dim1=1, dim2=2).zero_()
    system = torch.diag(own.to(delta_yaw)) + 2 * (torch.diag_embed(together.sum(-1)) - together)
    solve = torch.linalg.inv(system)
    weight = together.gather(2, partner.expand(len(present), -1, -1))  # (B, P, P - 1)

    def pull(residual: Tensor) -> Tensor:
        """Pair residuals (B, P, P - 1, C) as a pull on each agent: those that point at it, less its own."""
        weighted = weight[..., None] * residual
        return (-weighted.sum(dim=2)).index_add(1, partner.flatten(), weighted.flatten(1, 2))

    yaws, grounds = [], []
    for t in range(delta_yaw.shape[1]):
        ground = ground + rotate_ground(yaw, delta_ground[:, t])
        yaw = yaw + delta_yaw[:, t]
        off = pair_yaw[:, t] - (yaw[:, partner] - yaw[:, :, None])
        off = torch.atan2(off.sin(), off.cos())
        yaw = yaw + (solve @ pull(off[..., None]))[..., 0]
        away = rotate_ground(yaw[:, :, None], pair_ground[:, t]) - (ground[:, partner] - ground[:, :, None])
        ground = ground + solve @ pull(away)
        yaws.append(yaw)
        grounds.append(ground)
    return torch.stack(yaws, dim=1), torch.stack(grounds, dim=1)
