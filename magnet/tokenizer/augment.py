"""Augmentation of poses for training a tokenizer (ours)."""

from __future__ import annotations

import torch
from torch import Tensor

from magnet.motion.rotations import from_rotvec
from magnet.motion.scene import FPS, Scene

LIMBS = {
    "left leg": (1, 4, 7, 10),
    "right leg": (2, 5, 8, 11),
    "trunk": (3, 6, 9),
    "head": (12, 15),
    "left arm": (13, 16, 18, 20),
    "right arm": (14, 17, 19, 21),
}
"""Joints of SMPL-X that move together; an arm begins at the collar."""

DRIFT_FRAMES = 6.0
"""Over how many frames a drift keeps its direction; what sampled feet slid by was nearly straight over ten."""


def swap_limbs(scene: Scene, probability: float, generator: torch.Generator) -> Scene:
    """Replace limbs, each with a probability, by the same limb of another person in the batch.

    A few minutes of dance hold few combinations of upper and lower bodies; the tokenizer should not memorize them.
    Limbs come only from people whose frames are valid wherever one's own are.
    """
    B, P = scene.present.shape
    people = scene.present.flatten().nonzero()[:, 0]
    if len(people) < 2:
        return scene
    flat = scene.body_rot.transpose(1, 2).flatten(0, 1)  # (B P, T, 21, 3, 3)
    mixed = flat.clone()
    for limb in LIMBS.values():
        joints = torch.tensor(limb, device=flat.device) - 1
        chosen = people[_rand(len(people), generator, flat) < probability]
        donors = people[(_rand(len(chosen), generator, flat) * len(people)).long()]
        if scene.valid is not None:
            good = scene.valid.repeat_interleave(P, dim=0)  # (B P, T)
            covers = (good[donors] | ~good[chosen]).all(dim=1)
            chosen, donors = chosen[covers], donors[covers]
        mixed[chosen[:, None], :, joints] = flat[donors[:, None], :, joints]
    return scene.replace(body_rot=mixed.unflatten(0, (B, P)).transpose(1, 2))


def joint_noise(scene: Scene, angle: float, generator: torch.Generator) -> Scene:
    """Turn each joint of each person by a random rotation of its own, the same in all frames.

    Args:
        angle: standard deviation in radians about each axis; the pelvis turns by a third of it.
    """
    B, P = scene.present.shape
    draws = torch.randn(B, 1, P, 22, 3, generator=generator, device=generator.device).to(scene.body_rot)
    turns = from_rotvec(angle * draws)
    tilt = torch.eye(4, dtype=turns.dtype, device=turns.device).repeat(B, 1, P, 1, 1)
    tilt[..., :3, :3] = from_rotvec(angle / 3 * draws[..., 0, :])
    present = scene.present[:, None, :, None, None]
    return scene.replace(
        body_rot=torch.where(present[..., None], scene.body_rot @ turns[..., 1:, :, :], scene.body_rot),
        T_world_root=torch.where(present, scene.T_world_root @ tilt, scene.T_world_root),
    )


def root_noise(deltas: Tensor, speed: float, generator: torch.Generator) -> Tensor:
    """Add a slow error over the ground to deltas, one for each person, as sampled deltas have it.

    Args:
        deltas: (B, T, P, 9) canonical deltas.
        speed: each person's standard deviation in m/s along either axis is drawn from 0 to this.
        generator: source of all randomness.
    """
    B, T, P, _ = deltas.shape
    draws = torch.randn(B, T, P, 2, generator=generator, device=generator.device).to(deltas)
    most = torch.rand(B, 1, P, 1, generator=generator, device=generator.device).to(deltas)
    time = torch.arange(T, device=deltas.device, dtype=deltas.dtype)
    near = torch.exp(-0.5 * ((time[:, None] - time) / DRIFT_FRAMES).square())
    smooth = torch.einsum("st,btpg->bspg", near / near.norm(dim=1, keepdim=True), draws)
    noisy = deltas.clone()
    noisy[..., [6, 8]] += speed / FPS * most * smooth
    return noisy


def _rand(n: int, generator: torch.Generator, like: Tensor) -> Tensor:
    return torch.rand(n, generator=generator, device=generator.device).to(like.device)
