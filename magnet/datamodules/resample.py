"""Recordings at 30 frames a second, at exact times."""

from __future__ import annotations

import math

import numpy as np
import roma
import torch
from numpy.typing import NDArray
from torch import Tensor

FPS = 30.0


def times(frames: int, fps: float, target: float = FPS) -> tuple[Tensor, Tensor, Tensor]:
    """Which two frames each new frame i at time i / target lies between, and how far on: before, after, share."""
    count = math.floor((frames - 1) * target / fps + 1e-9) + 1
    place = torch.arange(count, dtype=torch.float64) * (fps / target)
    before = (place + 1e-9).floor().long().clamp_max(frames - 1)
    share = (place - before).clamp(0.0, 1.0)
    share[share < 1e-9] = 0.0  # exact frames stay exact, and need no valid neighbour
    return before, (before + 1).clamp_max(frames - 1), share


def resample_rotations(quat: Tensor, fps: float, target: float = FPS) -> Tensor:
    """Rotations at exact times, by slerp along the shorter arc. (T, ..., 4) unit quaternions -> (T', ..., 4)"""
    before, after, share = times(len(quat), fps, target)
    if not bool(share.any()):
        return quat[before]
    start = quat[before]
    turn = roma.unitquat_to_rotvec(roma.quat_product(roma.quat_conjugation(start), quat[after]))
    share = share.view(-1, *[1] * (quat.dim() - 1))
    return roma.quat_product(start, roma.rotvec_to_unitquat(turn * share))


def resample_points(points: Tensor, fps: float, target: float = FPS) -> Tensor:
    """Points at exact times, linearly. (T, ..., 3) -> (T', ..., 3)

    >>> height = torch.arange(5.0, dtype=torch.float64)[:, None].expand(5, 3)  # one metre more each frame, at 60 fps
    >>> resample_points(height, fps=60.0)[:, 0]
    tensor([0., 2., 4.], dtype=torch.float64)
    """
    before, after, share = times(len(points), fps, target)
    return torch.lerp(points[before], points[after], share.view(-1, *[1] * (points.dim() - 1)))


def resample_valid(valid: NDArray[np.bool_], fps: float, target: float = FPS) -> NDArray[np.bool_]:
    """A new frame is valid when all frames that it is made of are. (T, P) -> (T', P)"""
    before, after, share = times(len(valid), fps, target)
    return valid[before.numpy()] & (valid[after.numpy()] | (share.numpy() == 0)[:, None])
