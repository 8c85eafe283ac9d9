"""How processes that convert takes begin and end: Ctrl+C is told to the one that started them alone."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager


@contextmanager
def unheard_ctrl_c() -> Iterator[None]:
    """Processes that are started within it never hear Ctrl+C, which this thread hears behind it."""
    if not hasattr(signal, "pthread_sigmask"):  # on Windows they hear it
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def ended_at_once(pool: Executor) -> Iterator[None]:
    """Within it processes of a pool are used; where that is not done to the end, as by Ctrl+C, they are killed.

    Else it would be waited for all that they are at.
    """
    others = set(multiprocessing.active_children())
    try:
        yield
    except BaseException:
        for each in set(multiprocessing.active_children()) - others:
            each.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
