"""People in a ring: a circle dance hand in hand, and patty-cake."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from magnet.motion.scene import FPS
from magnet.synthesis.people import PALM, People, noise, number
from magnet.synthesis.planning import Truth, facing, keyed, palm_facing, seconds, upright, walked
from magnet.synthesis.pose import Plan


def _ring(people: People, turn: Tensor, radius: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Evenly around the origin, facing it: ground (T, P, 2), yaw (T, P) and the angle (T, P); left is onward."""
    P = len(people)
    angle = turn[:, None] + 2 * math.pi * torch.arange(P, dtype=torch.float64) / P
    ground = radius[:, None, None] * torch.stack([angle.cos(), angle.sin()], dim=-1)
    return ground, -math.pi / 2 - angle, angle


def circle(people: People, frames: int, generator: torch.Generator) -> tuple[Plan, Truth]:
    """Hand in hand around a circle, all together in (hands up) and out again; two people hold both hands.

    truth: omega () rad/s about y seen from above as x to z, radius () metres at its widest, dip () metres it
    shrinks by, period () seconds from wide to wide, gap () metres between the wrists of held hands.
    """
    P, clock = len(people), seconds(frames)
    arm = float(people.arm.min())
    radius = {2: 0.76, 3: 1.2, 4: 1.67}.get(P, 1.03 * P / math.pi) * arm
    radius = radius * number(generator, 0.97, 1.04)
    dip = number(generator, 0.05, 0.09) if P > 2 else number(generator, 0.02, 0.05)
    period = number(generator, 3.2, 4.5)
    omega = math.copysign(number(generator, 0.2, 0.34), number(generator, -1, 1)) / radius
    swell = 0.5 - 0.5 * torch.cos(2 * math.pi * clock / period)
    ground, yaw, angle = _ring(people, omega * clock + number(generator, 0, 6), radius - dip * swell)
    plan = walked(ground, yaw, people)
    onward = ground.roll(-1, dims=1) - ground
    onward = onward / onward.norm(dim=-1, keepdim=True)
    middle = (ground + ground.roll(-1, dims=1)) / 2
    if P == 2:
        onward = -ground / ground.norm(dim=-1, keepdim=True)
        middle = middle + 0.26 * facing(yaw)[1]
    height = (people.shoulder_height + people.shoulder_height.roll(-1)) / 2
    lift = number(generator, 0.18, 0.32) * swell + 0.012 * torch.sin(4 * math.pi * clock / period)
    held = upright(middle, height - 0.27 + lift[:, None])
    inward = upright(-torch.stack([angle.cos(), angle.sin()], dim=-1), 0.0)
    inward = inward + inward.roll(-1, dims=1) if P > 2 else upright(facing(yaw)[1], 0.0)
    tilt = torch.tensor([0.0, 0.3, 0.0], dtype=torch.float64)
    palms = torch.stack([held + tilt * 0.03, (held - tilt * 0.03).roll(1, dims=1)], dim=2)
    level = upright(onward, 0.0)
    fingers = torch.stack([level, -level.roll(1, dims=1)], dim=2)
    thumb = torch.stack([inward - tilt, (tilt - inward).roll(1, dims=1)], dim=2)
    if P == 2:
        up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
        thumb = torch.stack([0.4 * up - inward, 0.4 * up - inward.roll(1, dims=1)], dim=2)
    opposite = torch.tensor([(p + max(1, P // 2)) % P for p in range(P)])
    plan = replace(
        plan,
        palm=palms,
        fingers=fingers,
        thumb=thumb,
        palm_weight=torch.ones_like(plan.palm_weight),
        gaze=upright(0.4 * ground[:, opposite], people.head_height[opposite] - 0.1),
        torso=plan.torso + torch.tensor([0.04, 0.0, 0.0], dtype=torch.float64),
    )
    values = {"omega": omega, "radius": radius, "dip": dip, "period": period, "gap": math.hypot(2 * PALM, 0.018)}
    return plan, {name: torch.tensor(value, dtype=torch.float64) for name, value in values.items()}


OWN, BOTH, RIGHT, LEFT = range(4)


def patty_cake(people: People, frames: int, generator: torch.Generator) -> tuple[Plan, Truth]:
    """Own hands, partner's hands, own hands, ... in a steady rhythm; two people also cross right and left,
    more people stand in a ring and clap with both neighbours.

    truth: period () seconds from clap to clap, claps (K,) seconds of those with others, kinds (K,) int of `OWN,
    BOTH, RIGHT, LEFT`, gap () metres between wrists that meet.
    """
    P, clock = len(people), seconds(frames)
    arm = float(people.arm.mean())
    radius = {2: 0.74, 3: 0.95, 4: 1.12}.get(P, 0.8 * P / math.pi) * arm
    shift = 0.012 * noise(generator, len(clock), 2, high=0.3)
    ground, yaw, _ = _ring(people, torch.full_like(clock, number(generator, 0, 6)), torch.full_like(clock, radius))
    plan = walked(ground + 0.25 * shift[:, None], yaw, people)
    period = number(generator, 0.55, 0.75) if P == 2 else number(generator, 0.65, 0.9)
    first = number(generator, -0.9, -0.9 + period)
    count = int((float(clock[-1]) - first) / period) + 2
    cycle = [OWN, BOTH, OWN, RIGHT, OWN, LEFT] if P == 2 else [OWN, BOTH]
    kinds = [cycle[k % len(cycle)] for k in range(count)]
    palms, fingers, thumbs = (
        torch.stack(parts) for parts in zip(*(_clap(kind, ground[0], yaw[0], people) for kind in cycle), strict=True)
    )
    order = torch.tensor([k % len(cycle) for k in range(count)])
    times = first + period * torch.arange(count, dtype=torch.float64)
    rest = 0.05 * period
    when = (times[:-1] + rest / 2, torch.full((count - 1,), period - rest, dtype=torch.float64))
    twist = torch.tensor([0.0, 0.0, 0.16, -0.16], dtype=torch.float64)[torch.tensor(kinds)]
    torso = 0.02 * noise(generator, len(clock), P, 3)
    torso[..., 1] += keyed(when, twist, clock)[:, None]
    bounce = 0.5 - 0.5 * torch.cos(2 * math.pi * (clock - first) / period)
    plan = replace(
        plan,
        crouch=0.012 * people.energy * bounce[:, None],
        palm=keyed(when, palms[order], clock),
        fingers=keyed(when, fingers[order], clock),
        thumb=keyed(when, thumbs[order], clock),
        palm_weight=torch.ones_like(plan.palm_weight),
        gaze=upright(ground.roll(-1, dims=1) * 0.9, people.head_height.roll(-1) - 0.05),
        torso=torso,
    )
    kept = [(float(t), k) for t, k in zip(times, kinds, strict=True) if k != OWN and 0 <= t <= (frames - 1) / FPS]
    truth = {
        "period": torch.tensor(period, dtype=torch.float64),
        "claps": torch.tensor([t for t, _ in kept], dtype=torch.float64),
        "kinds": torch.tensor([k for _, k in kept]),
        "gap": torch.tensor(2 * (0.01 + PALM * 0.25 / math.hypot(0.97, 0.25)), dtype=torch.float64),
    }
    return plan, truth


def _clap(kind: int, ground: Tensor, yaw: Tensor, people: People) -> tuple[Tensor, Tensor, Tensor]:
    """Palms, fingers and thumbs of everybody at one clap. (P, 2, 3) each"""
    P = len(people)
    ahead, left = (upright(v, 0.0) for v in facing(yaw))
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    height = float(people.shoulder_height.mean()) - 0.13
    here = upright(ground, height)
    palms, fingers, thumbs = [], [], []
    for hand in (0, 1):
        side = 1 - 2 * hand
        if kind == OWN or (kind == RIGHT and hand == 0) or (kind == LEFT and hand == 1):
            open_by = 0.01 if kind == OWN else 0.14
            palm, normal = here + 0.34 * ahead - 0.08 * up + side * open_by * left, -side * left
            finger = 0.75 * up + 0.65 * ahead
        else:
            toward = ground.roll(-side, dims=0) - ground
            toward = upright(toward / toward.norm(dim=-1, keepdim=True), 0.0)
            meet = upright((ground + ground.roll(-side, dims=0)) / 2, height)
            aside = side * 0.17 * left if kind == BOTH and P == 2 else torch.zeros_like(left)
            palm, normal = meet + aside - 0.01 * toward, toward
            finger = 0.97 * up + 0.25 * toward
        palms.append(palm)
        fingers.append(finger)
        thumbs.append(palm_facing(normal, finger, hand))
    return torch.stack(palms, dim=1), torch.stack(fingers, dim=1), torch.stack(thumbs, dim=1)
