"""People whose feet are drawn over the floor, and how high their toes are."""

from __future__ import annotations

import torch
from torch import Tensor

from magnet.body import load_body
from magnet.body.fit import clearance
from magnet.body.joints import TOES
from magnet.motion.frames import rigid
from magnet.motion.scene import FPS, Scene

BODY = load_body()


def gliding(speed: float, frames: int = 24) -> Scene:
    """One person, upright with straight legs, who glides along z over the floor, m/s."""
    betas, eye = torch.zeros(1, 1, 10), torch.eye(3)
    place = torch.zeros(1, frames, 1, 3)
    place[..., 1] = float(clearance(BODY, betas[0])[0, 2] - BODY.rest_joints(betas[0, 0])[TOES[0], 1])
    place[..., 2] = (torch.arange(frames) * speed / FPS)[:, None]
    pose = eye.repeat(1, frames, 1, 21, 1, 1)
    return Scene(pose, rigid(eye.expand(1, frames, 1, 3, 3), place), betas, torch.ones(1, 1, dtype=torch.bool))


def rise(scene: Scene) -> Tensor:
    """How far toes of one person are over where they stand. -> (T, 2) metres"""
    joints = BODY.joints(scene.replace(body=BODY.id))
    return (joints[..., TOES, 1] - clearance(BODY, scene.betas[0])[0, 2:])[0, :, 0]
