"""How far a decoded pose is from the truth (paper Eq. 4 and 5)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional as F

from magnet.motion.frames import from_9d
from magnet.motion.rotations import from_6d, geodesic

FPS = 30.0
"""Frames a second of every training window."""

FEET = (7, 8, 10, 11)
"""Ankles and toes."""

BODY = 21 * 6
"""Where the 21 joint rotations of a pose end and T_can_root begins."""


def proper(pose: Tensor) -> Tensor:
    """The pose with true rotations in its 6-D numbers and the pelvis above its canonical frame. (..., 135) -> same"""
    rotations = torch.cat([pose[..., :BODY], pose[..., BODY : BODY + 6]], dim=-1).unflatten(-1, (22, 6))
    rotations = from_6d(rotations)[..., :2].transpose(-1, -2).flatten(-3)
    up = torch.tensor([0.0, 1.0, 0.0], dtype=pose.dtype, device=pose.device)
    return torch.cat([rotations, pose[..., BODY + 6 :] * up], dim=-1)


def matrices(pose: Tensor) -> tuple[Tensor, Tensor]:
    """Joint rotations (..., 21, 3, 3) and T_can_root (..., 4, 4) of a pose (..., 135)."""
    return from_6d(pose[..., :BODY].unflatten(-1, (21, 6))), from_9d(pose[..., BODY:])


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean over the entries (...) of a mask, of values (..., any): what is masked out may even be NaN."""
    values = values.flatten(mask.ndim).mean(-1) if values.ndim > mask.ndim else values
    return torch.where(mask, values, 0.0).sum() / mask.sum().clamp(min=1)


def reconstruction_losses(
    decoded: Tensor, truth: Tensor, mask: Tensor, joints: Callable[[Tensor], Tensor] | None = None
) -> dict[str, Tensor]:
    """The terms of paper Eq. 4, each a mean over people, frames and joints; and three of ours.

    A smooth-L1 of the angle is quadratic below 1 radian: gentle to the many small errors, not led by a few flips.

    Args:
        decoded: (B, T, P, 135), any scale of 6-D numbers.
        truth: the same of the recording.
        mask: (B, T, P) bool, the frames that count.
        joints: poses (..., 135) to joint positions (..., 22, 3) in the canonical frame; adds `joint`,
            `velocity` and `foot` (ours).

    Returns:
        body: angle of the 21 joints. root_rotation, root_translation: T_can_root (Eq. 5). joint: distance of the
        joints, metres. velocity: what that distance changes by from frame to frame, m/s; small errors that
        flicker cost nothing else, and are what an eye sees first. foot: the same of ankles and toes alone, whose
        flicker is seen as sliding.
    """
    truth = torch.where(mask[..., None], truth, decoded.detach())
    body, T_can_root = matrices(decoded)
    true_body, true_T_can_root = matrices(truth)
    angle = geodesic(body, true_body)
    turn = geodesic(T_can_root[..., :3, :3], true_T_can_root[..., :3, :3])
    both = mask[:, 1:] & mask[:, :-1]
    losses = {
        "body": masked_mean(_huber(angle), mask),
        "root_rotation": masked_mean(_huber(turn), mask),
        "root_translation": masked_mean(_huber(T_can_root[..., :3, 3] - true_T_can_root[..., :3, 3]), mask),
    }
    if joints is not None:
        away = joints(decoded) - joints(truth)
        losses["joint"] = masked_mean(_length(away), mask)
        slip = FPS * _length(away.diff(dim=1))
        losses["velocity"] = masked_mean(slip, both)
        losses["foot"] = masked_mean(slip[..., FEET], both)
    return losses


def _length(vector: Tensor) -> Tensor:
    """Length of a vector, with a slope at 0 that is finite. (..., 3) -> (...)"""
    return (vector.square().sum(-1) + 1e-8).sqrt()


def _huber(difference: Tensor) -> Tensor:
    return F.smooth_l1_loss(difference, torch.zeros_like(difference), reduction="none")
