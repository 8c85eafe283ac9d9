"""Imitation with a delay: mirroring, and following a leader."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from magnet.motion.scene import FPS
from magnet.synthesis.gait import plan_feet, stack
from magnet.synthesis.ik import smooth
from magnet.synthesis.people import People, noise, number, uniform
from magnet.synthesis.planning import PAD, Truth, facing, keyed, upright, walked
from magnet.synthesis.pose import Plan, still

POSES = torch.tensor(  # of a left hand: azimuth (0 aside, pi/2 ahead), elevation, distance in arm lengths
    [
        [0.9, -1.38, 0.94],  # hanging
        [0.3, -0.1, 0.94],  # aside
        [0.7, 1.15, 0.95],  # up
        [1.4, -0.05, 0.92],  # ahead
        [1.15, 0.6, 0.88],  # ahead and up
        [1.75, -0.35, 0.55],  # before the chest
        [0.35, 0.7, 0.94],  # aside and up
        [0.55, 0.45, 0.6],  # bent, beside the head
        [0.8, -0.75, 0.85],  # offered low
    ],
    dtype=torch.float64,
)


def _dance(frames: int, generator: torch.Generator) -> dict[str, Tensor]:
    """The fields of `Plan` for one person who steps on the spot and gestures, facing +z."""
    clock = torch.arange(frames, dtype=torch.float64) / FPS
    keys = int(frames / FPS / 0.9) + 3

    def moves(low: float, high: float, share: float) -> tuple[Tensor, Tensor]:
        gaps = uniform(generator, low, high, keys - 1)
        return gaps.cumsum(0) - gaps[0] + number(generator, -0.5, 0.3), share * gaps

    spread = torch.tensor([0.38, 0.2, 0.3], dtype=torch.float64)
    places = keyed(moves(1.1, 2.0, 0.95), uniform(generator, -1, 1, keys, 3) * spread, clock)
    bend = uniform(generator, -1, 1, keys, 4) * torch.tensor([0.1, 0.28, 0.12, 0.1], dtype=torch.float64)
    bent = keyed(moves(1.0, 1.9, 0.9), bend, clock)
    pose = torch.randint(len(POSES), (keys, 2), generator=generator)
    alike = torch.rand(keys, generator=generator) < 0.55
    pose[:, 1] = torch.where(alike, pose[:, 0], pose[:, 1])
    spots = POSES[pose] + uniform(generator, -1, 1, keys, 2, 3) * torch.tensor([0.15, 0.12, 0.03]).double()
    azimuth, elevation, far = keyed(moves(0.9, 1.6, 0.85), spots, clock).unbind(-1)
    far = far.clamp(0.3, 0.97)
    side = torch.tensor([1.0, -1.0], dtype=torch.float64)
    gesture = torch.stack(
        [side * elevation.cos() * azimuth.cos() * far, elevation.sin() * far, elevation.cos() * azimuth.sin() * far], -1
    )
    return {
        "ground": places[:, :2],
        "yaw": places[:, 2],
        "crouch": bent[:, 3].clamp_min(0.0),
        "torso": bent[:, :3],
        "gesture": gesture,
    }


def mirror(people: People, frames: int, generator: torch.Generator) -> tuple[Plan, Truth]:
    """Agent 0 dances; the others face it and are its mirror image, each with a delay of its own.

    truth: delay (P - 1,) seconds.
    """
    P, length = len(people), frames + 2 * PAD
    delay = torch.randint(6, 25, (P - 1,), generator=generator)
    longest = 25
    dance = _dance(length + longest, generator)
    apart = number(generator, 1.7, 2.2) + 0.3 * (P > 2)
    dance["ground"] = dance["ground"] - torch.tensor([0.0, apart / 2], dtype=torch.float64)
    feet = plan_feet(dance["ground"], dance["yaw"], people, 0)
    flip = torch.tensor([1.0, -1.0], dtype=torch.float64)
    tracks, steps = [], []
    for p in range(P):
        late = slice(longest, longest + length)
        if p > 0:
            late = slice(longest - int(delay[p - 1]), longest - int(delay[p - 1]) + length)
        track, step = {name: value[late] for name, value in dance.items()}, feet.at(late)
        if p > 0:
            shift = torch.tensor([1.5 * (p - 1 - (P - 2) / 2), 0.0], dtype=torch.float64)
            track["ground"] = track["ground"] * flip + shift
            track["yaw"] = math.pi - track["yaw"]
            track["torso"] = track["torso"] * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
            track["gesture"] = track["gesture"].flip(1) * torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
            step = step.mirrored().shifted(shift)
        tracks.append(track)
        steps.append(step)
    both = {name: torch.stack([track[name] for track in tracks], dim=1) for name in dance}
    plan = still(both["ground"], both["yaw"], stack(steps), people)
    gaze = upright(plan.ground[:, :1].expand_as(plan.ground), people.head_height[0])
    if P > 1:
        gaze[:, 0] = upright(plan.ground[:, 1:].mean(dim=1), people.head_height[1:].mean())
    else:
        gaze = plan.gaze
    plan = replace(
        plan,
        crouch=both["crouch"],
        torso=both["torso"],
        gesture=both["gesture"],
        gesture_weight=torch.ones_like(plan.gesture_weight),
        gaze=gaze,
    )
    return plan, {"delay": delay.double() / FPS}


# -- follow the leader -------------------------------------------------------------------------


def follow(people: People, frames: int, generator: torch.Generator) -> tuple[Plan, Truth]:
    """Agent 0 strolls; each of the others walks the same path later, with its own steps.

    truth: delay (P - 1,) seconds behind agent 0.
    """
    P, length = len(people), frames + 2 * PAD
    for _ in range(50):
        pace = number(generator, 0.8, 1.15)
        gap = math.ceil(number(generator, 0.95, 1.2) / pace * FPS)
        total = length + gap * (P - 1)
        speed = pace * (1 + 0.06 * noise(generator, total, high=0.3))
        turn = (0.35 * noise(generator, total, low=0.03, high=0.2)).clamp(-0.55, 0.55)
        heading = (smooth(turn, 6.0) / FPS).cumsum(0)
        path = (speed[:, None] * facing(heading)[0] / FPS).cumsum(0)
        late = [gap * (P - 1 - p) for p in range(P)]
        ground = torch.stack([path[s : s + length] for s in late], dim=1)
        yaw = torch.stack([heading[s : s + length] for s in late], dim=1)
        near = (ground[:, :, None] - ground[:, None]).norm(dim=-1) + 9 * torch.eye(P)
        if float(near.min()) > 0.6:
            break
    plan = walked(ground - ground.mean(dim=(0, 1)), yaw, people)
    gaze = plan.gaze.clone()
    gaze[:, 1:] = upright(plan.ground[:, :-1], people.head_height[:-1] - 0.1)
    return replace(plan, gaze=gaze), {"delay": gap * torch.arange(1, P, dtype=torch.float64) / FPS}
