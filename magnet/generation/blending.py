"""Blending of given and generated motion: paths that end at a keyframe, and poses without jumps at seams."""

from __future__ import annotations

import roma
import torch
from torch import Tensor

from magnet.motion.frames import canonical_frame, from_planar, inverse, rigid, to_planar
from magnet.motion.planar import rotate_ground
from magnet.motion.resample import smoothstep
from magnet.motion.scene import Scene, cat_time

SPRING = 2.5
"""Rate of `spring_from_given`, divided by the frames `blend` of a seam. Lower is smoother, but feet that the decoder
put elsewhere slide for longer. With `blend` 10 a difference is halved in 7 frames."""


def delta_between(T_world_can: Tensor, key_delta: Tensor) -> Tensor:
    """The delta into a known frame, which is not predicted: the mean of the last delta before and the first after.

    T_world_can (B, F, 4, 4) up to the frame before, key_delta (B, 4, 4) -> (B, 4, 4)
    """
    yaw, ground = to_planar(inverse(T_world_can[:, -2]) @ T_world_can[:, -1])
    key_yaw, key_ground = to_planar(key_delta)
    return from_planar((yaw + key_yaw) / 2, (ground + key_ground) / 2)


def warp_to_keyframe(T_world_can: Tensor, T_world_key: Tensor, key_delta: Tensor) -> Tensor:
    """Bend a path so that it leads to a known frame: headings first, then positions, with deltas of the same length.

    Args:
        T_world_can: (B, F, 4, 4) canonical frames up to the one before the known one; the first stays.
        T_world_key: (B, 4, 4) the known frame.
        key_delta: (B, 4, 4) the delta from there.

    Returns:
        (B, F, 4, 4). What is added grows as a smoothstep, so that it adds no speed at either end.
    """
    path, T_world_key = T_world_can.double(), T_world_key.double()
    yaw, ground = to_planar(path)
    _, delta = to_planar(inverse(path[:, :-1]) @ path[:, 1:])
    last_yaw, last_step = to_planar(delta_between(path, key_delta.double()))
    key_yaw, key_ground = to_planar(T_world_key)
    frames = path.shape[1]
    ramp = smoothstep(torch.arange(frames, device=path.device, dtype=path.dtype) / frames)
    off = key_yaw - yaw[:, -1] - last_yaw
    yaw = yaw + ramp * torch.atan2(off.sin(), off.cos())[:, None]
    ground = torch.cat([ground[:, :1], ground[:, :1] + rotate_ground(yaw[:, :-1], delta).cumsum(dim=1)], dim=1)
    away = key_ground - ground[:, -1] - rotate_ground(yaw[:, -1], last_step)
    return from_planar(yaw, ground + ramp[:, None] * away[:, None]).to(T_world_can)


def last_known(keep: Tensor) -> Tensor:
    """For every frame the latest known frame at or before it; 0 where there is none. (T, P) bool -> (T, P) int"""
    frame = torch.arange(keep.shape[0], device=keep.device)[:, None]
    return torch.where(keep, frame, 0).cummax(dim=0).values


def next_known(keep: Tensor) -> Tensor:
    """For every frame the first known frame at or after it; T - 1 where there is none. (T, P) bool -> (T, P) int"""
    return keep.shape[0] - 1 - last_known(keep.flip(0)).flip(0)


def seam_weights(keep: Tensor, blend: int) -> Tensor:
    """Weight of the difference at a seam, in the frames after it: 1 at the last known frame, 0 after `blend` frames.

    In a shorter gap it is 0 at the next known frame. (T, P) bool -> (T, P)
    """
    frame = torch.arange(keep.shape[0], device=keep.device)[:, None]
    after = keep.int().cummax(dim=0).values.bool()
    closed = keep.flip(0).int().cummax(dim=0).values.bool().flip(0)
    gap = torch.where(closed, next_known(keep) - last_known(keep), blend)
    since = (frame - last_known(keep)).float() / gap.clamp(1, max(blend, 1))
    return torch.where(after, smoothstep((1 - since).clamp(0, 1)), 0.0)


def fade_rotation(rotation: Tensor, given: Tensor, decoded: Tensor, weight: Tensor) -> Tensor:
    """Apply the rotation from `decoded` to `given`, scaled by a weight. (..., 3, 3), weight (...)"""
    difference = roma.rotmat_to_rotvec(given @ decoded.transpose(-1, -2))
    return roma.rotvec_to_rotmat(difference * weight[..., None]) @ rotation


def crossfade_given(decoded: Scene, given: Scene, T_world_can: Tensor, keep: Tensor, blend: int) -> Scene:
    """Restore given frames; the difference at each seam fades out over the generated frames beside it.

    Args:
        decoded: (B, T, P) the lossy reconstruction.
        given: (B, T, P) what is known.
        T_world_can: (B, T, P, 4, 4) where everybody stands.
        keep: (T, P) bool, known frames.
        blend: frames over which a seam fades out.
    """
    body_rot, T_world_root = decoded.body_rot, decoded.T_world_root
    decoded_can_root = inverse(T_world_can) @ T_world_root
    given_can_root = inverse(canonical_frame(given.T_world_root)) @ given.T_world_root
    tilt, lift = decoded_can_root[..., :3, :3], decoded_can_root[..., :3, 3]
    agents = torch.arange(keep.shape[1], device=keep.device)
    behind = (last_known(keep), seam_weights(keep, blend))
    ahead = (next_known(keep), seam_weights(keep.flip(0), blend).flip(0))
    for seam, fade in (behind, ahead):  # (T, P) each
        given_at, decoded_at = given_can_root[:, seam, agents], decoded_can_root[:, seam, agents]
        body_given, body_decoded = given.body_rot[:, seam, agents], decoded.body_rot[:, seam, agents]
        body_rot = fade_rotation(body_rot, body_given, body_decoded, fade[..., None])
        tilt = fade_rotation(tilt, given_at[..., :3, :3], decoded_at[..., :3, :3], fade)
        lift = lift + fade[..., None] * (given_at - decoded_at)[..., :3, 3]
    there = decoded.present[:, None, :, None, None]
    T_world_root = torch.where(there, T_world_can @ rigid(tilt, lift), T_world_root)
    blended = decoded.replace(body_rot=body_rot, T_world_root=T_world_root)
    return blended.with_poses(keep, given.body_rot, given.T_world_root)


