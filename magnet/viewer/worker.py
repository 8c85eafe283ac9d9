"""A thread that generates a live scene slightly ahead of the shown frame."""

from __future__ import annotations

import threading
from collections.abc import Callable

from magnet.generation.live import Live, LiveChunk


class Worker:
    """Runs `Live.advance` in a thread, at most `ahead` frames ahead of the shown frame.

    Requests (`Live.asked`) are served at once, also while `paused`.

    Args:
        live: the engine.
        ahead: frames; fewer react sooner to steering, more bridge slow moments.
        failed: called with a message when the task refuses; the worker then waits for `wake`.
        done: called with each chunk.
    """

    def __init__(
        self,
        live: Live,
        ahead: int = 32,
        failed: Callable[[str], None] | None = None,
        done: Callable[[LiveChunk], None] | None = None,
    ) -> None:
        self.live, self.ahead, self.failed, self.done = live, ahead, failed, done
        self.watched = 0
        self.paused = False
        self._wake, self._stop = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="magnet-live", daemon=True)

    def start(self) -> Worker:
        self._thread.start()
        return self

    def watch(self, frame: int) -> None:
        """Set the frame that is shown."""
        self.watched = frame
        self._wake.set()

    def wake(self) -> None:
        """Try again after settings have changed."""
        self._wake.set()

    def stop(self) -> None:
        """End the thread."""
        self._stop.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(timeout=10)

    def _run(self) -> None:
        while not self._stop.is_set():
            waits = self.paused or self.live.scene.frames - self.watched > self.ahead
            if waits and not self.live.asked:
                self._wake.wait(timeout=0.5)
                self._wake.clear()
                continue
            try:
                chunk = self.live.advance()
                if self.done is not None:
                    self.done(chunk)
            except Exception as error:  # whatever a task or its options raise: the page says so, and goes on
                if self.failed is not None:
                    self.failed(said(error))
                self._wake.clear()
                self._wake.wait(timeout=2.0)


def said(error: Exception) -> str:
    """What a page says of an error: our own words, or those of others with the error's name."""
    return str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
