"""`magnet compare A B`: two results of a test, scene by scene: how far apart they are, and which is better."""

from __future__ import annotations

import argparse
import ast
import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magnet.cli.errors import CommandError, no_such
from magnet.cli.flags import PlainParser, flat

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
    both = [read(folder) for folder in (given.folders[0], given.folders[-1])]
    rows = tuple(given.rows or [next(iter(values.rows)) for _, values in both])
    for folder, row, (_, values) in zip((given.folders[0], given.folders[-1]), rows, both, strict=True):
        if row not in values.rows:
            raise CommandError(no_such("row", row, list(values.rows), str(folder / "results.json")))
    show(both[0], both[1], (rows[0], rows[1]), given.full, given.folders)
    return 0


def read(folder: Path) -> tuple[Results, SceneValues]:
    """The results in a folder, and the values of their scenes."""
    from magnet.evaluation.by_scene import SceneValues
    from magnet.evaluation.results import Results

    wanted = "expected a folder that magnet test or magnet score has written"
    if not folder.exists():
        raise CommandError(f"{folder}: is not there, {wanted}")
    folder = folder.parent if folder.suffix == ".json" else folder
    for name in ("results.json", FILE):
        if not (folder / name).is_file():
            raise CommandError(f"{folder}: has no {name}, {wanted}")
    return Results.load_json(folder / "results.json"), SceneValues.load(folder / FILE)


def show(
    first: tuple[Results, SceneValues],
    second: tuple[Results, SceneValues],
    rows: tuple[str, str],
    full: bool,
    folders: Sequence[Path],
) -> None:
    """Print what is compared, and the table."""
    import sys

    from rich.console import Console

    from magnet.cli.outputs import WIDE
    from magnet.evaluation.by_scene import compared
    from magnet.evaluation.results import REFERENCES

    results, one, other = first[0], first[1], second[1]
    common = set(one.scenes) & set(other.scenes)
    if not common:
        raise CommandError(f"no common test scenes: one has {one.scenes[0]}, the other {other.scenes[0]}")
    metrics = [metric for metric in one.rows[rows[0]] if metric in other.rows[rows[1]]]
    metrics = [metric for metric in metrics if full or results.column(metric).main] or metrics
    if not metrics:
        raise CommandError(f"{rows[0]} and {rows[1]} have no number in common that is a mean over scenes")
    units = len(
        {unit if unit >= 0 else name for name, unit in zip(one.scenes, one.units, strict=True) if name in common}
    )
    names = (f"{rows[0]} (A)", f"{rows[1]} (B)") if len(folders) > 1 or rows[0] == rows[1] else rows
    console = Console() if sys.stdout.isatty() else Console(width=WIDE)
    console.print(f"{names[0]} and {names[1]}, {len(common)} scenes of both ({units} independent)", style="bold")
    for letter, folder, (said, _) in zip("AB", folders, (first, second), strict=False):
        kept = said.meta.get("checkpoint")
        trained = f", checkpoint {kept}" if kept not in (None, "None") else ""
        console.print(f"{letter}: {folder}{trained}", markup=False, highlight=False, soft_wrap=True)
    apart = differing(settings(results, one, rows[0]), settings(second[0], other, rows[1]))
    if apart:
        console.print(f"settings differ: {apart}", markup=False, highlight=False, soft_wrap=True)
    found = {each: compared(one, other, rows, each, results.column(each).better, REFERENCES[0]) for each in metrics}
    console.print(table(results, names, found))
    lone = len(set(one.scenes) ^ set(other.scenes))
    notes = [f"{lone} scene{'s are' if lone > 1 else ' is'} in one of them alone and left out"] if lone else []
    for note in [
        *notes,
        "an interval is of independent scenes, resampled for both alike; with under ten of them it is too narrow",
    ]:
        console.print(note, style="dim")


def settings(results: Results, values: SceneValues, row: str) -> dict[str, Any]:
    """What decides how a row came about: its task, its number of samples, and single options of sampler and task."""
    said = values.facts.get("samples")
    found = {key: values.facts.get(key) for key in SAME}
    found["samples"] = said.get(row) if isinstance(said, dict) else said
    return found | flat(results.meta.get("sampler", {})) | scalars(results.meta.get("task options", ""))


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
