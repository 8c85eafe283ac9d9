"""Placement of feet: footholds are planned first, and a planted foot never moves."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from magnet.motion.scene import FPS
from magnet.synthesis.people import People

STEP_OVER = 0.07
"""Metres between a foot and its place above which it takes a step."""
STEP_ROUND = 0.3
"""The same, in radians."""


@dataclass(frozen=True)
class Feet:
    """Both feet (left, right) of a person over T frames: (T, 2, ...), or of P people: (T, P, 2, ...)."""

    ball: Tensor  # (..., 3) metres: where the ball of the foot would be with the sole level, y over its plant
    yaw: Tensor  # radians
    heel_up: Tensor  # radians the foot is pitched about the ball, toes on the floor, >= 0
    toes_up: Tensor  # radians the foot is pitched about the heel, >= 0
    planted: Tensor  # bool

    def at(self, frames: slice) -> Feet:
        return Feet(**{name: value[frames] for name, value in vars(self).items()})

    def mirrored(self) -> Feet:
        """Reflected in the plane z = 0: z changes sign, left and right swap. Of one person."""
        swapped = {name: value.flip(1) for name, value in vars(self).items()}
        flip = torch.tensor([1.0, 1.0, -1.0], dtype=self.ball.dtype)
        return replace(Feet(**swapped), ball=swapped["ball"] * flip, yaw=torch.pi - swapped["yaw"])

    def shifted(self, ground: Tensor) -> Feet:
        """Moved by (x, z) metres. (2,)"""
        x, z = ground.unbind(-1)
        return replace(self, ball=self.ball + torch.stack([x, torch.zeros_like(x), z], dim=-1))


def stack(feet: list[Feet]) -> Feet:
    """One person each -> (T, P, 2, ...)"""
    return Feet(**{name: torch.stack([getattr(f, name) for f in feet], dim=1) for name in vars(feet[0])})


def _ease(u: np.ndarray) -> np.ndarray:
    u = np.clip(u, 0, 1)
    return u**3 * (10 - 15 * u + 6 * u**2)


def _glide(u: np.ndarray) -> np.ndarray:
    """Like `_ease` but with a lower top speed, as a leg swings."""
    u = np.clip(u, 0, 1)
    return 0.5 * _ease(u) + 0.5 * u * u * (3 - 2 * u)


def _bump(t: np.ndarray, start: float, top: float, end: float) -> np.ndarray:
    """0 before start, 1 at top, 0 after end, smooth."""
    return np.where(t < top, _ease((t - start) / (top - start)), 1 - _ease((t - top) / (end - top)))


@dataclass(frozen=True)
class _Step:
    foot: int
    lift: int
    land: int
    beat: int  # frames to the next step
    start: tuple[float, float, float]  # x, z, yaw
    end: tuple[float, float, float]


def plan_feet(ground: Tensor, yaw: Tensor, people: People, person: int) -> Feet:
    """Footsteps that carry a body along a path: strolling, side-stepping, backing, turning, standing.

    A foot lands where the body will be in the middle of its next stance: ahead of a walking body, and below one that
    stands still.

    Args:
        ground: (T, 2) path of the pelvis as (x, z), metres.
        yaw: (T,) where the body faces, radians, unwrapped.
        people: gait parameters and body measures; `person` is the index to use.
    """
    steps = _decide(ground.numpy(), yaw.numpy(), people, person)
    return _trace(steps, ground.shape[0], _places(ground.numpy(), yaw.numpy(), people, person))


def _places(ground: np.ndarray, yaw: np.ndarray, people: People, person: int) -> np.ndarray:
    """Where each foot would stand if the body rested in that frame: x, z, yaw. -> (T, 2, 3)"""
    forward = np.stack([np.sin(yaw), np.cos(yaw)], axis=-1)
    left = np.stack([np.cos(yaw), -np.sin(yaw)], axis=-1)
    aside = np.abs((np.gradient(ground, axis=0) * left).sum(-1)) * FPS
    # Side steps widen the stance, else the feet would cross.
    wide = float(people.stance[person]) + np.clip(0.36 * aside * float(people.step_time[person]) - 0.025, 0.0, 0.2)
    ahead = float(people.rest[person, 10:12, 2].mean())
    places = np.empty((len(yaw), 2, 3))
    for foot, side in enumerate((1, -1)):
        places[:, foot, :2] = ground + ahead * forward + side * wide[:, None] * left
        places[:, foot, 2] = yaw + side * float(people.toe_out[person])
    return places


def _decide(ground: np.ndarray, yaw: np.ndarray, people: People, person: int) -> list[_Step]:
    places = _places(ground, yaw, people, person)
    last = len(yaw) - 1
    feet = [tuple(places[0, 0]), tuple(places[0, 1])]
    steps: list[_Step] = []
    t, turn = 1, int(float(people.energy[person]) * 1000) % 2
    while t < last:
        ahead = ground[min(t + 15, last)] - ground[t]
        speed = float(np.hypot(*ahead)) * 2
        aside = abs(float(ahead @ [np.cos(yaw[t]), -np.sin(yaw[t])])) * 2 / (speed + 0.1)
        quick = (1 - 0.22 * min(speed, 1.6)) * (1 - 0.28 * aside)
        beat = max(11, round(FPS * float(people.step_time[person]) * quick))
        swing = max(9, round(0.81 * beat))
        middle = min(t + beat + swing // 2, last)
        for foot in (turn, 1 - turn):
            x, z, heading = places[middle, foot]
            was = feet[foot]
            if np.hypot(x - was[0], z - was[1]) > STEP_OVER or abs(heading - was[2]) > STEP_ROUND:
                steps.append(_Step(foot, t, t + swing, beat, was, (x, z, heading)))
                feet[foot] = (x, z, heading)
                turn, t = 1 - foot, t + beat
                break
        else:
            t += 1
    return steps


def _trace(steps: list[_Step], frames: int, places: np.ndarray) -> Feet:
    t = np.arange(frames)
    ball = np.zeros((frames, 2, 3))
    yaw, heel_up, toes_up = (np.zeros((frames, 2)) for _ in range(3))
    planted = np.ones((frames, 2), dtype=bool)
    ball[:, :, [0, 2]] = places[0, :, :2]
    yaw[:] = places[0, :, 2]
    for step in steps:
        f = step.foot
        start, end = np.array(step.start), np.array(step.end)
        u = (t - step.lift) / (step.land - step.lift)
        glide = _glide(u)[:, None]
        moved = (1 - glide) * start + glide * end  # exact at both ends
        now = t >= step.lift
        ball[now, f, 0], ball[now, f, 2], yaw[now, f] = moved[now].T
        stride = (end - start)[:2]
        middle = (start[2] + end[2]) / 2
        forth = float(stride @ np.array([np.sin(middle), np.cos(middle)]))
        far = float(np.hypot(*stride))
        ball[:, f, 1] += (0.02 + 0.02 * min(far, 1.0) + 0.1 * min(far - abs(forth), 0.4)) * _bump(u, 0.0, 0.4, 1.0)
        planted[(t > step.lift) & (t < step.land), f] = False
        swing = step.land - step.lift
        lift = np.clip(0.7 * forth, 0.18, 0.95)
        # Peaks after the toe has left: the push-off flows into the swing.
        off = _bump(t, step.lift - 0.48 * step.beat, step.lift + 0.24 * swing, step.lift + 0.74 * swing)
        heel_up[:, f] = np.maximum(heel_up[:, f], lift * off)
        strike = np.clip(0.24 * forth, 0.0, 0.32)
        on = _bump(t, step.lift + 0.42 * swing, step.land - 0.1 * swing, step.land + 0.3 * step.beat)
        toes_up[:, f] = np.maximum(toes_up[:, f], strike * on)
    return Feet(*(torch.from_numpy(a) for a in (ball, yaw, heel_up, toes_up, planted)))
