"""Shared by the builders of couplings: clocks, keyed curves, directions on the ground.

A builder plans `frames + 2 * PAD` frames, of which the middle ones are kept, so that all motion is under way at the
first of them. Times in its `truth` are seconds from the first kept frame.
"""

from __future__ import annotations

import torch
from torch import Tensor

from magnet.motion.scene import FPS
from magnet.synthesis.gait import plan_feet, stack
from magnet.synthesis.ik import ease
from magnet.synthesis.people import People
from magnet.synthesis.pose import Plan, still

PAD = round(FPS)
"""Frames planned before and after those that are kept."""

Truth = dict[str, Tensor]
"""A coupling in closed form: delays, times of contact, radii, ..."""


def seconds(frames: int) -> Tensor:
    """Time of each planned frame; 0 is the first kept one. (frames + 2 PAD,)"""
    return torch.arange(-PAD, frames + PAD, dtype=torch.float64) / FPS


def keyed(when: tuple[Tensor, Tensor], values: Tensor, clock: Tensor) -> Tensor:
    """Rest at `values[k]`, leave for the next at `when[0][k]`, arrive `when[1][k]` later. (K, ...) -> (T, ...)"""
    times, moves = when
    progress = ease((clock[:, None] - times) / moves)  # (T, K - 1)
    return values[0] + torch.tensordot(progress, torch.diff(values, dim=0), dims=1)


def upright(ground: Tensor, height: Tensor | float) -> Tensor:
    """(x, z) and a height to a point. (..., 2) -> (..., 3)"""
    height = torch.as_tensor(height, dtype=ground.dtype).expand(ground.shape[:-1])
    return torch.stack([ground[..., 0], height, ground[..., 1]], dim=-1)


def facing(yaw: Tensor) -> tuple[Tensor, Tensor]:
    """Unit vectors ahead and to the left on the ground as (x, z). (...) -> 2 x (..., 2)"""
    return torch.stack([yaw.sin(), yaw.cos()], dim=-1), torch.stack([yaw.cos(), -yaw.sin()], dim=-1)


def walked(ground: Tensor, yaw: Tensor, people: People) -> Plan:
    """Footsteps of everybody along ground paths (T, P, 2) with yaws (T, P)."""
    feet = stack([plan_feet(ground[:, p], yaw[:, p], people, p) for p in range(len(people))])
    return still(ground, yaw, feet, people)


def palm_facing(normal: Tensor, fingers: Tensor, hand: int) -> Tensor:
    """Where the thumb points if the palm faces `normal`. (..., 3) x 2 -> (..., 3)"""
    thumb = torch.linalg.cross(normal, fingers.expand_as(normal), dim=-1)
    return thumb if hand == 0 else -thumb
