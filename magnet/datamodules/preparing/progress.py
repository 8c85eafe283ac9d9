"""A bar of what is being done and how long it will take, for what takes minutes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


def on_a_terminal() -> dict[str, Any]:
    """Options of a bar: elsewhere it would leave an empty line in front of what is said."""
    from rich.console import Console

    console = Console(stderr=True)
    return {"console": console, "transient": True, "disable": not console.is_terminal}


@contextmanager
def progress_bar() -> Iterator[Callable[[str, int, int], None]]:
    """Something to call with what is being done, how much is done, and how much there is."""
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (BarColumn(), TaskProgressColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
    with Progress(*columns, **on_a_terminal()) as progress:
        task = progress.add_task("", total=None)
        yield lambda what, done, total: progress.update(task, description=what, completed=done, total=total)
