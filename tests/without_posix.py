"""`python -m tests.without_posix ARGUMENTS`: the command where what only POSIX has is not there, as on Windows.

Several commands in one process have THEN between them, and the last one's exit code.
"""

import builtins
import io
import itertools
import os
import signal
import sys
from pathlib import Path
from typing import Any, NoReturn

import lightning.pytorch  # noqa: F401  # packages of others know by themselves where they are
import torch  # noqa: F401


def take_away() -> None:
    """Modules, signals and functions that only POSIX has; links; folders opened as files; /proc."""
    for name in ("fcntl", "grp", "pwd", "resource", "termios", "tty"):
        sys.modules[name] = None  # type: ignore[assignment]  # so that its import fails
    for module, names in (
        (signal, ("SIGHUP", "SIGALRM")),
        (os, ("sched_getaffinity", "killpg", "mkfifo")),
    ):
        for name in names:
            delattr(module, name)

    def no_link(*_: Any, **__: Any) -> NoReturn:
        raise OSError(22, "A required privilege is not held by the client")

    open_handle, open_file = os.open, builtins.open

    def no_folder(path: Any, *rest: Any, **more: Any) -> int:
        ours = "magnet" in Path(sys._getframe(1).f_code.co_filename).parts  # others have ways of their own there
        if ours and os.path.isdir(path):
            raise PermissionError(13, "Permission denied", str(path))
        return open_handle(path, *rest, **more)

    def no_proc(path: Any, *rest: Any, **more: Any) -> Any:
        if str(path).startswith("/proc/"):
            raise FileNotFoundError(2, "No such file or directory", str(path))
        return open_file(path, *rest, **more)

    os.symlink, os.open = no_link, no_folder  # type: ignore[assignment]
    builtins.open = io.open = no_proc


if __name__ == "__main__":
    from magnet.cli import main

    take_away()
    several = [list(words) for then, words in itertools.groupby(sys.argv[1:], "THEN".__eq__) if not then]
    sys.exit([main(words) for words in several][-1])
