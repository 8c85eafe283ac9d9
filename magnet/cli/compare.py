"""`magnet compare A B`: two results of a test, scene by scene: how far apart they are, and which is better."""

from __future__ import annotations

import argparse
import ast
import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magnet.cli.errors import CommandError, no_such
from magnet.cli.flags import PlainParser, flat
from magnet.errors import counted

if TYPE_CHECKING:
    from rich.table import Table

    from magnet.evaluation.by_scene import Difference, SceneValues
    from magnet.evaluation.results import Results

FILE = "scenes.json"
"""What `magnet test` and `magnet score` write beside results.json."""
SAME = ("task", "benchmark", "context frames", "horizon frames")
"""Facts that are told where they differ."""

EPILOG = """\
A and B are folders with results of `magnet test` or `magnet score`, on the same test scenes. Compared are the first
rows of their tables, or those that --rows names; of one folder, two of its rows. Only numbers that are means over
scenes can be compared so: not FD, MI, partner distance, turning and token borders.

for example:
  magnet compare runs/test/before runs/test/after
  magnet compare runs/test/before runs/test/after --full
  magnet compare runs/score/joint_future --rows duet NN
"""


def parser() -> argparse.ArgumentParser:
    options = PlainParser("compare", __doc__, EPILOG)
    add = options.add_argument
    add("folders", nargs="+", metavar="FOLDER", type=Path, help="of the results: A B, or one with --rows")
    add("--rows", nargs=2, metavar=("ROW", "ROW"), help="of A and of B (default: the first of each)")
    add("--full", action="store_true", help="all numbers that are means over scenes, and not the main ones alone")
    return options


def main(arguments: Sequence[str] = ()) -> int:
    """Run the command. Returns the exit code."""
    given = parser().parse_args(list(arguments))
    if len(given.folders) > 2 or (len(given.folders) == 1 and not given.rows):
        many = len(given.folders)
        raise CommandError(f"got {many} folder{'s' * (many > 1)}, expected two, or one with --rows ROW ROW")
    first, second = given.rows or (None, None)
    show(read(given.folders[0], first), read(given.folders[-1], second), given.full)
    return 0


@dataclass(frozen=True)
class Side:
    """One of the two that are compared: a row of a table, and the values of its scenes."""

    folder: Path
    results: Results
    values: SceneValues
    row: str

    def settings(self) -> dict[str, Any]:
        """What decides how the row came about: its task, its number of samples, and single options of sampler and
        task."""
        said = self.values.facts.get("samples")
        found = {key: self.values.facts.get(key) for key in SAME}
        found["samples"] = said.get(self.row) if isinstance(said, dict) else said
        return found | flat(self.results.meta.get("sampler", {})) | scalars(self.results.meta.get("task options", ""))


def read(folder: Path, row: str | None) -> Side:
    """A row of the results in a folder, None: the first, and the values of its scenes."""
    from magnet.evaluation.by_scene import SceneValues
    from magnet.evaluation.results import Results

    wanted = "expected a folder that magnet test or magnet score has written"
    if not folder.exists():
        raise CommandError(f"{folder}: is not there, {wanted}")
    held = folder.parent if folder.suffix == ".json" else folder
    for name in ("results.json", FILE):
        if not (held / name).is_file():
            raise CommandError(f"{held}: has no {name}, {wanted}")
    results, values = Results.load_json(held / "results.json"), SceneValues.load(held / FILE)
    row = row or next(iter(values.rows))
    if row not in values.rows:
        raise CommandError(no_such("row", row, list(values.rows), str(folder / "results.json")))
    return Side(folder, results, values, row)


