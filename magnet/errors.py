"""What is wrong with a file that somebody else made."""

from __future__ import annotations


class DataError(ValueError):
    """A file that is not what its layout says; names the file, what was found and what to do."""
