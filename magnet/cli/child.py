"""A command that is run to its end, for scripts that run several of them."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Sequence
from pathlib import Path

PASSED_ON: dict[int, int] = {signal.SIGINT: signal.SIGINT, signal.SIGTERM: signal.SIGTERM}
if hasattr(signal, "SIGHUP"):  # not on Windows
    PASSED_ON[signal.SIGHUP] = signal.SIGTERM
"""What who waits gets, and what it sends on: where a terminal is closed, a command is to save before it ends."""


def run_to_its_end(command: Sequence[str], folder: Path) -> int:
    """Run a command and wait for it, whatever happens meanwhile.

    SIGINT (Ctrl+C) and SIGTERM go to it, once each time, and not to who waits, and where the terminal is closed it gets
    SIGTERM: so a training saves its checkpoint before it ends, and none is left behind that nobody knows of. What was
    ignored before (SIGHUP by nohup) stays so.

    Args:
        command: program and arguments.
        folder: it runs there.

    Returns:
        Its exit code; 128 and the signal's number where a signal ended it, as a shell says it.
    """
    begun: list[subprocess.Popen[bytes]] = []
    early: list[int] = []  # what came before the command was there to get it

    def send(which: int, frame: object) -> None:
        if begun:
            begun[0].send_signal(PASSED_ON[which])
        else:
            early.append(which)

    heeded = [number for number in PASSED_ON if signal.getsignal(number) != signal.SIG_IGN]
    before = {number: signal.signal(number, send) for number in heeded}
    try:
        begun.append(subprocess.Popen(command, cwd=folder, process_group=0))  # Ctrl+C comes to it once, from here
        for which in early:
            send(which, None)
        code = begun[0].wait()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    return code if code >= 0 else 128 - code
