"""Where a command's output goes: a pipe that nobody reads any more, such as `| head`, or one without some letters."""

from __future__ import annotations

import contextlib
import io
import os
import select
import sys

CLOSED = 141
"""The exit code of a command that stopped because its output was closed: 128 + SIGPIPE."""


def replace_closed() -> None:
    """Let what is written to outputs that were closed at the start go nowhere: Python has None in their place."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, io.TextIOWrapper(io.FileIO(os.devnull, "w"), encoding="utf-8"))


def take_any_letter(*streams: object) -> None:
    """Write a question mark for letters that a stream does not know, such as arrows in a file on Windows.

    UTF-8 knows all but the bytes in names of files that are of no encoding.
    """
    for stream in streams:
        if not isinstance(stream, io.TextIOWrapper):
            continue
        if stream.errors == "strict" or not stream.encoding.lower().startswith("utf"):
            stream.reconfigure(errors="replace")


def output_closed() -> bool:
    """Whether stdout or stderr leads into a pipe that nobody reads; what is written there from now on is dropped."""
    return any([_dropped(stream) for stream in (sys.stdout, sys.stderr)])


def _dropped(stream: object) -> bool:
    # A stream may be none, or no file of the system, as in a notebook; and Windows cannot poll.
    with contextlib.suppress(AttributeError, OSError, ValueError):
        number = stream.fileno()  # type: ignore[attr-defined]
        poll = select.poll()
        poll.register(number, 0)
        if any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0)):
            drop(stream)
            return True
    return False


def drop(stream: object) -> None:
    """Let what is written to a file of the system from now on go nowhere, and what waits to be written."""
    number = stream.fileno()  # type: ignore[attr-defined]
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, number)
    os.close(nowhere)
