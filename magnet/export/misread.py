"""Scenes whose lengths are no metres, or in which another axis than y points up, found in the motion itself.

Bodies are of a person's size whatever the unit, for only pelvises have places: what is too large are distances, speeds
and heights over the floor. People who do not stand along y may lie, so that more has to speak against it.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from magnet.body.floor import open_body
from magnet.body.joints import ANKLES, HIPS
from magnet.export.rig import UNITS, UP
from magnet.motion.scene import FPS, Scene

Floats = NDArray[np.float64]

PELVIS = 0.9
"""Metres over the floor at which a standing person has it."""
FAST, APART = 10.0, 25.0
"""m/s that no pelvis moves for a quarter of the time, and metres that people are not apart who have to do with each
other."""
ROUGHLY = 1.4
"""A height that is so many times another, at most, is about the same."""
ALONG, UPRIGHT = 0.8, 0.5
"""Share of an axis in the mean torso of somebody who stands or lies along it; of y, of who may stand along it."""
EXACTLY = 0.97
"""The same of everybody who stands, for who lies may have any direction."""
RISEN, ASIDE, ABOVE = 0.4, 0.6, 0.3
"""Metres that somebody who lies does not rise and sink, nor go aside of the body; nor lie over somebody parallel."""
STRAIGHT, OVER = 0.65, 0.28
"""Metres along the torso from ankles to hips of who crawls not; and of a pelvis over the lowest joint where somebody
lies on the side, at most: arms of who stands reach farther."""
ROLLED = 0.5
"""Least length of the mean of left axes, of 1, of somebody who does not roll."""
HANDSTAND = 0.8
"""Metres that a pelvis is over the hands of who stands on them; over the head it is less."""


def misread(scene: Scene, counts: Tensor, low: Tensor, step: Tensor) -> tuple[int, str] | None:
    """The first scene of another unit or axis, and what to do, in words; None if there is none.

    Args:
        scene: some moments of what is given.
        counts: (B, F, P) bool, who is given in which; a scene of which nothing is given is none of these.
        low: (B, F, P) height over y = 0 of each person's lowest point, metres.
        step: (B, S, P) metres from one frame to the next, NaN where that is not known.
    """
    scene, low = scene.to_float32(), low.float()
    something = counts.flatten(1).any(dim=1)  # (B,) is given
    upright = _mean(scene.T_world_root[..., 1, 1], counts)  # (B, P), NaN of nobody
    for b in (something & ~(upright >= UPRIGHT).any(dim=1)).nonzero()[:, 0].tolist():
        if said := _turned(scene.select([b]), low[b], counts[b]):
            return b, said
    pelvis = scene.T_world_root[..., :3, 3]
    raised = pelvis[..., 1] / (pelvis[..., 1] - low).clamp(min=0.1)  # height over y = 0 by that over the lowest point
    raised = torch.where(counts, raised, torch.inf).flatten(1).amin(dim=1)  # about 1 of who was put onto the floor
    speeds = step.flatten(1).nanquantile(0.75, dim=1) * FPS if step.numel() else torch.zeros_like(raised)
    apart = _apart(pelvis, counts)
    far = something & ((raised > UNITS["m"] / UNITS["inch"] / ROUGHLY) | (speeds > FAST) | (apart > APART))
    if not bool(far.any()):
        return None
    b = int(far.nonzero()[0, 0])
    return b, _of_unit(*(float(number[b]) for number in (raised, speeds, apart)))


def steps_of(scene: Scene, counts: Tensor, frames: Tensor, most: int) -> Tensor:
    """Metres that pelvises move from one frame to the next, in some moments. -> (B, S, P), NaN where it is not known

    Args:
        scene: of F frames.
        counts: (B, F, P) bool, who is known in which.
        frames: (F,) their numbers; between others there are gaps.
        most: how many moments.
    """
    first = (frames.diff() == 1).nonzero()[:, 0]
    first = first[torch.linspace(0, len(first) - 1, min(len(first), most), device=first.device).long()]
    place = scene.T_world_root[..., :3, 3]
    moved = (place[:, first + 1] - place[:, first]).float().norm(dim=-1)
    return torch.where(counts[:, first] & counts[:, first + 1], moved, torch.nan)


def _mean(values: Tensor, counts: Tensor) -> Tensor:
    """(B, F, P) -> (B, P), NaN of whom nothing counts"""
    return torch.where(counts, values, torch.nan).nanmean(dim=1)


def _apart(pelvis: Tensor, counts: Tensor) -> Tensor:
    """How far away the nearest other is, for the median of people and moments. (B, F, P, 3) -> (B,), NaN of loners"""
    apart = (pelvis[:, :, :, None] - pelvis[:, :, None]).norm(dim=-1)
    both = (
        counts[..., None] & counts[..., None, :] & ~torch.eye(counts.shape[-1], dtype=torch.bool, device=apart.device)
    )
    nearest = torch.where(both, apart, torch.inf).amin(dim=-1)
    return torch.where(nearest.isfinite(), nearest, torch.nan).flatten(1).nanmedian(dim=1).values


def _of_unit(raised: float, speed: float, apart: float) -> str:
    """What is too large for metres, the unit that it suggests, and what to do.

    raised: how many times as high as a body can have it the lowest pelvis is; speed: m/s; apart: m
    """
    measured = [(raised > 10, raised * PELVIS, "pelvises are {:.0f} m over y = 0")]
    measured += [
        (apart > APART, apart, "people are {:.0f} m apart"),
        (speed > FAST, speed, "pelvises move at {:.0f} m/s"),
    ]
    seen = " and ".join(text.format(number) for strange, number, text in measured if strange)
    names = [name for name in ("mm", "cm", "inch") if 1 / ROUGHLY < raised * UNITS[name] < ROUGHLY]
    # Without a height nothing tells units apart; centimetres are by far the most frequent.
    name = min(names, key=lambda name: abs(np.log(raised * UNITS[name])), default="cm")
    sure = f"as if in {name}" if names else f"as if in another unit than metres, such as {name}"
    return (
        f"{seen}, {sure}: bring T_world_root[..., :3, 3] to metres (times {UNITS[name]:g} from {name}), then "
        "magnet.on_floor(scene); of files say the unit: magnet.read(..., unit=...), --in_unit"
    )


def _turned(scene: Scene, low: Tensor, counts: Tensor) -> str:
    """What to do where people of one scene stand along another axis; empty if they may as well lie. Twice (F, P)"""
    poses, under, seen = (each.detach().cpu().double().numpy() for each in (scene.T_world_root[0], low, counts))
    legs = _legs(scene).detach().cpu().double().numpy()
    people = [
        _Body(poses[of, p], legs[of, p], under[of, p]) for p in range(seen.shape[1]) if (of := seen[:, p] > 0).any()
    ]
    torsos = np.stack([person.torso for person in people])
    axis = int(np.abs(torsos.sum(axis=0)).argmax())
    sign = np.sign(torsos[:, axis].sum())
    least = float((sign * torsos[:, axis]).min())
    if least < ALONG:
        return ""
    if axis == 1:
        lying = any(person.over > HANDSTAND for person in people)
    else:
        floors = [person.floor for person in people]
        lying = not any(person.goes or (person.stands and least > EXACTLY) for person in people)
        lying = lying and max(floors) - min(floors) < ABOVE
    if lying:
        return ""
    name = ("-" if sign < 0 else "") + "xyz"[axis]
    T_new_world = np.eye(4)
    T_new_world[:3, :3] = UP[name]
    turn = ", ".join(str([int(number) for number in row]) for row in T_new_world)
    return (
        f"people stand along {name} and not along y, which points up in scenes: turn it, "
        f"scene.transformed(torch.tensor([{turn}]).float()), then magnet.on_floor(scene); where it was read with "
        "--up (up=...), leave that out or say another axis"
    )


def _legs(scene: Scene) -> Tensor:
    """From ankles to hips, of a body of average shape, metres. -> (F, P, 3)"""
    body = open_body().to(scene.device)
    joints = body.forward_kinematics(
        scene.body_rot[0].float(), scene.T_world_root[0].float(), torch.zeros(10, dtype=torch.float32).to(scene.device)
    )
    return (joints[..., list(HIPS), :] - joints[..., list(ANKLES), :]).mean(dim=-2)


class _Body:
    """Somebody who is not upright along y: what tells whether a world was turned, or who is in it lies.

    Args:
        poses: (F, 4, 4) of the pelvis.
        legs: (F, 3) from ankles to hips.
        low: (F,) height of the lowest point over y = 0.
    """

    def __init__(self, poses: Floats, legs: Floats, low: Floats) -> None:
        self.torso: Floats = poses[:, :3, 1].mean(axis=0)
        self.over = float(np.median(poses[:, 1, 3] - low))
        self.floor = float(np.quantile(low, 0.1))
        along = self.torso / np.linalg.norm(self.torso)
        face_down = np.median(poses[:, 1, 2]) < -ALONG
        self.stands = bool(np.median(legs @ along) > STRAIGHT and self.over > OVER and not face_down)
        rose = np.ptp(np.percentile(poses[:, 1, 3], [15, 85]))
        aside = poses[:, :3, 3] @ np.cross(along, [0.0, 1.0, 0.0])
        rolls = np.linalg.norm(poses[:, :3, 0].mean(axis=0)) < ROLLED
        self.goes = bool(rose > RISEN or (np.ptp(np.percentile(aside, [15, 85])) > ASIDE and not rolls))
