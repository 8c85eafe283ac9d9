"""How far work is that takes minutes, with the time left: a bar on a terminal, elsewhere a line now and then."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

Tell = Callable[[str, int, int | None], None]
"""Shows what is being done, the amount done, and the total where it is known."""
SECONDS = 15.0
"""Between two lines, where no terminal shows a bar."""


class Lines:
    """Says how far work is in a plain line now and then, also while one long part of it goes on.

    Args:
        seconds: between two lines.
    """

    def __init__(self, seconds: float) -> None:
        self.seconds, self.over, self.lock = seconds, threading.Event(), threading.Lock()
        self.what, self.done = "", 0
        self.total: int | None = None
        self.begun: tuple[float, int] | None = None  # when this work began, and how much was done by then
        self.at = 0.0  # when it was last told of

    def tell(self, what: str, done: int, total: int | None) -> None:
        """Keep what the next line says; another total, or less that is done, is other work."""
        with self.lock:
            self.at = time.monotonic()
            if self.begun is None or total != self.total or done < self.done:
                self.begun = self.at, done
            self.what, self.done, self.total = what, done, total

    def line(self) -> str:
        """What is to be said now."""
        assert self.begun is not None
        now, (begun, first) = time.monotonic(), self.begun
        if not self.total:
            return f"at work for {now - begun:.0f} s; {self.what}"
        said = f"{100 * self.done // self.total} % done"
        if self.done > first:
            left = (self.at - begun) * (self.total - self.done) / (self.done - first) - (now - self.at)
            return f"{said}, {f'about {left:.0f} s' if left >= 1 else 'little'} left; {self.what}"
        return f"{said} after {now - begun:.0f} s; {self.what}"

    def run(self) -> None:
        """Print, until the work is over or nobody reads."""
        while not self.over.wait(self.seconds):
            if self.begun is None:
                continue
            try:
                with self.lock:
                    said = self.line()
                print(said, file=sys.stderr, flush=True)
            except (OSError, ValueError):  # closed
                return


@contextmanager
def lines() -> Iterator[Tell]:
    """Yields what says how far work is, in lines on the error stream."""
    said = Lines(SECONDS)
    thread = threading.Thread(target=said.run, daemon=True)
    thread.start()
    try:
        yield said.tell
    finally:
        said.over.set()
        thread.join()


@contextmanager
def bar_with(*columns: Any) -> Iterator[Tell]:
    """Yields what moves a bar with these columns of rich; or, where no terminal is, what says the same in lines."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    console = Console(stderr=True)
    if not console.is_terminal:
        with lines() as tell:
            yield tell
        return
    shown = (BarColumn(), *columns, TextColumn("{task.description}"))
    with Progress(*shown, console=console, transient=True) as progress:
        task = progress.add_task("", total=None)
        yield lambda what, done, total: progress.update(task, description=what, completed=done, total=total)


def progress_bar() -> AbstractContextManager[Tell]:
    """A bar with the share that is done and the time left."""
    from rich.progress import TaskProgressColumn, TimeRemainingColumn

    return bar_with(TaskProgressColumn(), TimeRemainingColumn())