def show(a: Side, b: Side, full: bool) -> None:
    """Print what is compared, and the table."""
    import sys

    from rich.console import Console

    from magnet.cli.outputs import WIDE
    from magnet.evaluation.by_scene import compared, other_recordings
    from magnet.evaluation.results import REFERENCES

    one, other, results = a.values, b.values, a.results
    common = set(one.scenes) & set(other.scenes)
    if not common:
        raise CommandError(f"no common test scenes: one has {one.scenes[0]}, the other {other.scenes[0]}")
    metrics = [metric for metric in one.rows[a.row] if metric in other.rows[b.row]]
    metrics = [metric for metric in metrics if full or results.column(metric).main] or metrics
    if not metrics:
        raise CommandError(f"{a.row} and {b.row} have no number in common that is a mean over scenes")
    units = len(
        {unit if unit >= 0 else name for name, unit in zip(one.scenes, one.units, strict=True) if name in common}
    )
    alone = a.folder is b.folder  # one folder was named
    names = (a.row, b.row) if alone and a.row != b.row else (f"{a.row} (A)", f"{b.row} (B)")
    console = Console() if sys.stdout.isatty() else Console(width=WIDE)
    scenes = f"{counted(len(common), 'scene')} of both ({units} independent)"
    console.print(f"{names[0]} and {names[1]}, {scenes}", style="bold")
    for letter, side in zip("A" if alone else "AB", (a, b), strict=False):
        kept = side.results.meta.get("checkpoint")
        digest = side.results.meta.get("checkpoint sha256")  # tells two of one name from each other
        which = f" (sha256 {digest[:12]})" if digest else ""
        trained = f", checkpoint {kept}{which}" if kept not in (None, "None") else ""
        console.print(f"{letter}: {side.folder}{trained}", markup=False, highlight=False, soft_wrap=True)
    if apart := differing(a.settings(), b.settings()):
        console.print(f"settings differ: {apart}", markup=False, highlight=False, soft_wrap=True)
    alike = a.settings()["task"] == b.settings()["task"]  # of another task other people or frames are measured
    if alike and (strange := other_recordings(one, other, REFERENCES[0])):
        told = f"recordings differ in {len(strange)} of them, such as {strange[0]}"
        why = f"{REFERENCES[0]} has other numbers there: other scenes of the same name, or measured otherwise"
        console.print(f"{told}; {why}", markup=False, highlight=False, soft_wrap=True)
    rows = (a.row, b.row)
    found = {each: compared(one, other, rows, each, results.column(each).better, REFERENCES[0]) for each in metrics}
    console.print(table(results, names, found))
    if lone := len(set(one.scenes) ^ set(other.scenes)):
        console.print(f"{lone} scene{'s are' if lone > 1 else ' is'} in one of them alone and left out", style="dim")
    console.print("an interval is of independent scenes, resampled for both alike; the fewer, the wider", style="dim")


def scalars(text: str) -> dict[str, Any]:
    """Numbers, words and switches in what `repr` writes of a task."""
    try:
        node = ast.parse(text, mode="eval").body
    except (SyntaxError, ValueError):
        return {}
    found: dict[str, Any] = {}
    for each in node.keywords if isinstance(node, ast.Call) else []:
        if isinstance(each.value, ast.Constant | ast.UnaryOp):
            with contextlib.suppress(ValueError):  # such as -inf
                found[str(each.arg)] = ast.literal_eval(each.value)
    return found


def differing(first: Mapping[str, Any], second: Mapping[str, Any]) -> str:
    """Settings that both have and that differ, as "settle hold / firm, steps 16 / 8"; empty without any."""
    plain = {True: "true", False: "false"}
    words = []
    for key, mine in first.items():
        theirs = second.get(key)
        if mine != theirs and None not in (mine, theirs):
            words.append(f"{key} " + " / ".join(plain[v] if isinstance(v, bool) else str(v) for v in (mine, theirs)))
    return ", ".join(words)


def table(results: Results, names: tuple[str, str], found: Mapping[str, Difference]) -> Table:
    """A line each number: of both, the difference with its interval, and who is better where that can be told.

    The ground truth's value is shown where it decides that.
    """
    from rich import box
    from rich.table import Table

    from magnet.evaluation.results import three

    made = Table(box=box.SIMPLE_HEAD, header_style="bold", pad_edge=False)
    made.add_column("number", no_wrap=True)
    real = any(each.truth == each.truth for each in found.values())
    heads = [name.replace(" ", "\n") for name in names]  # in several lines, so that intervals have room in one
    for name in (*heads, *(["ground\ntruth"] * real), "difference", "95 %"):
        made.add_column(name, justify="right", no_wrap=True)
    made.add_column("better")
    for metric, each in found.items():
        interval = f"[{three(each.low)}, {three(each.high)}]" if each.low == each.low else "-"
        truth = ["" if each.truth != each.truth else three(each.truth)] * real
        numbers = (three(each.first), three(each.second), *truth, three(each.difference), interval)
        sure = "" if not results.column(metric).better else "cannot be told"
        made.add_row(results.title(metric), *numbers, sure if each.better is None else names[each.better])
    return made
