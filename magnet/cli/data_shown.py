"""What `magnet data` shows: tables of splits, takes that were skipped, progress."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from magnet.datamodules.clip import Split

SKIPPED_SHOWN = 20
PROBLEMS_SHOWN = 40
PERSONS_SHOWN = 8
NOTES_SHOWN = 8


def show_splits(rows: list[tuple[str, ...]], title: str | None = None) -> None:
    """The table of splits."""
    from rich.console import Console
    from rich.table import Table

    heads = ("split", "takes", "clips", "frames", "minutes", "shards")
    table = Table(*heads[: len(rows[0])], title=title, title_justify="left", header_style="bold")
    for row in rows:
        table.add_row(*row)
    Console().print(table)


def show_skipped(skipped: list[tuple[str, str]]) -> None:
    """Takes that were not used, and why."""
    if not skipped:
        return
    print(f"skipped {len(skipped)} takes:")
    for take, why in skipped[:SKIPPED_SHOWN]:
        print(f"  {take}: {why}")
    if len(skipped) > SKIPPED_SHOWN:
        print(f"  ... and {len(skipped) - SKIPPED_SHOWN} more, all of them in the store's manifest.json")


def clips_by_people(manifest: Mapping[str, Any]) -> dict[Split, dict[int, int]]:
    """Clips of each split of a store by number of people."""
    splits = manifest["splits"].items()
    return {split: {int(n): count for n, count in of["clips by people"].items()} for split, of in splits}


def show_gaps(clips: Mapping[Split, Mapping[int, int]]) -> None:
    """Warn of what the splits lack, on the error stream."""
    from magnet.datamodules.preparing.split_gaps import split_gaps

    for line in split_gaps(clips):
        print(f"WARNING: {line}", file=sys.stderr)


def show_notes(notes: list[str]) -> None:
    """Notes; of many that differ in numbers alone only the first ones."""
    alike: dict[str, int] = {}
    for note in notes:
        kind = re.sub(r"[\d.]+", "#", note)
        alike[kind] = alike.get(kind, 0) + 1
        if alike[kind] <= NOTES_SHOWN:
            print(f"note: {note}")
    for kind, count in alike.items():
        if count > NOTES_SHOWN:
            print(f"  ... and {count - NOTES_SHOWN} more like: {kind}")


def show_problems(problems: list[str]) -> None:
    """Assertions that do not hold, on the error stream."""
    for problem in problems[:PROBLEMS_SHOWN]:
        print(f"PROBLEM: {problem}", file=sys.stderr)
    if len(problems) > PROBLEMS_SHOWN:
        print(f"  ... and {len(problems) - PROBLEMS_SHOWN} more", file=sys.stderr)


def show_persons(groups: list[tuple[list[str], int]]) -> None:
    """Names or roles of people who were recorded together, the most frequent first."""
    for names, takes in sorted(groups, key=lambda group: -group[1])[:PERSONS_SHOWN]:
        print(f"people: {' | '.join(names)} ({takes} takes)")
    if len(groups) > PERSONS_SHOWN:
        print(f"  ... and {len(groups) - PERSONS_SHOWN} more groups, all of them in the store's manifest.json")


def file_bars() -> AbstractContextManager[Callable[[str, int, int | None], None]]:
    """A progress bar of the file that is being fetched."""
    from rich.progress import DownloadColumn, TransferSpeedColumn

    from magnet.datamodules.preparing.progress import bar_with

    return bar_with(DownloadColumn(), TransferSpeedColumn())
