"""What a task is: a small record of options that plans a mask schedule; and how it is asked for its plan."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar, Protocol, runtime_checkable

from magnet.plugins import attempted, told
from magnet.sampling.options import SamplerOptions
from magnet.sampling.schedule import Grid, MaskSchedule
from magnet.tasks.registry import get, name_of

SMALL = Grid(tokens=14, agents=2, context=4, steps=6, window=8, stride=4)
"""What a task is tried on, as `magnet tasks show` draws it."""


class TaskError(ValueError):
    """A task's own code fails, or gives something else than a plan."""


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


def task_of(name: str, said: Mapping[str, Any]) -> Task:
    """A task by its name, with what is said of its fields.

    Raises:
        ValueError: no such task or field, with those that there are, or none of a field that it needs.
    """
    kind = get(name)
    known = [each.name for each in dataclasses.fields(kind)]
    for field in said:
        if field not in known:
            has = f"it has {', '.join(known)}" if known else "it has none"
            of_sampling = field in ("sampler", *(each.name for each in dataclasses.fields(SamplerOptions)))
            hint = "; how to sample is said of the model: magnet.load(name, sampler=...)" if of_sampling else ""
            raise ValueError(f"task {name} has no field {field}; {has}{hint}")
    if lacking := [name for name in needed(kind) if name not in said]:
        unsaid = f"which {'is' if len(lacking) == 1 else 'are'} not given"
        raise ValueError(f"task {name} needs {' and '.join(lacking)}, {unsaid}")
    task: Task = kind(**said)
    return task


def needed(kind: type) -> list[str]:
    """The fields of a task that have no value by default."""
    missing, fields = dataclasses.MISSING, dataclasses.fields(kind)
    return [each.name for each in fields if each.init and each.default is missing and each.default_factory is missing]


def schedule_of(task: Task, grid: Grid) -> MaskSchedule:
    """A task's plan on a grid, of a stranger's task as of ours.

    Raises:
        ValueError: the task makes no sense on this grid, as it says itself.
        TaskError: its code raises anything else, or gives no plan; names the task.
    """
    given: list[object] = []
    error = attempted(lambda: given.append(task.schedule(grid)))
    if isinstance(error, ValueError):
        raise error
    name = name_of(type(task))
    if error is not None:
        raise TaskError(f"task {name}: schedule(grid) fails: {told(error)}; see docs/tasks.md") from error
    (plan,) = given
    if not isinstance(plan, MaskSchedule):
        what = "None" if plan is None else type(plan).__name__
        raise TaskError(f"task {name}: schedule(grid) gave {what}, expected a MaskSchedule; see docs/tasks.md")
    return plan


def fault_of(kind: type[Task]) -> str | None:
    """What is wrong with a task's code, by a plan on `SMALL`; None: nothing, or it needs options or another grid."""
    if needed(kind):
        return None
    error = attempted(lambda: schedule_of(kind(), SMALL))
    if error is None or (isinstance(error, ValueError) and not isinstance(error, TaskError)):
        return None
    return str(error) if isinstance(error, TaskError) else f"task {name_of(kind)}: {told(error)}"