def spring_weights(keep: Tensor, blend: int) -> tuple[Tensor, Tensor]:
    """Weights of a seam's difference, and of its change by frame, in the frames after it.

    A critically damped spring with the position and velocity of the difference: (1 + r t) exp(-r t) and t exp(-r t)
    with r = `SPRING` / blend. The velocity is known where the last two known frames are consecutive.
    (T, P) bool -> (T, P) twice
    """
    frame = torch.arange(keep.shape[0], device=keep.device)[:, None]
    after = keep.int().cummax(dim=0).values.bool()
    last = last_known(keep)
    grows = after & (last > 0) & keep.gather(0, (last - 1).clamp_min(0))
    since = (frame - last).float()
    rate = SPRING / blend if blend else torch.inf
    left = torch.where(since > 0, torch.exp(-rate * since.clamp_min(1)), 1.0)
    stays = torch.where(since > 0, (1 + min(rate, 1e9) * since) * left, 1.0)
    return torch.where(after, stays, 0.0), torch.where(grows, since * left, 0.0)


def spring_from_given(decoded: Scene, given: Scene, T_world_can: Tensor, keep: Tensor, blend: int) -> Scene:
    """Restore given frames and continue from them with their velocity; frames before a seam do not change.

    `crossfade_given` keeps no velocity, which would show at the seams of a causal plan: each block has one.

    Args:
        decoded: (B, T, P) bodies.
        given: (B, T, P) what is known or has been shown.
        T_world_can: (B, T, P, 4, 4) where everybody stands.
        keep: (T, P) bool, known frames.
        blend: frames over which a seam fades out.
    """
    T_can_world = inverse(T_world_can)
    decoded_can_root, given_can_root = T_can_world @ decoded.T_world_root, T_can_world @ given.T_world_root
    lift = decoded_can_root[..., :3, 3]
    # Pelvis and other joints together: so few turns cost as much as their operators are many.
    turns, goals = (
        torch.cat([root[..., None, :3, :3], scene.body_rot], dim=3)
        for root, scene in ((decoded_can_root, decoded), (given_can_root, given))
    )
    bends = roma.rotmat_to_rotvec(goals @ turns.transpose(-1, -2))
    moves = given_can_root[..., :3, 3] - lift
    last, agents = last_known(keep), torch.arange(keep.shape[1], device=keep.device)
    before, (stays, grows) = (last - 1).clamp_min(0), spring_weights(keep, blend)

    def left(difference: Tensor) -> Tensor:
        """The remainder of a difference (B, T, P, ...) at the last known frame."""
        at = difference[:, last, agents]
        shape = (*keep.shape, *[1] * (difference.dim() - 3))
        return stays.view(shape) * at + grows.view(shape) * (at - difference[:, before, agents])

    turned = roma.rotvec_to_rotmat(left(bends)) @ turns
    body_rot, can_root = turned[..., 1:, :, :], rigid(turned[..., 0, :, :], lift + left(moves))
    there = decoded.present[:, None, :, None, None]
    T_world_root = torch.where(there, T_world_can @ can_root, decoded.T_world_root)
    blended = decoded.replace(body_rot=body_rot, T_world_root=T_world_root)
    return blended.with_poses(keep, given.body_rot, given.T_world_root)


def freeze_after(scene: Scene, there: Tensor, before: Scene | None = None) -> Scene:
    """Agents stand still after the last frame in which they are given or generated.

    there (T, P) bool; `before` is the frame before the scene's first, if there is one.
    """
    if bool(there.all()):
        return scene
    if before is not None:
        whole = cat_time([before, scene])
        return freeze_after(whole, torch.cat([torch.ones_like(there[:1]), there])).slice(1)
    last, agents = last_known(there), torch.arange(there.shape[1], device=there.device)
    return scene.replace(body_rot=scene.body_rot[:, last, agents], T_world_root=scene.T_world_root[:, last, agents])


def smoothed_path(T_world_can: Tensor, placed: Tensor, fixed: Tensor) -> Tensor:
    """Canonical frames whose places are averaged with those of the frames before and after, 1 : 2 : 1.

    Networks that tell only what noise hides tremble by about a millimetre a frame in where people stand, which makes
    the pelvis jerk thrice as much as it should; averaged it does so no more (docs/training.md). The first and the last
    frame stay.

    Args:
        T_world_can: (B, T, P, 4, 4).
        placed: (T, P) bool, who has a place in which frame.
        fixed: (T, P) bool, who must not be moved.
    """
    place = T_world_can[..., :3, 3]
    mean = (place[:, :-2] + 2 * place[:, 1:-1] + place[:, 2:]) / 4
    free = (placed[:-2] & placed[1:-1] & placed[2:] & ~fixed[1:-1])[..., None]
    smooth = T_world_can.clone()
    smooth[:, 1:-1, :, :3, 3] = torch.where(free, mean, place[:, 1:-1])
    return smooth
