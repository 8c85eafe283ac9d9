"""Motion at other times: another frame rate, or another speed. Rotations by slerp, places on straight lines."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from magnet.motion.frames import rigid
from magnet.motion.rotations import from_rotvec, quat_from_rotvec, quat_inverse, quat_product, quat_to_rotvec, to_rotvec
from magnet.motion.scene import FPS, Scene


def smoothstep(ramp: Tensor) -> Tensor:
    """0 to 1 with no speed at either end. ramp in 0..1"""
    return ramp * ramp * (3 - 2 * ramp)


def slerp(first: Tensor, second: Tensor, share: Tensor) -> Tensor:
    """Rotations between two, along the shorter arc.

    Args:
        first: (..., 3, 3)
        second: (..., 3, 3)
        share: how far on, from 0 to 1; broadcasts against (...).
    """
    turn = to_rotvec(first.transpose(-1, -2) @ second)
    return first @ from_rotvec(turn * share[..., None])


def slerp_quat(first: Tensor, second: Tensor, share: Tensor) -> Tensor:
    """`slerp` of unit quaternions (..., 4)."""
    turn = quat_to_rotvec(quat_product(quat_inverse(first), second))
    return quat_product(first, quat_from_rotvec(turn * share[..., None]))


def times(frames: int, fps: float, target: float = FPS) -> tuple[Tensor, Tensor, Tensor]:
    """The two frames that new frame i, at time i / target, lies between, and how far on: before, after, share."""
    count = math.floor((frames - 1) * target / fps + 1e-6) + 1
    place = torch.arange(count, dtype=torch.float64) * (fps / target)
    before = (place + 1e-6).floor().long().clamp_max(frames - 1)
    share = (place - before).clamp(0.0, 1.0)
    share[share < 1e-6] = 0.0  # exact frames stay exact, and need no valid neighbour
    return before, (before + 1).clamp_max(frames - 1), share


def resample_rotations(quat: Tensor, fps: float, target: float = FPS) -> Tensor:
    """Rotations at exact times, by slerp along the shorter arc. (T, ..., 4) unit quaternions -> (T', ..., 4)"""
    before, after, share = times(len(quat), fps, target)
    if not bool(share.any()):
        return quat[before]
    return slerp_quat(quat[before], quat[after], share.view(-1, *[1] * (quat.dim() - 2)))


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


def at_speed(scene: Scene, speed: float) -> Scene:
    """Play a scene at another speed, at the same frames a second; rotations between frames by slerp.

    Raises:
        ValueError: the speed is not positive.
    """
    if speed <= 0:
        raise ValueError(f"speed: got {speed}, expected a positive number such as 0.9 or 1.1")
    if speed == 1 or scene.frames < 2:
        return scene
    return resampled(scene.replace(fps=scene.fps * speed), scene.fps)


def resampled(scene: Scene, fps: float) -> Scene:
    """The same motion at exact times t = i / fps: slerp between rotations, straight lines between positions.

    A new frame is valid if all old frames that it is made of are, and given if all of these were given to a model.

    Raises:
        ValueError: the rate is not positive.

    >>> from magnet.motion.scene import empty_scene
    >>> resampled(empty_scene(1, 61, 2, like=torch.zeros(())), 15.0).frames
    31
    """
    if not 0 < fps < math.inf:
        raise ValueError(f"fps: got {fps:g}, expected more than 0")
    if abs(fps - scene.fps) < 1e-6 * fps:
        return scene
    if not scene.frames:
        return scene.replace(fps=float(fps))
    low, high, share = times(scene.frames, scene.fps, fps)
    low, high, share = low.to(scene.device), high.to(scene.device), share.to(scene.T_world_root)
    place = scene.T_world_root[..., :3, 3]
    exact = share == 0
    high = torch.where(exact, low, high)  # of a frame that is taken as it is the next one may not even be finite
    moved = torch.lerp(place[:, low], place[:, high], share[:, None, None])
    turned = _slerp_frames(scene.T_world_root[..., :3, :3], low, high, share)
    valid = None if scene.valid is None else scene.valid[:, low] & scene.valid[:, high]
    given = None if scene.given is None else scene.given[:, low] & scene.given[:, high]
    body_rot = _slerp_frames(scene.body_rot, low, high, share)
    return scene.replace(body_rot=body_rot, T_world_root=rigid(turned, moved), valid=valid, given=given, fps=float(fps))


def _slerp_frames(rotation: Tensor, low: Tensor, high: Tensor, share: Tensor) -> Tensor:
    """(B, T, ..., 3, 3) at fractional frames -> (B, frames, ..., 3, 3)"""
    start = rotation[:, low]
    between = share > 0
    if not bool(between.any()):
        return start
    first = start[:, between]
    part = share[between].reshape(1, -1, *[1] * (first.dim() - 4))
    start[:, between] = slerp(first, rotation[:, high[between]], part)
    return start
