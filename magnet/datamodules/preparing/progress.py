"""A progress bar with the time left, for work that takes minutes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

Tell = Callable[[str, int, int | None], None]
"""Shows what is being done, the amount done, and the total where it is known."""


@contextmanager
def bar_with(*columns: Any) -> Iterator[Tell]:
    """Yields what moves a bar with these columns of rich; on a terminal only, for a file would keep an empty line."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    console = Console(stderr=True)
    shown = (BarColumn(), *columns, TextColumn("{task.description}"))
    with Progress(*shown, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("", total=None)
        yield lambda what, done, total: progress.update(task, description=what, completed=done, total=total)


def progress_bar() -> AbstractContextManager[Tell]:
    """A bar with the share that is done and the time left."""
    from rich.progress import TaskProgressColumn, TimeRemainingColumn

    return bar_with(TaskProgressColumn(), TimeRemainingColumn())
