"""Couplings known in closed form, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from magnet.synthesis.handshake import handshake
from magnet.synthesis.imitation import follow, mirror
from magnet.synthesis.people import People
from magnet.synthesis.planning import Truth
from magnet.synthesis.pose import Plan
from magnet.synthesis.ring import circle, patty_cake


@dataclass(frozen=True)
class Coupling:
    """A builder of scenes and the group sizes that it supports."""

    plan: Callable[[People, int, torch.Generator], tuple[Plan, Truth]]
    fewest: int
    most: int


COUPLINGS = {
    "mirror": Coupling(mirror, fewest=1, most=6),
    "follow": Coupling(follow, fewest=1, most=6),
    "handshake": Coupling(handshake, fewest=2, most=4),
    "circle": Coupling(circle, fewest=2, most=8),
    "patty_cake": Coupling(patty_cake, fewest=2, most=8),
}
