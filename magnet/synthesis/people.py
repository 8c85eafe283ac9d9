"""People drawn at random: shapes, measures at rest and gait parameters; and the smooth noise of their motion."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from magnet.body import Body
from magnet.body.joints import HEAD, L_ELBOW, L_SHOULDER, L_WRIST, R_ELBOW, R_SHOULDER, R_WRIST, SHOULDERS, TOES
from magnet.motion.scene import FPS

PALM = 0.08
"""Metres from the wrist to the middle of the palm."""
SOLE = 0.028
"""Metres from the ball-of-foot joint down to the sole of a resting foot."""


@dataclass(frozen=True)
class People:
    """P people, float64: shapes, joints at rest, and manner (each (P,))."""

    betas: Tensor  # (P, 10)
    rest: Tensor  # (P, 22, 3), pelvis at the origin, so that the floor lies at -stature
    stature: Tensor  # height of the resting pelvis over the soles
    step_time: Tensor  # seconds from a footstep to the next at a stroll
    stance: Tensor  # half the distance between the feet
    toe_out: Tensor  # radians
    arm_swing: Tensor  # radians a metre between the feet
    arms_out: Tensor  # radians off the vertical, hanging
    elbow: Tensor  # radians of bend, hanging
    lean: Tensor  # radians the chest tips forward
    energy: Tensor  # scales noise and sway

    def __len__(self) -> int:
        return len(self.betas)

    @property
    def arm(self) -> Tensor:
        """Shoulder to wrist, the mean of both arms. (P,) metres"""
        bones = (
            self.rest[:, [L_ELBOW, L_WRIST, R_ELBOW, R_WRIST]]
            - self.rest[:, [L_SHOULDER, L_ELBOW, R_SHOULDER, R_ELBOW]]
        )
        return bones.norm(dim=-1).sum(dim=-1) / 2

    @property
    def shoulder_height(self) -> Tensor:
        """Over the floor when standing. (P,) metres"""
        return self.rest[:, SHOULDERS, 1].mean(dim=1) + self.stature

    @property
    def head_height(self) -> Tensor:
        return self.rest[:, HEAD, 1] + self.stature


def uniform(generator: torch.Generator, low: float, high: float, *shape: int) -> Tensor:
    """float64 numbers in [low, high)."""
    return low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)


def number(generator: torch.Generator, low: float, high: float) -> float:
    """One number in [low, high)."""
    return float(uniform(generator, low, high))


def gather(count: int, generator: torch.Generator, body: Body) -> People:
    """Draw P different people: shapes N(0, 1) clipped at 2, manner uniform in human ranges."""
    betas = torch.randn(count, 10, generator=generator, dtype=torch.float64).clamp(-2, 2).float()
    rest = body.rest_joints(betas).detach().cpu().double()
    rest = rest - rest[:, :1]
    return People(
        betas=betas,
        rest=rest,
        stature=SOLE - rest[:, TOES, 1].mean(dim=1),
        step_time=uniform(generator, 0.66, 0.76, count),
        stance=uniform(generator, 0.085, 0.115, count),
        toe_out=uniform(generator, 0.03, 0.2, count),
        arm_swing=uniform(generator, 0.35, 0.85, count),
        arms_out=uniform(generator, 0.13, 0.23, count),
        elbow=uniform(generator, 0.2, 0.45, count),
        lean=uniform(generator, -0.02, 0.07, count),
        energy=uniform(generator, 0.6, 1.3, count),
    )


def noise(generator: torch.Generator, frames: int, *shape: int, low: float = 0.08, high: float = 0.7) -> Tensor:
    """Smooth band-limited noise of unit variance: a sum of sines of random frequency and phase. Hz -> (T, *shape)"""
    waves = 6
    hertz = low * (high / low) ** torch.rand(waves, *shape, generator=generator, dtype=torch.float64)
    phase = 2 * math.pi * torch.rand(waves, *shape, generator=generator, dtype=torch.float64)
    size = torch.rand(waves, *shape, generator=generator, dtype=torch.float64) + 0.3
    size = size * (2 / (size**2).sum(dim=0)).sqrt()
    seconds = torch.arange(frames, dtype=torch.float64).view(frames, *[1] * (1 + len(shape))) / FPS
    return (size * torch.sin(2 * math.pi * hertz * seconds + phase)).sum(dim=1)
