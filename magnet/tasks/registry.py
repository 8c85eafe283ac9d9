"""Which tasks exist: ours, and those of installed packages (entry-point group `magnet.tasks`)."""

from __future__ import annotations

import difflib
import importlib
import os
import re
from collections.abc import Callable
from dataclasses import dataclass, is_dataclass
from importlib.metadata import entry_points
from typing import TypeVar

GROUP = "magnet.tasks"
VARIABLE = "MAGNET_TASKS"
BUILT_IN = ("magnet.tasks.joint", "magnet.tasks.partner", "magnet.tasks.agentic", "magnet.tasks.inbetweening")

T = TypeVar("T", bound=type)


@dataclass(frozen=True)
class Registered:
    """A task and where it came from."""

    name: str
    task: type
    origin: str


known_tasks: dict[str, Registered] = {}
failed_plugins: dict[str, Exception] = {}
_discovered = False


def register_task(name: str, origin: str = "magnet") -> Callable[[T], T]:
    """Class decorator that makes a task known under a name.

    Raises:
        TypeError: not a dataclass with a `schedule` method and a `formula`.
        ValueError: the name is taken by another class.
    """

    def register(task: T) -> T:
        _add(name, task, origin)
        return task

    return register


def _add(name: str, task: type, origin: str) -> None:
    missing = [part for part in ("schedule", "formula") if not hasattr(task, part)]
    if not is_dataclass(task) or missing:
        what = f"has no {' and no '.join(missing)}" if missing else "is not a dataclass"
        raise TypeError(f"task {name}: {task!r} {what}; see docs/tasks.md")
    known = known_tasks.get(name)
    if known is not None and known.task is not task:
        raise ValueError(f"task name {name} is taken by {known.task.__module__}.{known.task.__qualname__}")
    known_tasks[name] = Registered(name, task, origin)


def discover(again: bool = False) -> None:
    """Load all tasks once. A plug-in that fails is kept in `failures` and hides no other."""
    global _discovered
    if _discovered and not again:
        return
    _discovered = True
    for module in BUILT_IN:
        importlib.import_module(module)
    for point in entry_points(group=GROUP):
        origin = f"{point.dist.name} {point.dist.version}" if point.dist else point.value
        _load(point.name, point.load, origin)
    for value in filter(None, os.environ.get(VARIABLE, "").split(",")):
        _load_variable(value.strip())


def _load_variable(value: str) -> None:
    """`package.module:Class`, or `package.module`, whose tasks have registered themselves."""
    module, _, name = value.partition(":")
    origin = f"{VARIABLE}={value}"
    if name:
        _load(snake_case(name), lambda: getattr(importlib.import_module(module), name), origin)
        return
    before = set(known_tasks)
    try:
        importlib.import_module(module)
        own = [entry.name for entry in known_tasks.values() if entry.task.__module__.startswith(module)]
        if not own:
            raise ValueError(f"{module} registers no task: write {VARIABLE}={module}:Class, or decorate the class")
    except Exception as error:  # a stranger's import may raise anything
        failed_plugins[module] = error
        return
    for name in {*own, *(set(known_tasks) - before)}:
        known_tasks[name] = Registered(name, known_tasks[name].task, origin)


def snake_case(name: str) -> str:
    """A class's name as a task's: PushHands -> push_hands, VRPartner -> vr_partner."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name).lower()


def _load(name: str, load: Callable[[], type], origin: str) -> None:
    try:
        task = load()
        own = [entry.name for entry in known_tasks.values() if entry.task is task]
        for known in own:  # it has registered itself with the decorator, which does not know where from
            known_tasks[known] = Registered(known, task, origin)
        if not own:
            _add(name, task, origin)
    except Exception as error:  # a stranger's import may raise anything
        failed_plugins[name] = error


def names() -> list[str]:
    """Names of all tasks."""
    discover()
    return sorted(known_tasks)


def entries() -> list[Registered]:
    """All tasks with their origins, by name."""
    discover()
    return [known_tasks[name] for name in sorted(known_tasks)]


def get(name: str) -> type:
    """The class of a task.

    Raises:
        ValueError: no such task; suggests the closest name, or says why a plug-in of that name failed.

    >>> from magnet.sampling.schedule import Grid
    >>> task = get("partner_inpainting")(target=(1,))
    >>> task.schedule(Grid(tokens=3, agents=2, context=0)).known  # (token, agent): agent 0 is given, agent 1 is made
    tensor([[ True, False],
            [ True, False],
            [ True, False]])
    """
    discover()
    if not isinstance(name, str):
        raise ValueError(f"task: got {name!r}, expected a name: {', '.join(sorted(known_tasks))}")
    if name in known_tasks:
        return known_tasks[name].task
    if name in failed_plugins:
        raise ValueError(f"task {name} failed to load: {failed_plugins[name]!r}") from failed_plugins[name]
    close = difflib.get_close_matches(name, known_tasks, n=1)
    hint = f"; did you mean {close[0]}?" if close else "."
    raise ValueError(f"no task named {name}{hint} There are {', '.join(sorted(known_tasks))}.")


def failures() -> dict[str, Exception]:
    """Plug-ins that could not be loaded, with the error of each."""
    discover()
    return dict(failed_plugins)
