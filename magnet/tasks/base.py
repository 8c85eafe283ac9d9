"""What a task is: a small record of options that plans a mask schedule."""

from __future__ import annotations

from typing import ClassVar, Protocol, runtime_checkable

from magnet.sampling.schedule import Grid, MaskSchedule


@runtime_checkable
class Task(Protocol):
    """Plans which tokens are known, which are generated, and in what order.

    A task is a frozen dataclass: its fields are its command-line options, its docstring their help. It
    sees sizes only, never motion, so it cannot leak.
    """

    formula: ClassVar[str]  # the distribution it samples, e.g. P(A_0:L | B_0:L)

    def schedule(self, grid: Grid) -> MaskSchedule:
        """The plan on a grid of token steps and agents.

        Raises:
            ValueError: the task makes no sense on this grid (says why).
        """
        ...
