"""A command that is run to its end, for scripts that run several of them."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Sequence
from pathlib import Path

PASSED_ON = (signal.SIGINT, signal.SIGTERM)


def run_to_its_end(command: Sequence[str], folder: Path) -> int:
    """Run a command and wait for it, whatever happens meanwhile.

    SIGINT (Ctrl+C) and SIGTERM go to it, once each time, and not to who waits: so a training saves its checkpoint
    before it ends, and none is left behind that nobody knows of.

    Args:
        command: program and arguments.
        folder: it runs there.

    Returns:
        Its exit code; 128 and the signal's number where a signal ended it, as a shell says it.
    """
    child = subprocess.Popen(command, cwd=folder, process_group=0)  # so that Ctrl+C comes to it once, from here
    before = {number: signal.signal(number, lambda which, frame: child.send_signal(which)) for number in PASSED_ON}
    try:
        code = child.wait()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    return code if code >= 0 else 128 - code
