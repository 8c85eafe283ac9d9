"""Errors that many rooms know: a file that somebody else made, and the end of the process."""

from __future__ import annotations


class DataError(ValueError):
    """A file that is not what its layout says; names the file, what was found and what to do."""


class Stopped(SystemExit):
    """A signal has ended the command; code of others that exits does not raise it, and nothing may go on after it."""
