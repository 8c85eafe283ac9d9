"""What `magnet data` shows: tables of splits, takes that were skipped, notes, progress, how to train."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Mapping
from contextlib import AbstractContextManager
from typing import Any

from rich.console import Console
from rich.progress import DownloadColumn, TransferSpeedColumn
from rich.table import Table

from magnet.cli.errors import show_some
from magnet.datamodules import registry
from magnet.datamodules.clip import SPLITS
from magnet.datamodules.options import HELD_OUT
from magnet.datamodules.preparing.check import split_gaps
from magnet.datamodules.preparing.progress import Tell, bar_with
from magnet.errors import counted
from magnet.motion.scene import FPS

SKIPPED_SHOWN, PROBLEMS_SHOWN, PERSONS_SHOWN, NOTES_SHOWN = 20, 40, 8, 8
TUNING, WHERE_CONFIGS = "configs/finetune.yaml", "configs/ is in a clone of the repository"
TUNED_HORIZON = 90
"""Frames that a test scene goes on for in configs/finetune.yaml, after its context."""


def show_splits(splits: Mapping[str, Mapping[str, Any]], title: str | None = None) -> None:
    """The table of splits, as a store's manifest has them, with the number of shards where there are any."""
    shards = ["shards"] if any("shards" in split for split in splits.values()) else []
    heads = ("split", "takes", "clips", "frames", "minutes", *shards)
    table = Table(*heads, title=title, title_justify="left", header_style="bold")
    for name in SPLITS:
        split = splits.get(name, {"takes": 0, "clips": 0, "frames": 0, "clips by people": {}})
        people = ", ".join(f"{count} of {n}" for n, count in split["clips by people"].items())
        minutes = f"{split['frames'] / FPS / 60:.1f}"
        row = (str(split["takes"]), f"{split['clips']} ({people})", f"{split['frames']:,}", minutes)
        table.add_row(name, *row, *(str(len(split[key])) for key in shards))
    Console().print(table)


def show_skipped(skipped: list[tuple[str, str]]) -> None:
    """Takes that were not used, and why."""
    if skipped:
        print(f"skipped {len(skipped)} take{'s' * (len(skipped) > 1)}:")
        lines = [f"  {take}: {why}" for take, why in skipped]
        show_some(lines, SKIPPED_SHOWN, ", all of them in the store's manifest.json")


def show_gaps(splits: Mapping[str, Mapping[str, Any]], limited: bool = False) -> None:
    """Warn of what the splits lack, on the error stream; `limited`: not all takes were asked for."""
    clips: Any = {split: {int(n): k for n, k in of["clips by people"].items()} for split, of in splits.items()}
    for line in split_gaps(clips, limited):
        print(f"WARNING: {line}", file=sys.stderr)


def why_untrained(manifest: Mapping[str, Any]) -> str | None:
    """Why nothing of a store can be trained on, by its manifest; None where something can."""
    if manifest["splits"].get("train", {}).get("clips"):
        return None
    counts = {
        ("take", "skipped, as is listed above"): len(manifest["skipped"]),
        ("take", "in no split"): len(manifest["left out"]),
        ("name", "of the lists not in the download"): len(manifest["listed but not there"]),
    }
    facts = [f"{counted(count, what)} {where}" for (what, where), count in counts.items() if count]
    return f"no take that can be used is in train by {manifest['splits by']}" + "".join(f"; {fact}" for fact in facts)


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
    show_some([f"PROBLEM: {problem}" for problem in problems], PROBLEMS_SHOWN, "", sys.stderr)


def show_persons(groups: list[tuple[list[str], int]]) -> None:
    """Names or roles of people who were recorded together, the most frequent first."""
    groups = sorted(groups, key=lambda group: -group[1])
    lines = [f"people: {' | '.join(names)} ({takes} takes)" for names, takes in groups]
    show_some(lines, PERSONS_SHOWN, " groups, all of them in the store's manifest.json")


def training_commands(name: str, out: str, body: str, longest: int) -> list[str]:
    """How to train on a store: to go on with the shipped model, where the body is its, the open one; a tokenizer anew.

    longest: frames of the longest test clip.
    """
    place = f"--data.path {shlex.quote(str(out))}"
    usual = f"{registry.fit_command(registry.data_of(registry.reader(name)))} {place}"
    if body != "open":
        usual = f"{usual} --data.body_model {shlex.quote(body)}"
    usual += shorter_tests(longest, HELD_OUT.horizon_frames)
    tuned = f"magnet fit --config {TUNING} {place}{shorter_tests(longest, TUNED_HORIZON)}"
    return [f"{tuned}   # the shipped model goes on with it; {WHERE_CONFIGS}"] * (body == "open") + [usual]


def shorter_tests(longest: int, horizon: int) -> str:
    """The option without which no test scene would fit into the longest test clip, for a command; "" where some do."""
    rest = longest - HELD_OUT.context_frames
    return f" --data.test.horizon_frames {rest}" if 0 < rest < horizon else ""


def file_bars() -> AbstractContextManager[Tell]:
    """A progress bar of the file that is being fetched."""
    return bar_with(DownloadColumn(), TransferSpeedColumn())
