"""Every placement is listed under its name."""

from __future__ import annotations

from typing import get_args

from magnet.motion.placement import PLACEMENTS, Placement


def test_every_placement_has_a_function():
    assert tuple(PLACEMENTS) == get_args(Placement)
