"""Tasks that generate everybody at once."""

from dataclasses import dataclass
from typing import ClassVar

from magnet.sampling.schedule import Grid, MaskSchedule
from magnet.tasks.registry import register_task


@register_task("joint_future")
@dataclass(frozen=True)
class JointFuture:
    """All agents' futures from all agents' pasts, every agent at a time step at one noise level (A.6.2)."""

    formula: ClassVar[str] = "P(A_t:t+L, B_t:t+L, ... | A_0:t-1, B_0:t-1, ...)"

    def schedule(self, grid: Grid) -> MaskSchedule:
        if grid.context == 0:
            raise ValueError(
                "joint_future continues a recording: give it context frames, 4 or more, or use the task generation"
            )
        return MaskSchedule.full_sequence(grid.past(), ~grid.past(), grid)


@register_task("generation")
@dataclass(frozen=True)
class Generation:
    """Whole scenes from nothing: full-sequence denoising of the first window, then its continuation."""

    formula: ClassVar[str] = "P(A_0:L, B_0:L, ...)"

    def schedule(self, grid: Grid) -> MaskSchedule:
        nothing = grid.mask()
        return MaskSchedule.full_sequence(nothing, ~nothing, grid)
