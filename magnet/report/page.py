"""The page of a report: ours beside the paper's printed numbers, floors, intervals, and which claims hold."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from magnet.evaluation.results import ARROWS, own_columns, three
from magnet.evaluation.scoring import TRUTH
from magnet.files import write_whole
from magnet.metrics import Column, column
from magnet.report.cells import Cell, Store
from magnet.report.film import Joints, film, kept
from magnet.report.made import by_code, took
from magnet.report.plan import FLOORS, PAPER, Block, Claim, Row
from magnet.report.plot import curves, dots, is_end
from magnet.report.statistics import Estimate, difference, estimate, verdict
from magnet.report.summary import missing, summary
from magnet.report.tables import cells_of

SHOWN = {
    "fps": Column("frames/s", "frames a second", "high", "frames a second of one scene, here"),
    "times_shipped": Column("x ours", "", "high", "as many times as fast as the shipped model, in turn with it"),
}
SHORT = (
    "Peers are small models after the idea of the method they are named after, and *Ours* is the shipped model, which "
    "was trained far longer and on more data: what it is better at may come from that. *Ours, trained as the peers* "
    "is base.yaml, with as many steps on as many windows of the same data."
)
ABLATED = (
    "*Ours* is base.yaml here, trained for as many steps on the same data: each row differs from it in what it names."
)
WORDS = {
    "leak": (
        "Measured here, with our weights and our code, not with the reference's. A pairwise transform has two ends: "
        "the given person's token tells where the generated one is, if it is as clean as its token. The reference's "
        "evaluation also counts the given person, who is a copy of the recording. Each line says what one of these "
        "readings gives on these scenes; what the paper's own numbers contain cannot be told from here."
    ),
    "2": SHORT,
    "3": SHORT,
    "5": ABLATED,
    "A.5": ABLATED,
    "own": f"Trainings that differ in one choice of ours, which the paper does not have. {ABLATED}",
    "benchmark": (
        "What `magnet score` measures (docs/benchmark.md): all its scenes, ten samples of each, one seed. "
        "FS and IP of the recordings are not 0: nearer to them is better."
    ),
    "A.3": (
        "Speeds of this machine, each taken in turn with the shipped model's: only the ratio can be compared. "
        "Intervals come from leaving out each round in turn, for there is one scene."
    ),
}
RECORDED = "as recorded"
UNSHOWN = ("RS", "zero velocity", "ridge", TRUTH)
"""Rows that films leave out."""

Runs = Sequence[Mapping[str, Any]]


def runs_of(row: Row, store: Store) -> Runs:
    """What was measured of a row, one a seed."""
    found = [store.get(cell) for cell in row.cells]
    return [content["rows"][row.inside] for content in found if content and row.inside in content["rows"]]


def title(metric: str) -> str:
    """Of a column, with its arrow."""
    shown = column(metric, {**own_columns(), **SHOWN})
    name = f"FD to {metric.partition('@')[2]}" if is_end(metric) else shown.title
    return name + ARROWS[shown.better]


def cell_text(found: Estimate | None) -> str:
    """A number with its interval."""
    if found is None:
        return "-"
    span = found.interval
    return three(found.value) + (f" [{three(span[0])}, {three(span[1])}]" if span else "")


def page(
    blocks: Mapping[str, Sequence[Block]], store: Store, failed: Mapping[Cell, str], facts: Mapping[str, Any]
) -> Path:
    """Write the page, report.json and pictures. Returns the page's path.

    Args:
        blocks: of each table.
        store: of the cells.
        failed: what could not be done, and why.
        facts: how it came about; the JSON has all of them.
    """
    lines: list[str] = []
    cells = cells_of(block for parts in blocks.values() for block in parts)
    done = {cell: found for cell in cells if (found := store.get(cell)) is not None}
    facts = {**facts, **took(done, len(cells))}
    content: dict[str, Any] = {"facts": facts, "tables": {}}
    for name, parts in blocks.items():
        titled = name[0] not in "A12345"
        lines += [f"## {name if titled else f'Table {name}'}", ""]
        lines += [WORDS[name], ""] if name in WORDS else []
        content["tables"][name] = [
            _block(block, store, failed, lines, f"{_safe(name)}-{k}") for k, block in enumerate(parts)
        ]
        lines += _printed(name)
    path = (store.folder / "report").with_suffix(".md")
    lines = ["# Report", "", *_head(facts), "", "## What holds", "", *summary(content["tables"]), *lines]
    lines += missing(content["tables"]) + by_code(done)
    _write(store.folder / "report.json", json.dumps(content, indent=1, sort_keys=True, allow_nan=False) + "\n")
    _write(path, "\n".join(lines).rstrip() + "\n")
    return path


def _head(facts: Mapping[str, Any]) -> list[str]:
    told = []
    for key, value in facts.items():
        parts = [f"{name} {part}" for name, part in value.items() if part] if isinstance(value, Mapping) else [value]
        told += (
            [f"- {key}: {', '.join(map(str, parts))}"] if all(isinstance(p, str | int | float) for p in parts) else []
        )
    return [
        *told,
        "- in brackets: 95 % intervals, by leaving out each scene in turn (scenes do not overlap) and by the spread of "
        "seeds; an ordering holds, or does not, where the interval of the difference leaves out 0. Orderings are many "
        "and each is judged by itself: of twenty that are equal, one seems not to be.",
    ]


def _block(block: Block, store: Store, failed: Mapping[Cell, str], lines: list[str], name: str) -> dict[str, Any]:
    """A table, its picture and what holds, onto `lines`. Returns it for the JSON."""
    runs = {row.title: runs_of(row, store) for row in block.rows}
    found = {
        row: {metric: each for metric in block.columns if (each := estimate(got, metric)) is not None}
        for row, got in runs.items()
    }
    lines += [f"### {block.title}", "", "| method | seeds | " + " | ".join(map(title, block.columns)) + " |"]
    lines += ["|---|---:|" + "---:|" * len(block.columns)]
    for row in block.rows:
        texts = [cell_text(found[row.title].get(metric)) for metric in block.columns]
        lines.append(f"| {row.title} | {_seeds(row, runs[row.title])} | " + " | ".join(texts) + " |")
    lines += ["", *_not_there(block, runs, failed)]
    picture = store.folder / "pictures" / f"{name}.svg"
    drawn = {row: values for row, values in found.items() if values}
    if drawn:
        columns = {metric: title(metric) for metric in block.columns}
        floors = [row.title for row in block.rows if row.inside in FLOORS]
        _write(picture, curves(drawn) if any(map(is_end, columns)) else dots(drawn, columns, floors))
        lines += [f"![{block.title}](pictures/{picture.name})", ""]
    lines += _film(block, store, name)
    judged = [_judged(claim, runs) for claim in block.claims]
    if judged:
        lines += ["| ordering | who says so | here | difference |", "|---|---|---|---:|"]
        lines += [
            f"| {each['claim']} | {each['place']} | {each['verdict']} | {each['difference']} |" for each in judged
        ]
        lines += [""]
    rows = {row: {metric: _plain(each) for metric, each in values.items()} for row, values in found.items()}
    incomplete = [f"{row.title} {_seeds(row, runs[row.title])}" for row in block.rows if _lacks(row, runs[row.title])]
    return {"title": block.title, "rows": rows, "claims": judged, "incomplete": incomplete}


def _lacks(row: Row, found: Runs) -> bool:
    return len(found) < len(row.cells)


def _seeds(row: Row, found: Runs) -> str:
    """How many seeds there are, of how many."""
    return f"{len(found)} of {len(row.cells)}" if _lacks(row, found) else str(len(found))


def _plain(found: Estimate) -> dict[str, Any]:
    span = found.interval
    return {"value": found.value, "low": span[0] if span else None, "high": span[1] if span else None}


def _judged(claim: Claim, runs: Mapping[str, Runs]) -> dict[str, str]:
    a, b = runs.get(claim.better, ()), runs.get(claim.worse, ())
    apart = difference(a, b, claim.metric)
    shown = column(claim.metric, {**own_columns(), **SHOWN}).title
    sign = "<" if claim.lower else ">"
    return {
        "claim": f"{shown}: {claim.better} {sign} {claim.worse}",
        "place": claim.place,
        "verdict": verdict(apart, claim.lower) if a and b else "not measured",
        "difference": cell_text(apart),
    }


def _not_there(block: Block, runs: Mapping[str, Runs], failed: Mapping[Cell, str]) -> list[str]:
    """Why rows are empty."""
    lines = []
    for row in block.rows:
        why = next((failed[cell] for cell in row.cells if cell in failed), "")
        if why:
            lines.append(f"{row.title}: {why}  ")
        elif not runs[row.title]:
            lines.append(f"{row.title}: not measured.  ")
    return [*lines, ""] if lines else []


def _film(block: Block, store: Store, name: str) -> list[str]:
    """A film of the first scene as each row has it, where scenes were kept."""
    shown: dict[str, Joints] = {}
    one = len({row.cells[0].data for row in block.rows}) == 1  # else each row is of a scene of its own
    for row in block.rows:
        path = store.film(row.cells[0])
        scenes = kept(path) if path is not None and row.title not in UNSHOWN else {}
        if TRUTH in scenes:
            shown.setdefault(RECORDED if one else f"{row.title}: {TRUTH}", scenes[TRUTH])
        if row.inside in scenes:
            shown[row.title] = scenes[row.inside]
    path = store.folder / "pictures" / f"{name}.webp"
    if len(shown) > 1:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path.parent, path.name, film(shown))
    if not path.is_file():  # where scenes are not kept, an earlier film stays
        return []
    return [f"![{block.title}: the first test scene, seed 0, one sample](pictures/{path.name})", ""]


def _printed(name: str) -> list[str]:
    """What the paper prints, as it stands there."""
    lines: list[str] = []
    for place, rows in PAPER["tables"].get(name, {}).items():
        width = max(map(len, rows.values()))
        heads = [title(metric) for metric in PAPER["columns"][:width]] if width > 1 else ["printed"]
        lines += [f"### The paper's own: {place}", "", "| method | " + " | ".join(heads) + " |"]
        lines += ["|---|" + "---:|" * width]
        for method, values in rows.items():
            texts = ["-" if value is None else f"{value:.3f}" if width > 1 else f"{value:g}" for value in values]
            lines.append(f"| {method} | " + " | ".join(texts) + " |")
        lines += [""]
    return lines


def _safe(name: str) -> str:
    return "".join(letter if letter.isalnum() else "_" for letter in name)


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path.parent, path.name, text.encode())
