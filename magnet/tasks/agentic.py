"""Tasks in which every agent generates its own motion: at once and unseen by the others, or in turns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch

from magnet.checks import require_number, require_wholes
from magnet.sampling.schedule import Grid, MaskSchedule
from magnet.tasks.registry import register_task


@register_task("agentic_sync")
@dataclass(frozen=True)
class AgenticSync:
    """All agents at once, each given everybody's past alone; nobody sees what the others do next (paper 3.3).

    Args:
        block: token steps that an agent plans at a time.
    """

    formula: ClassVar[str] = "P(A_t | A_0:t-1, B_0:t-1) P(B_t | A_0:t-1, B_0:t-1) ..."
    block: int = 1

    def schedule(self, grid: Grid) -> MaskSchedule:
        if grid.context == 0:
            raise ValueError("agentic_sync continues a recording: give it context frames, 4 or more")
        unseen = ~torch.eye(grid.agents, dtype=torch.bool)
        return MaskSchedule.autoregressive(grid.past(), ~grid.past(), grid, self.block, unseen=unseen)


@register_task("agentic_async")
@dataclass(frozen=True)
class AgenticAsync:
    """Agents take turns: each starts a share `offset` of the denoising steps after the one before (paper 3.3).

    Agents that have not started are hidden; those that have started see each other's noisy tokens. By the chain rule
    every offset and order samples the same joint distribution of a turn's tokens.

    Args:
        offset: share of the denoising steps between two agents' starts; 1 waits until the one before is done,
            0 starts all together (paper Table 3: 0, 0.5 and 1).
        order: slots in the order of their turns; slots left out follow in their own order.
        block: token steps of a turn. None: as the model is best sampled (`Sampling.turn`), or 1.
    """

    formula: ClassVar[str] = "P(A_t | A_0:t-1, B_0:t-1) P(B_t | A_0:t, B_0:t-1) ..."
    offset: float = 1.0
    order: tuple[int, ...] = ()
    block: int | None = None

    def schedule(self, grid: Grid) -> MaskSchedule:
        if grid.context == 0:
            raise ValueError("agentic_async continues a recording: give it context frames, 4 or more")
        require_number("offset", self.offset, 0, 1)
        require_wholes("order", self.order)
        if len(set(self.order)) != len(self.order) or not set(self.order) <= set(range(grid.agents)):
            raise ValueError(f"order {self.order}: name each of the agents 0 to {grid.agents - 1} at most once")
        turns = [*self.order, *(p for p in range(grid.agents) if p not in self.order)]
        turn = torch.tensor([turns.index(p) for p in range(grid.agents)])
        delay = turn * round(self.offset * grid.steps)
        block = grid.turn if self.block is None else self.block
        return MaskSchedule.autoregressive(grid.past(), ~grid.past(), grid, block, delay=delay)
