"""Files that a command line names: those that are not there, and paths with spaces that were not put in quotes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from os.path import exists  # Path's fails at words that are too long for a name, or in a folder that is locked
from pathlib import Path

from magnet.cli.errors import CommandError

READ = (".npz", ".pkl", ".pt", ".bvh", ".glb", ".gltf", ".vrm", ".vrma", ".fbx", ".csv")
"""`magnet.export.reading.READ`, which would import torch."""
MOST_PIECES = 6
"""Pieces that a path with spaces may have come in."""
QUOTES = "a path with spaces needs quotes"


def unquoted(arguments: Sequence[str]) -> str:
    """The end of an error's sentence where neighbouring words together are a path that is there; else nothing."""
    for words in runs(arguments):
        there = [exists(word) for word in words]
        for first in range(len(words)):
            for stop in range(first + 2, min(first + MOST_PIECES, len(words)) + 1):
                whole = " ".join(words[first:stop])
                if not all(there[first:stop]) and exists(whole):
                    return f'; {whole} is there: {QUOTES}, "{whole}"'
    return ""


def runs(arguments: Sequence[str]) -> Iterator[list[str]]:
    """Words that stand side by side, without a flag between them; what is behind its `=` is a word."""
    words: list[str] = []
    for argument in [*arguments, "--"]:
        if argument.startswith("-"):
            yield words
            value = argument.partition("=")[2]
            words = [value] if value else []
        else:
            words.append(argument)


def require_there(paths: Sequence[str]) -> None:
    """Refuse files to read that are not there; of those of other kinds the reader says what it reads."""
    missing = [path for path in paths if not Path(path).exists() and Path(path).suffix.lower() in (*READ, "")]
    if missing:
        pieces = any(not Path(path).exists() and Path(path).suffix.lower() not in READ for path in paths)
        hint = f"; {QUOTES}" if pieces and len(paths) > 1 and not unquoted(paths) else ""
        raise CommandError(f"{missing[0]}: no such file{hint}")


def require_whole(outs: Sequence[str]) -> None:
    """Refuse a file to write that may be a piece of a path: one without a suffix, and another behind it."""
    for out, behind in pairwise(outs):
        if not Path(out).suffix:
            whole = f'--out "{out} {behind}"'
            raise CommandError(f"--out {out}: has no suffix, which says what is written; {QUOTES}, {whole}")
