"""Approach, shake hands, part."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from magnet.motion.scene import FPS
from magnet.synthesis.ik import ease
from magnet.synthesis.people import PALM, People, noise, number, uniform
from magnet.synthesis.planning import Truth, seconds, upright, walked
from magnet.synthesis.pose import Plan

APART = 2.6
"""Metres between the places where two pairs meet."""
FINGERS = (0.2, -0.15, 1.0)
"""Where the right hand points when it grips: ahead, a little across and down."""


def handshake(people: People, frames: int, generator: torch.Generator) -> tuple[Plan, Truth]:
    """Two people approach, shake right hands and part; a third person watches, four people form two pairs.

    truth: pairs (K, 2) int, contact (K, 2) seconds from grip to release, pumps (K,) Hz, gap (K,) metres
    between the wrists while they hold.
    """
    P, clock = len(people), seconds(frames)
    pairs = [(0, 1), (2, 3)][: P // 2]
    contact = torch.tensor([_when(frames, generator) for _ in pairs], dtype=torch.float64)
    pumps = uniform(generator, 1.5, 2.1, len(pairs))
    ground, yaw = clock.new_zeros(len(clock), P, 2), clock.new_zeros(len(clock), P)
    for k, pair in enumerate(pairs):
        stop = float(people.arm[list(pair)].mean()) * 0.76
        for end, person in enumerate(pair):
            # With others near, a pair leaves to its own side of the floor.
            way = math.copysign(1.0, number(generator, -1, 1)) if P == 2 else float((1 - 2 * k) * (2 * end - 1))
            path, heading = _meet(clock, contact[k].tolist(), stop, way, generator)
            ground[:, person] = _centre(k, len(pairs)) + (1 - 2 * end) * path
            yaw[:, person] = heading + math.pi * end
    for watcher in range(2 * len(pairs), P):
        place = torch.tensor([number(generator, 1.3, 1.6), number(generator, -0.2, 0.2)], dtype=torch.float64)
        ground[:, watcher] = place + 0.03 * noise(generator, len(clock), 2, high=0.3)
        yaw[:, watcher] = -math.pi / 2 + 0.08 * noise(generator, len(clock), high=0.3)
    plan = walked(ground, yaw, people)
    for k, pair in enumerate(pairs):
        _shake(plan, people, pair, _centre(k, len(pairs)), contact[k].tolist(), float(pumps[k]), clock)
    for watcher in range(2 * len(pairs), P):
        plan.gaze[:, watcher] = upright(ground[:, :2].mean(dim=1), people.head_height[:2].mean())
    along = torch.tensor(FINGERS, dtype=torch.float64)
    along = PALM * along / along.norm()
    gap = 2 * math.hypot(float(along[0]) + 0.008, float(along[2]))
    gaps = torch.full((len(pairs),), gap, dtype=torch.float64)
    return plan, {"pairs": torch.tensor(pairs), "contact": contact, "pumps": pumps, "gap": gaps}


def _when(frames: int, generator: torch.Generator) -> list[float]:
    """Seconds of grip and release."""
    grip = number(generator, 0.34, 0.42) * frames / FPS
    return [grip, grip + number(generator, 0.13, 0.2) * frames / FPS]


def _centre(k: int, pairs: int) -> Tensor:
    return torch.tensor([APART * (k - (pairs - 1) / 2), 0.0], dtype=torch.float64)


def _shake(
    plan: Plan, people: People, pair: tuple[int, int], centre: Tensor, contact: list[float], hertz: float, clock: Tensor
) -> None:
    """Add a pair's right hands, gazes and bows to the plan."""
    grip, release = contact
    held = ease((clock - grip) / 0.25) * (1 - ease((clock - release + 0.3) / 0.3))
    pump = 0.035 * held * torch.sin(2 * math.pi * hertz * (clock - grip))
    place = upright(centre, people.shoulder_height[list(pair)].mean() - 0.31)
    weight = ease((clock - grip + 0.75) / 0.75) * (1 - ease((clock - release) / 0.8))
    look = ease((clock + 1.5 - grip) / 1.0) * (1 - ease((clock - release - 0.3) / 0.8))
    across, down, ahead = FINGERS
    for me, other, turned in ((*pair, 1.0), (*pair[::-1], -1.0)):
        plan.palm[:, me, 1] = place + torch.stack([torch.full_like(pump, -0.008 * turned), pump, 0 * pump], dim=-1)
        plan.fingers[:, me, 1] = torch.tensor([across * turned, down, ahead * turned], dtype=torch.float64)
        plan.palm_weight[:, me, 1] = weight
        partner = upright(plan.ground[:, other], people.head_height[other])
        plan.gaze[:, me] = torch.lerp(plan.gaze[:, me], partner, look[:, None])
        plan.torso[:, me, 0] = 0.1 * weight
        plan.torso[:, me, 1] = 0.2 * weight


def _meet(
    clock: Tensor, contact: list[float], stop: float, way: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Walk along +z to a halt `stop` metres before the origin, then step back, turn and leave. -> (T, 2), (T,)"""
    grip, release = contact
    pace, start = number(generator, 0.9, 1.2), grip - number(generator, 2.2, 3.4)
    halt = grip - 0.1
    speed = pace * ease((clock - start) / 0.8) * (1 - ease((clock - halt + 1.1) / 1.1))
    walked_so_far = (speed / FPS).cumsum(0)
    there = walked_so_far[int((clock < halt).sum()) - 1]
    ground = torch.stack([torch.full_like(clock, 0.05), walked_so_far - there - stop], dim=-1)
    turn = way * number(generator, 1.9, 2.7)
    yaw = turn * ease((clock - release - 0.35) / 1.5)
    away = torch.tensor([math.sin(turn), math.cos(turn)], dtype=torch.float64)
    leave = number(generator, 0.85, 1.15) * ease((clock - release - 0.6) / 1.6)
    return ground + (leave / FPS).cumsum(0)[:, None] * away, yaw
