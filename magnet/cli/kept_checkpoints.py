"""Which checkpoints there are, for messages that say which one to name."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path

NAMED = 3
"""So many are named at most."""


def written(path: Path) -> float:
    """When, for the newest of several; a file that is taken away meanwhile is the oldest."""
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


def newest(place: Path) -> Path | None:
    """The newest checkpoint in a folder of them."""
    return max(place.glob("*.ckpt"), key=written, default=None)


def no_run(name: str, folders: Iterable[Path], runs: Path | None, option: str = "--ckpt_path") -> str:
    """Says that no run has a checkpoint `name`, and which checkpoints there are: there, else anywhere.

    Args:
        name: last or best.
        folders: where it was looked for.
        runs: where all runs lie.
        option: that asked for it.
    """
    places = list(dict.fromkeys(folders))
    looked = " or ".join(map(str, places))
    there = newest_of_runs(places) or newest_of_runs([runs] if runs else [])
    which = f"the newest {'are' if len(there) > 1 else 'is'} {', '.join(map(str, there))}" if there else ""
    advice = f"name a file; {which}" if which else "name a file"
    return f"{option} {name}: no run with a checkpoints/{name}.ckpt in {looked}; {advice}"


def newest_of_runs(folders: Iterable[Path]) -> list[Path]:
    """The newest checkpoint of each of the newest runs in some folders."""
    places = {place for folder in folders for place in folder.glob("**/checkpoints")}
    files = [file for place in places if (file := newest(place)) is not None]
    return sorted(files, key=written, reverse=True)[:NAMED]


def told(name: str | None, found: Path, option: str = "--ckpt_path") -> Path:
    """The checkpoint that was found, of which a line says which it is where `last` or `best` was asked for."""
    if name in ("last", "best"):
        print(f"magnet: {option} {name} is {found}", file=sys.stderr)
    return found
