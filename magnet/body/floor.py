"""Height of people over y = 0, which models take for the floor."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import torch
from torch import Tensor

from magnet.body.base import Body, load_body
from magnet.body.fit import clearance
from magnet.body.joints import FEET
from magnet.motion.scene import BODY_JOINTS, Scene
from magnet.precision import cpu_by_default

SKIN = 0.03
"""Metres between the floor that somebody lies on and a joint that is not of the feet."""
STANDING_QUANTILE = 0.05
"""The standing height is this quantile over frames: jumps count little, glitches not at all."""
OFF = 0.25
"""Metres off the floor at which it cannot be right. In CMU's takes with a right floor, half a second of motion gives up
to 0.15 m, also where somebody dips a foot into it."""
JUMP, JUMPED = 16, 0.9
"""In fewer frames somebody may be in the air all the time, up to so many metres; in CMU up to 0.78."""
OTHER_FLOOR = 0.05
"""Metres off the floor of the others at which somebody is told of."""
MOMENTS = 32
"""Evenly spaced frames that are examined."""


def lowest(scene: Scene, body: Body | None = None) -> Tensor:
    """Height of each person's lowest point over y = 0: soles, or a lower joint. -> (B, T, P) metres

    body: the body of the scene's shapes; None: the open body, of average shape for shapes of another.
    """
    body = open_body() if body is None else body
    betas = scene.betas.float() if scene.body == body.id else torch.zeros_like(scene.betas, dtype=torch.float32)
    betas = betas.to(body.J_template.device)
    joints = body.forward_kinematics(scene.body_rot.to(betas), scene.T_world_root.to(betas), betas[:, None])
    above = torch.full((*betas.shape[:2], BODY_JOINTS), SKIN, dtype=betas.dtype, device=betas.device)
    above[..., list(FEET)] = clearance(body, betas.flatten(0, 1)).unflatten(0, betas.shape[:2])
    return (joints[..., 1] - above[:, None]).amin(dim=-1).to(scene.device)


def standing(lowest: Tensor, counts: Tensor) -> Tensor:
    """Height over y = 0 at which each person stands, sits or lies, from the lowest frames.

    lowest (B, T, P), counts (B, T, P) bool: frames to examine -> (B, P) metres, NaN without any
    """
    return torch.where(counts, lowest, torch.nan).nanquantile(STANDING_QUANTILE, dim=1)


def off_floor(lowest: Tensor, counts: Tensor, frames: Tensor | None = None) -> Tensor:
    """Height over y = 0 at which everybody stands, of scenes whose floor cannot be there; 0 for others.

    One person near the floor, or possibly jumping, is enough for a scene to stand on it.

    Args:
        lowest: (B, F, P) metres.
        counts: (B, F, P) bool, frames to examine.
        frames: (B, P) how many each person has, if `counts` holds only some; None: all.

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


def counting(scene: Scene) -> Tensor:
    """Frames that tell where the floor is: not masked, and of people who are there. -> (B, T, P) bool"""
    counts = scene.present[:, None].expand(scene.T_world_root.shape[:3])
    return counts if scene.valid is None else counts & scene.valid[..., None]


@cpu_by_default
def on_floor(scene: Scene, body: Body | None = None) -> Scene:
    """The same motion, each scene moved so that its lowest person stands on y = 0; masked frames do not count.

    body: as for `lowest`.
    """
    if not scene.present.any() or not scene.frames:
        return scene
    heights = standing(lowest(scene, body), counting(scene)).nan_to_num(nan=torch.inf).amin(dim=1)  # (B,)
    T_new_world = torch.eye(4, dtype=scene.T_world_root.dtype, device=scene.device).repeat(scene.scenes, 1, 1, 1, 1)
    T_new_world[:, 0, 0, 1, 3] = -torch.where(heights.isfinite(), heights, 0.0).to(T_new_world)
    return scene.transformed(T_new_world)


def off_their_floor(heights: Sequence[float], names: Sequence[str] = ()) -> list[str]:
    """A sentence for each person who does not stand where the scene's floor is.

    Legs have another length where a recording's shapes are left out, and one height is all that a scene is moved by.

    Args:
        heights: (P,) metres over the floor at which each person stands, NaN for nobody.
        names: theirs; empty: numbers.
    """
    said = "the scene's floor: so recorded, or legs are longer or shorter than recorded; magnet refine puts feet on it"
    return [
        f"{names[p] if names else f'person {p}'}: stands {100 * abs(m):.0f} cm {'over' if m > 0 else 'under'} {said}"
        for p, m in enumerate(heights)
        if abs(m) > OTHER_FLOOR
    ]


def level(scene: Scene, body: Body | None = None) -> float:
    """Height in metres of the scene whose people all stand farthest from y = 0; 0 if none does, without masked frames.

    body: as for `lowest`.
    """
    if not scene.present.any() or not scene.frames:
        return 0.0
    away = off_floor(lowest(scene, body), counting(scene))
    return float(away[away.abs().argmax()])


@functools.cache
def open_body() -> Body:
    with torch.inference_mode(False):
        return load_body("open")
