"""What `magnet data` shows: the list of data sets, tables of splits, takes that were skipped, progress."""

from __future__ import annotations

import argparse
import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any, TextIO

from magnet.cli import answers
from magnet.errors import counted

if TYPE_CHECKING:
    from rich.console import Console

    from magnet.datamodules.preparing.progress import Tell
    from magnet.datamodules.reading.recording import Reader
    from magnet.plugins import Registered

SKIPPED_SHOWN, PROBLEMS_SHOWN, PERSONS_SHOWN, NOTES_SHOWN = 20, 40, 8, 8
TUNING, WHERE_CONFIGS = "configs/finetune.yaml", "configs/ is in a clone of the repository"
TUNED_HORIZON = 90
"""Frames that a test scene goes on for in configs/finetune.yaml, after its context."""
BODIES = {
    "smplx": "--body SMPLX_NEUTRAL.npz",
    "smpl": "--body SMPLX_NEUTRAL.npz --bodies SMPL",
    "smplh": "--body SMPLX_NEUTRAL.npz --bodies SMPLH",
}
"""The body that shape numbers need, by family: SMPL's and SMPL-H's are expressed in SMPL-X's."""
WHERE = {
    "smplx": "SMPL-X's file, npz or pkl, is from https://smpl-x.is.tue.mpg.de (register)",
    "smpl": "SMPL: the folder of its files, npz or pkl, from https://smpl.is.tue.mpg.de (register)",
    "smplh": "SMPL-H: the folder of its files, npz or pkl, from https://mano.is.tue.mpg.de (register)",
}


def add_list(one: argparse.ArgumentParser) -> None:
    one.add_argument("name", nargs="?", help="the data set to tell of; default: all")


def run_list(given: argparse.Namespace) -> int:
    answers.show(f"data list {given.name or ''}", lambda console: draw_list(console, given.name))
    return 0


def draw_list(console: Console, name: str | None) -> bool:
    """Print all data sets, or one in full. -> whether the same call will print the same again"""
    from magnet.datamodules import registry
    from magnet.plugins import told

    if name:
        for entry in registry.unprepared():
            if entry.name.lower() == name.lower():
                show_data(console, entry)
                return True
        show_reader(console, registry.reader(name))
        return True
    for kind in registry.readers().values():
        show_reader(console, kind)
    for entry in registry.unprepared():
        show_data(console, entry)
    for lost in registry.failures():
        console.print(f"[bold red]{lost.name}[/]  of {lost.origin}", soft_wrap=True, highlight=False)
        show(console, "failed to load", told(lost.error))
    return not registry.failures()


def show_reader(console: Console, kind: type[Reader]) -> None:
    """A data set whose download is prepared."""
    from magnet.datamodules import registry

    console.print(f"[bold cyan]{kind.name}[/]  {kind.title}", soft_wrap=True)
    show(console, "who may use it", kind.licence)
    show(console, "where to ask", kind.source)
    wide = max((len(pattern) for pattern, _ in kind.layout), default=0)
    for number, (pattern, what) in enumerate(kind.layout):
        show(console, "" if number else "under --root", f"{pattern:<{wide}}  {what}")
    family = next(iter(kind.shapes_of), kind.family)
    body = BODIES.get(family, "")
    model = " --data.body_model SMPLX_NEUTRAL.npz" if body else ""
    show(console, "then", f"magnet data prepare {kind.name} --root DOWNLOAD --out STORE {body}".rstrip())
    if not body:  # the open one will do, which is the shipped model's
        show(console, "", f"magnet fit --config {TUNING} --data.path STORE   # {WHERE_CONFIGS}")
    show(console, "", f"{registry.fit_command(registry.data_of(kind))} --data.path STORE{model}")
    if body:
        show(console, "", WHERE[family])
    if kind.fake:
        show(console, "to try it out", f"magnet data fake {kind.name} FAKE")


def show_data(console: Console, entry: Registered) -> None:
    """A data set that trains without being prepared."""
    from magnet.datamodules import registry

    console.print(f"[bold cyan]{entry.name}[/]  of {entry.origin}", soft_wrap=True)
    show(console, "what it is", (entry.kind.__doc__ or "").strip().partition("\n")[0])
    show(console, "then", registry.fit_command(entry.name))


def show(console: Console, what: str, text: str) -> None:
    """A line of it, as it is."""
    from rich.text import Text

    console.print(Text.assemble((f"  {what:<16}", "dim"), text), soft_wrap=True)


def show_splits(splits: Mapping[str, Mapping[str, Any]], title: str | None = None) -> None:
    """The table of splits, as a store's manifest has them, with the number of shards where there are any."""
    from rich.console import Console
    from rich.table import Table

    from magnet.datamodules.clip import SPLITS
    from magnet.motion.scene import FPS

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


def show_some(lines: Sequence[str], most: int, more: str, file: TextIO | None = None) -> None:
    """Print the first `most` lines, and how many more there are."""
    for line in lines[:most]:
        print(line, file=file)
    if len(lines) > most:
        print(f"  ... and {len(lines) - most} more{more}", file=file)


def show_skipped(skipped: list[tuple[str, str]]) -> None:
    """Takes that were not used, and why."""
    if skipped:
        print(f"skipped {len(skipped)} take{'s' * (len(skipped) > 1)}:")
        lines = [f"  {take}: {why}" for take, why in skipped]
        show_some(lines, SKIPPED_SHOWN, ", all of them in the store's manifest.json")


def show_gaps(splits: Mapping[str, Mapping[str, Any]], limited: bool = False) -> None:
    """Warn of what the splits lack, on the error stream; `limited`: not all takes were asked for."""
    from magnet.datamodules.preparing.check import split_gaps

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
    from magnet.datamodules import registry
    from magnet.datamodules.options import HELD_OUT

    place = f"--data.path {shlex.quote(str(out))}"
    usual = f"{registry.fit_command(registry.data_of(registry.reader(name)))} {place}"
    if body != "open":
        usual = f"{usual} --data.body_model {shlex.quote(body)}"
    usual += shorter_tests(longest, HELD_OUT.horizon_frames)
    tuned = f"magnet fit --config {TUNING} {place}{shorter_tests(longest, TUNED_HORIZON)}"
    return [f"{tuned}   # the shipped model goes on with it; {WHERE_CONFIGS}"] * (body == "open") + [usual]


def shorter_tests(longest: int, horizon: int) -> str:
    """The option without which no test scene would fit into the longest test clip, for a command; "" where some do."""
    from magnet.datamodules.options import HELD_OUT

    rest = longest - HELD_OUT.context_frames
    return f" --data.test.horizon_frames {rest}" if 0 < rest < horizon else ""


def file_bars() -> AbstractContextManager[Tell]:
    """A progress bar of the file that is being fetched."""
    from rich.progress import DownloadColumn, TransferSpeedColumn

    from magnet.datamodules.preparing.progress import bar_with

    return bar_with(DownloadColumn(), TransferSpeedColumn())
