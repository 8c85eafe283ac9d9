"""How poses are corrected: what corrections cost, and what they are for."""

from __future__ import annotations

import math
from dataclasses import dataclass

from magnet.body.holding import HELD


@dataclass(frozen=True)
class Settle:
    """How poses are corrected.

    Args:
        iterations: Gauss-Newton steps.
        inner: conjugate gradient steps in each, where more poses of a scene may move than are solved at once.
        stay: cost of a squared metre or radian of correction.
        speed: cost of its squared change from frame to frame.
        bend: cost of its squared second difference.
        root: factor of these costs for moving the whole body.
        lift: further factor for moving it up or down: where hands are to meet, arms reach and feet stay on the floor.
        tilt: factor for turning the whole body or the back.
        shrug: factor for turning the shoulder girdle; infinite: it stays, to 1e-9 radians.
        most: largest change of a step, metres or radians.
        stand: factor for the cost of standing feet that move.
        swing: factor for the cost of toes that swing too low over the floor; 0: they may drag.
        hold: factor for the cost of held hands that part.
        takes: metres between hands that take hold, where hands that met go on holding.
        pull: metres that held hands may be off before they pull no harder: a hand far away shall not jerk the body.
        hard: factor for the cost of what must not be: depth between people, feet over the floor.
    """

    iterations: int = 12
    inner: int = 40
    stay: float = 0.05
    speed: float = 0.3
    bend: float = 1000.0
    root: float = 3.0
    lift: float = 1.0
    tilt: float = 3.0
    shrug: float = math.inf
    most: float = 0.15
    stand: float = 1.0
    swing: float = 0.0
    hold: float = 1.0
    takes: float = HELD
    pull: float = math.inf
    hard: float = 1.0
