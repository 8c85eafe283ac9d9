"""Checkpoints by name: which one an option means, and which there are, for messages that say which to name."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path

from magnet import checkpoints
from magnet.cli.errors import CommandError

RUNS = Path("runs")
"""Where runs lie unless something else is said."""
NAMED = 3
"""So many are named at most."""


def checkpoint_of(name: str | None, option: str = "--ckpt_path") -> Path:
    """The checkpoint that an option names; where it is `last` or `best` of the runs here, a line says which that is."""
    return say_which(name, find_checkpoint(name, [RUNS], option=option), option)


def find_checkpoint(
    name: str | None, folders: Iterable[Path], runs: Path | None = None, option: str = "--ckpt_path"
) -> Path:
    """What an option means: a path, `last` or `best` of the newest run in `folders`, or shipped weights by name."""
    if name in ("last", "best"):
        folders = list(folders)
        found = [file for folder in folders for file in folder.glob(f"**/checkpoints/{name}.ckpt")]
        if not found:
            raise CommandError(no_run(name, folders, runs, option))
        return max(found, key=lambda file: file.stat().st_mtime)
    try:
        return checkpoints.resolve(name)
    except ValueError as error:
        if name is None:
            raise CommandError("no weights come with this version: train a model, then give --ckpt_path") from error
        raise CommandError(str(error)) from error


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
    """Says that no run in `folders` has a checkpoint `name`, and which checkpoints there are: there, else in `runs`."""
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


def say_which(name: str | None, found: Path, option: str = "--ckpt_path") -> Path:
    """The checkpoint that was found, of which a line says which it is where `last` or `best` was asked for."""
    if name in ("last", "best"):
        print(f"magnet: {option} {name} is {found}", file=sys.stderr)
    return found
