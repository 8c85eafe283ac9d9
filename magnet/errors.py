"""Errors that many rooms know, a file that somebody else made and the end of the process; and how users are told."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence

PACKAGE = __name__.partition(".")[0]


def warn_user(message: str) -> None:
    """Warn as of the line that called into this package, through however many of its functions it got here."""
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] == PACKAGE:
        level, frame = level + 1, frame.f_back
    warnings.warn(message, stacklevel=level)


def counted(number: int, what: str) -> str:
    """As "1 scene", "2 scenes"."""
    return f"{number} {what}{'s' * (number != 1)}"


def first_names(names: Sequence[str], most: int) -> str:
    """The first of many names, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


class DataError(ValueError):
    """A file that is not what its layout says; names the file, what was found and what to do."""


class Stopped(SystemExit):
    """A signal has ended the command; code of others that exits does not raise it, and nothing may go on after it."""
