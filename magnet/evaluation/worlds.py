"""The slots that a scene's people are in, and the world that all test scenes share."""

from __future__ import annotations

import torch
from torch import Tensor

from magnet.motion.frames import canonical_frame, from_planar, inverse, to_planar
from magnet.motion.scene import Scene


def in_slots(scene: Scene, slots: int) -> Scene:
    """The same people in so many slots: free ones are added behind, or left out."""
    if slots < scene.agents:
        return scene.permute_agents(torch.arange(slots, device=scene.device))
    return scene.pad_agents(slots)


def aligned(scene: Scene, frame: int) -> Scene:
    """The same motion in a world that all test scenes share: see `shared_world`."""
    return scene.transformed(shared_world(scene, frame))


def shared_world(scene: Scene, frame: int) -> Tensor:
    """T_shared_world, with the origin between the people and facing as agent 0 does. -> (B, 1, 1, 4, 4)

    Both are taken at one frame, the last recorded one, so that positions of different scenes can be compared.
    """
    yaw, ground = to_planar(canonical_frame(scene.T_world_root)[:, frame])  # (B, P), (B, P, 2)
    there = scene.present[..., None].to(ground)
    middle = (ground * there).sum(dim=1) / there.sum(dim=1).clamp_min(1)
    first = scene.present.int().argmax(dim=1)
    facing = yaw.gather(1, first[:, None])[:, 0]
    return inverse(from_planar(facing, middle))[:, None, None]
