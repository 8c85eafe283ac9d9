"""A task for magnet in a package of its own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from magnet.sampling.schedule import Grid, MaskSchedule
from magnet.tasks.inbetweening import toward_keys


@dataclass(frozen=True)
class Duel:
    """Continue one agent, given everything of the others and where it ends up itself.

    Args:
        target: slot of the agent to continue.
        ending: token steps at the end of which its motion is given; a token is 4 frames.
    """

    formula: ClassVar[str] = "P(A_t:L-1 | A_0:t-1, A_L, B_0:L, ...)"
    target: int = 0
    ending: int = 1

    def schedule(self, grid: Grid) -> MaskSchedule:
        if not 0 <= self.target < grid.agents or grid.agents < 2:
            raise ValueError(f"target {self.target}: the grid has {grid.agents} agents, and a duel needs two")
        if grid.context == 0:
            raise ValueError("duel continues a recording: give it context frames")
        if not 0 < self.ending < grid.tokens - grid.context:
            left = grid.tokens - grid.context
            raise ValueError(f"ending {self.ending}: {left} token steps follow the past, leave some to generate")
        known = grid.past()
        known[:, [p for p in range(grid.agents) if p != self.target]] = True
        known[-self.ending :] = True
        return toward_keys(known, grid)
