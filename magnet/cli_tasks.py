"""Tasks on the command line: `--task NAME --task.FIELD VALUE`, and the list of them."""

from __future__ import annotations

import dataclasses
import inspect
import sys
from types import ModuleType
from typing import Any

from jsonargparse import Namespace

from magnet.tasks import registry

ALIASES = "magnet.cli_tasks.aliases"


class NamedTask:
    """Base of what stands for each task while a command line is read: a class of the task's fields and its name.

    The parser resolves short names only for subclasses of one base that are imported; tasks share no base, and
    their names are not their classes'.
    """


def aliases() -> dict[str, type]:
    """One stand-in a task, by the task's name; made on first use, for that is when plug-ins are loaded."""
    if ALIASES not in sys.modules:
        module = ModuleType(ALIASES)
        for entry in registry.entries():
            members = {"__module__": ALIASES, "__qualname__": entry.name, "__doc__": entry.task.__doc__}
            setattr(module, entry.name, type(entry.name, (entry.task, NamedTask), members))
        sys.modules[ALIASES] = module
    return {entry.name: getattr(sys.modules[ALIASES], entry.name) for entry in registry.entries()}


def alias_path(name: str) -> str:
    """Class path of a task's stand-in.

    Raises:
        ValueError: no such task; names the closest one.
    """
    short = name.removeprefix(f"{ALIASES}.")
    registry.get(short)
    return f"{ALIASES}.{short}"


def task_of(config: Namespace) -> Any:
    """The task itself from what was parsed.

    Raises:
        ValueError: no such task.
    """
    options = config.as_dict().get("init_args") or {}
    return registry.get(config.class_path.rsplit(".", 1)[-1])(**options)


def list_tasks(arguments: list[str]) -> int:
    """Print a table of all tasks, and the plug-ins that failed to load."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    if arguments and arguments[0] not in ("-h", "--help"):
        from magnet.cli import CommandError

        raise CommandError(f"magnet tasks takes no options, got {' '.join(arguments)}")
    table = Table("task", "what it samples", "options", "from", box=None, header_style="bold", padding=(0, 2, 1, 0))
    for entry in registry.entries():
        first = (inspect.getdoc(entry.task) or "").split("\n\n")[0].replace("\n", " ")
        table.add_row(
            entry.name,
            f"{escape(first)}\n[dim]{escape(str(getattr(entry.task, 'formula', '')))}[/dim]",
            options(entry.task),
            entry.origin,
        )
    console = Console()
    console.print(table)
    for name, error in registry.failures().items():
        console.print(f"[red]{name}[/red] failed to load: {escape(f'{type(error).__name__}: {error}')}")
    console.print("magnet test --task NAME, magnet predict --task NAME; --help explains the options", style="dim")
    return 0


def options(task: type) -> str:
    """Fields with their defaults, as flags."""
    flags = []
    for field in dataclasses.fields(task):
        value = "" if field.default is dataclasses.MISSING else f" {field.default}"
        flags.append(f"--task.{field.name}{value}")
    return "\n".join(flags) or "none"
