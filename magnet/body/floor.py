"""How high people stand over y = 0, where models take the floor to be."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from magnet.body.base import Body, load_body
from magnet.body.fit import clearance
from magnet.body.joints import FEET
from magnet.motion.scene import BODY_JOINTS, Scene

SKIN = 0.03
"""Metres between a joint that is none of the feet's and the floor that somebody lies or leans on."""
LOW = 0.05
"""Share of the frames that may be lower than where somebody is said to stand: jumps count little, glitches nothing."""
OFF = 0.25
"""Metres over or under the floor that nobody is. Over all CMU takes kept with this project people whose floor is right
are said to stand up to 0.15 m off in half a second, somebody who dips a foot into it included."""
JUMP, JUMPED = 16, 0.9
"""In fewer frames than this somebody may be in the air throughout, lower than so many metres; CMU's reach 0.78."""
MOMENTS = 32
"""Frames that are looked at, evenly spaced."""


def lowest(scene: Scene, body: Body | None = None) -> Tensor:
    """Height over y = 0 of each person's lowest point: soles, or whatever is lower. -> (B, T, P) metres

    body: whose shapes the scene has; None: the open body, of average shape where the scene has another's.
    """
    body = open_body() if body is None else body
    betas = scene.betas.float() if scene.body == body.id else torch.zeros_like(scene.betas, dtype=torch.float32)
    betas = betas.to(body.J_template.device)
    joints = body.forward_kinematics(scene.body_rot.to(betas), scene.T_world_root.to(betas), betas[:, None])
    above = torch.full((*betas.shape[:2], BODY_JOINTS), SKIN, device=betas.device)
    above[..., list(FEET)] = clearance(body, betas.flatten(0, 1)).unflatten(0, betas.shape[:2])
    return (joints[..., 1] - above[:, None]).amin(dim=-1).to(scene.device)


def standing(lowest: Tensor, counts: Tensor) -> Tensor:
    """Height over y = 0 that each person stands, sits or lies at, taken from the lowest frames.

    lowest (B, T, P), counts (B, T, P) bool, frames that are looked at -> (B, P) metres, NaN where there are none
    """
    return torch.where(counts, lowest, torch.nan).nanquantile(LOW, dim=1)


def off_floor(lowest: Tensor, counts: Tensor, frames: Tensor | None = None) -> Tensor:
    """How far over y = 0 everybody stands, in scenes whose floor cannot be there; 0 in the others.

    One person near the floor, or possibly jumping, is enough for a scene to count as standing on it.

    Args:
        lowest: (B, F, P) metres.
        counts: (B, F, P) bool, frames that are looked at.
        frames: (B, P) how many there are of each person, where `counts` has but some of them; None: all.

    Returns:
        (B,) metres, negative where they stand under it.
    """
    if not lowest.numel():
        return lowest.new_zeros(len(lowest))
    heights = standing(lowest, counts)
    most = torch.where((counts.sum(dim=1) if frames is None else frames) < JUMP, JUMPED, OFF)
    there = heights.isfinite()
    over = ((heights > most) | ~there).all(dim=1) & there.any(dim=1)
    under = ((heights < -OFF) | ~there).all(dim=1) & there.any(dim=1)
    nearest = torch.where(there, heights.abs(), torch.inf).argmin(dim=1, keepdim=True)
    return torch.where(over | under, heights.gather(1, nearest)[:, 0], 0.0)


def on_floor(scene: Scene, body: Body | None = None) -> Scene:
    """The same motion with whoever stands lowest on y = 0, in each of the B scenes by itself.

    body: as for `lowest`.
    """
    if not scene.present.any() or not scene.frames:
        return scene
    counts = scene.present[:, None].expand(scene.T_world_root.shape[:3])
    heights = standing(lowest(scene, body), counts).nan_to_num(nan=torch.inf).amin(dim=1)  # (B,)
    T_new_world = torch.eye(4, dtype=scene.T_world_root.dtype, device=scene.device).repeat(scene.scenes, 1, 1, 1, 1)
    T_new_world[:, 0, 0, 1, 3] = -torch.where(heights.isfinite(), heights, 0.0).to(T_new_world)
    return scene.transformed(T_new_world)


def level(scene: Scene, body: Body | None = None) -> float:
    """Metres over y = 0 at which everybody stands in the scene that is farthest from it; 0 where somebody is near.

    body: as for `lowest`.
    """
    if not scene.present.any() or not scene.frames:
        return 0.0
    away = off_floor(lowest(scene, body), scene.present[:, None].expand(scene.T_world_root.shape[:3]))
    return float(away[away.abs().argmax()])


@functools.cache
def open_body() -> Body:
    with torch.inference_mode(False):
        return load_body("open")
