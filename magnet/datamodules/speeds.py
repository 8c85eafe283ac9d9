"""The same motion, a little faster or slower."""

from __future__ import annotations

import roma
import torch

from magnet.motion.frames import rigid
from magnet.motion.scene import Scene


def at_speed(scene: Scene, speed: float) -> Scene:
    """Play a scene at another speed, at the same frames a second; rotations between frames by slerp.

    Raises:
        ValueError: the speed is not positive.
    """
    if speed <= 0:
        raise ValueError(f"speed: got {speed}, expected a positive number such as 0.9 or 1.1")
    if speed == 1 or scene.frames < 2:
        return scene
    frames = int((scene.frames - 1) / speed) + 1
    time = (torch.arange(frames, dtype=torch.float64, device=scene.device) * speed).clamp(max=scene.frames - 1)
    before = time.long().clamp(max=scene.frames - 2)
    share = (time - before).to(scene.T_world_root.dtype)
    rotations = torch.cat([scene.T_world_root[..., None, :3, :3], scene.body_rot], dim=-3)  # (B, T, P, 22, 3, 3)
    first, second = rotations[:, before], rotations[:, before + 1]
    turn = roma.rotmat_to_rotvec(first.transpose(-1, -2) @ second)
    turned = first @ roma.rotvec_to_rotmat(share[:, None, None, None] * turn)
    ground = scene.T_world_root[..., :3, 3]
    position = torch.lerp(ground[:, before], ground[:, before + 1], share[:, None, None])
    valid = None if scene.valid is None else scene.valid[:, before] & scene.valid[:, before + 1]
    return scene.replace(
        body_rot=turned[..., 1:, :, :], T_world_root=rigid(turned[..., 0, :, :], position), valid=valid
    )
