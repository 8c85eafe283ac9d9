"""Reconstruction losses of the tokenizer (paper Eq. 4 and 5)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional as F

from magnet.body.energy import hand_points
from magnet.body.joints import FEET, TOES
from magnet.motion.frames import from_9d
from magnet.motion.rotations import from_6d, geodesic
from magnet.motion.scene import FPS
from magnet.waiting import constant

STANDS = (0.05, 0.2)
"""Height in metres and speed in m/s under which a recorded toe stands."""

JOINT_LOSSES = ("joint", "hand", "velocity", "foot_velocity", "foot_contact")
"""Terms that need joints, and so a body."""

BODY = 21 * 6
"""Where the 21 joint rotations of a pose end and T_can_root begins."""


def orthonormalize(pose: Tensor) -> Tensor:
    """Orthonormalize a pose's 6-D rotations and put the pelvis above its canonical frame. (..., 135) -> same"""
    rotations = torch.cat([pose[..., :BODY], pose[..., BODY : BODY + 6]], dim=-1).unflatten(-1, (22, 6))
    rotations = from_6d(rotations)[..., :2].transpose(-1, -2).flatten(-3)
    up = constant((0.0, 1.0, 0.0), pose)
    return torch.cat([rotations, pose[..., BODY + 6 :] * up], dim=-1)


def matrices(pose: Tensor) -> tuple[Tensor, Tensor]:
    """Joint rotations (..., 21, 3, 3) and T_can_root (..., 4, 4) of a pose (..., 135)."""
    return from_6d(pose[..., :BODY].unflatten(-1, (21, 6))), from_9d(pose[..., BODY:])


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean over what counts, whatever the rest holds, even NaN; 0 where nothing counts.

    values (..., any), mask (...) bool; a mask with as many axes as the values broadcasts to them.
    """
    values = values.flatten(mask.ndim).mean(-1) if values.ndim > mask.ndim else values
    mask = mask.expand_as(values)
    return torch.where(mask, values, 0.0).sum() / mask.sum().clamp(min=1)


def reconstruction_losses(
    decoded: Tensor,
    truth: Tensor,
    mask: Tensor,
    joints: Callable[[Tensor], Tensor] | None = None,
    deltas: Tensor | None = None,
    true_deltas: Tensor | None = None,
) -> dict[str, Tensor]:
    """The terms of paper Eq. 4, each a mean over people, frames and joints; and five of ours.

    A smooth L1 of the angle is quadratic below 1 radian and linear above, so that a few flips do not dominate it.

    Args:
        decoded: (B, T, P, 135), any scale of 6-D numbers.
        truth: the same of the recording.
        mask: (B, T, P) bool, the frames that count.
        joints: poses (..., 135) to joint positions (..., 22, 3) in the canonical frame; adds `joint`, `hand`,
            `velocity` and `foot_velocity` (ours).
        deltas: (B, T, P, 9) canonical deltas that the decoder was given; adds `foot_contact` (ours).
        true_deltas: the same of the recording.

    Returns:
        joint_rotation: angle of the 21 joints. root_rotation, root_translation: T_can_root (Eq. 5). joint: distance of
        the joints, metres. hand: distance of the middles of the hands, metres; who holds hands needs them more exact
        than a mean over all joints asks for. velocity: error of the joints' velocities, m/s; small errors that flicker
        cost little elsewhere, and are the first that one sees. foot_velocity: the same of ankles and toes alone, where
        flicker looks like sliding. foot_contact: error of the velocities over the ground, m/s, of toes that stand in
        the recording, with roots moved by the given deltas.
    """
    truth = torch.where(mask[..., None], truth, decoded.detach())
    body, T_can_root = matrices(decoded)
    true_body, true_T_can_root = matrices(truth)
    angle = geodesic(body, true_body)
    turn = geodesic(T_can_root[..., :3, :3], true_T_can_root[..., :3, :3])
    both = mask[:, 1:] & mask[:, :-1]
    losses = {
        "joint_rotation": masked_mean(_huber(angle), mask),
        "root_rotation": masked_mean(_huber(turn), mask),
        "root_translation": masked_mean(_huber(T_can_root[..., :3, 3] - true_T_can_root[..., :3, 3]), mask),
    }
    if joints is not None:
        mine, real = joints(decoded), joints(truth)
        away = mine - real
        losses["joint"] = masked_mean(length(away), mask)
        losses["hand"] = masked_mean(length(hand_points(mine) - hand_points(real)), mask)
        slip = FPS * length(away.diff(dim=1))
        losses["velocity"] = masked_mean(slip, both)
        losses["foot_velocity"] = masked_mean(slip[..., FEET], both)
        if deltas is not None and true_deltas is not None:
            slide = (world_velocity(mine, deltas) - world_velocity(real, true_deltas))[..., TOES, :]
            losses["foot_contact"] = masked_mean(FPS * length(slide), both[..., None] & standing(real, true_deltas))
    return losses


def length(vector: Tensor) -> Tensor:
    """Norm of a vector, with a finite gradient at 0. (..., 3) -> (...)"""
    return (vector.square().sum(-1) + 1e-8).sqrt()


def _huber(difference: Tensor) -> Tensor:
    return F.smooth_l1_loss(difference, torch.zeros_like(difference), reduction="none")


def moved(nine: Tensor, points: Tensor) -> Tensor:
    """Points (..., 22, 3) moved by transforms (..., 9)."""
    T = from_9d(nine)
    return points @ T[..., :3, :3].transpose(-1, -2) + T[..., None, :3, 3]


def world_velocity(joints: Tensor, deltas: Tensor) -> Tensor:
    """Displacement of joints in the world from frame to frame, seen from the canonical frame before.

    (B, T, P, 22, 3) in canonical frames, (B, T, P, 9) -> (B, T - 1, P, 22, 3) metres
    """
    return moved(deltas[:, 1:], joints[:, 1:]) - joints[:, :-1]


def standing(joints: Tensor, deltas: Tensor) -> Tensor:
    """Which toes stand from one frame to the next: low and slow ones. Arguments as above -> (B, T - 1, P, 2) bool"""
    height, speed = STANDS
    low = joints[..., TOES, 1] < height
    slow = FPS * world_velocity(joints, deltas)[..., TOES, :].norm(dim=-1) < speed
    return low[:, 1:] & low[:, :-1] & slow
