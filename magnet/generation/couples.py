"""Couples stay together in scenes that go on for long: whoever drifts away from a partner is led back."""

from __future__ import annotations

import torch
from torch import Tensor

from magnet.motion.scene import FPS

LONG = 40
"""Token steps after the last given one, over five seconds, beyond which people are led: up to there nobody is."""

COUPLE = 96
"""Frames that two people must have been together to be a couple: who pass each other are none."""

PARTED = 1.25
"""Share of the reach beyond which two people are no longer together."""

FREE = 0.76
"""Share of the reach up to which nobody is led."""

BACK = 0.15
"""Speed in m/s at which the two of a couple come nearer to each other where they are a reach apart."""


class Couples:
    """Who has been together for how long, and how they are kept so.

    Args:
        reach: metres between two pelvises over the ground that a couple stays within.
    """

    def __init__(self, reach: float) -> None:
        self.reach = reach
        self.together: Tensor | None = None  # (B, P, P) frames that two people have been so up to now

    def led(self, ground: Tensor, free: Tensor, present: Tensor) -> Tensor:
        """How far people are moved over the ground in new frames.

        Ways apart are shortened, the more the nearer a couple is to its reach, and who is far apart comes slowly back.

        Args:
            ground: (B, 1 + T, P, 2) metres, where everybody is in the frame before and in T new ones.
            free: (T, P) bool, who may be moved; couples are led only where both may.
            present: (B, P) bool.

        Returns:
            (B, T, P, 2) metres.
        """
        between = ground[:, :, :, None] - ground[:, :, None]  # (B, 1 + T, P, P, 2), to the one from the other
        apart = between.norm(dim=-1)
        over = (apart[:, 1:] / self.reach - FREE) / (1 - FREE)
        shortened = apart.diff(dim=1).clamp_min(0) * (1 - torch.cosh(over.clamp(0, 8)) ** -2)
        nearer = shortened + BACK / FPS * over.clamp(0, 1)
        both = free[:, :, None] & free[:, None]
        moved = (nearer * (both & self._couples(apart[:, 0], present)[:, None])).cumsum(dim=1) / 2
        way = (between / apart[..., None].clamp_min(1e-6))[:, 1:]
        made = -(moved[..., None] * way).sum(dim=3)
        self._count(ground[:, 1:] + made)
        return made

    def _couples(self, apart: Tensor, present: Tensor) -> Tensor:
        """Who have long been together, of whom one is nearest to the other. (B, P, P) metres -> bool"""
        if self.together is None:
            return torch.zeros_like(apart, dtype=torch.bool)
        other = ~torch.eye(apart.shape[1], dtype=torch.bool, device=apart.device)
        there = present[:, :, None] & present[:, None] & other
        far = torch.where(there, apart, torch.inf)
        nearest = (far == far.amin(dim=2, keepdim=True)) & there
        return (nearest | nearest.mT) & (self.together >= COUPLE)

    def _count(self, ground: Tensor) -> None:
        """Count new frames (B, T, P, 2) in which people are together."""
        near = torch.cdist(ground, ground) <= PARTED * self.reach  # (B, T, P, P)
        lately = near.flip(1).long().cumprod(dim=1).sum(dim=1)
        before = 0 if self.together is None else self.together
        self.together = torch.where(lately == ground.shape[1], before + lately, lately)
