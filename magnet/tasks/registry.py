"""Which tasks exist: ours, and those of installed packages (entry-point group `magnet.tasks`)."""

from __future__ import annotations

import difflib
import importlib
import os
import re
from collections.abc import Callable
from dataclasses import is_dataclass
from typing import TypeVar

from magnet.plugins import Failed, Registered, Registry, attempted, look_here

VARIABLE = "MAGNET_TASKS"

T = TypeVar("T", bound=type)


def _check(name: str, task: type) -> None:
    if "." in name:
        better = snake_case(name.replace(".", "_"))
        raise ValueError(f"task {name}: what stands before a point would be a module; call it {better}")
    missing = [part for part in ("schedule", "formula") if not hasattr(task, part)]
    if not is_dataclass(task) or missing:
        what = f"has no {' and no '.join(missing)}" if missing else "is not a dataclass"
        raise TypeError(f"task {name}: {task!r} {what}; see docs/tasks.md")


TASKS = Registry(
    "task",
    "magnet.tasks",
    ("magnet.tasks.joint", "magnet.tasks.partner", "magnet.tasks.agentic", "magnet.tasks.inbetweening"),
    _check,
)


def register_task(name: str, origin: str = "magnet") -> Callable[[T], T]:
    """Class decorator that makes a task known under a name.

    Raises:
        TypeError: not a dataclass with a `schedule` method and a `formula`.
        ValueError: the name is taken by another class.
    """

    def register(task: T) -> T:
        TASKS.add(name, task, origin)
        return task

    return register


def discover(again: bool = False) -> None:
    """Load all tasks, once: ours, those of packages, and those that the variable MAGNET_TASKS names."""
    TASKS.discover(again, _load_variables)


def _load_variables() -> None:
    for value in filter(None, os.environ.get(VARIABLE, "").split(",")):
        _load_variable(value.strip())


def _load_variable(value: str) -> None:
    """`package.module:Class`, or `package.module`, whose tasks have registered themselves; also of this folder."""
    module, _, name = value.partition(":")
    if module:
        look_here(module)
    origin = f"{VARIABLE}={value}"
    if name:
        TASKS.load(snake_case(name), lambda: getattr(importlib.import_module(module), name), origin)
        return
    before = set(TASKS.known)
    error = attempted(lambda: importlib.import_module(module))
    own = [entry.name for entry in TASKS.known.values() if f"{entry.kind.__module__}.".startswith(f"{module}.")]
    if error is None and not own:
        error = ValueError(f"{module} registers no task: write {VARIABLE}={module}:Class, or decorate the class")
    if error is not None:
        TASKS.fail(module, error, origin)
        return
    for name in {*own, *(set(TASKS.known) - before)}:
        TASKS.add(name, TASKS.known[name].kind, origin)


def snake_case(name: str) -> str:
    """A class's name as a task's: PushHands -> push_hands, VRPartner -> vr_partner."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name).lower()


def names() -> list[str]:
    """Names of all tasks."""
    discover()
    return sorted(TASKS.known)


def entries() -> list[Registered]:
    """All tasks with their origins, by name."""
    discover()
    return [TASKS.known[name] for name in sorted(TASKS.known)]


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
        raise ValueError(f"task: got {name!r}, expected a name: {', '.join(sorted(TASKS.known))}")
    if name in TASKS.known:
        return TASKS.known[name].kind
    TASKS.require_loaded(name)
    close = difflib.get_close_matches(name, TASKS.known, n=1)
    hint = f"; did you mean {close[0]}?" if close else "."
    raise ValueError(f"no task named {name}{hint} There are {', '.join(sorted(TASKS.known))}.")


def name_of(kind: type) -> str:
    """The name of a task's class; that of the class itself where it is not registered."""
    return next((entry.name for entry in TASKS.known.values() if entry.kind is kind), kind.__name__)


def failures() -> list[Failed]:
    """Plug-ins that could not be loaded, with the error of each."""
    discover()
    return list(TASKS.failed)
