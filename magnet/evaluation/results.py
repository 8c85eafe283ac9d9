"""Results of a test run: one table of methods and metrics, on the screen, as JSON, CSV and markdown."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from magnet.evaluation.by_scene import SceneValues
from magnet.files import whole, write_text
from magnet.metrics import Better, Column, all_metrics, column, columns_of
from magnet.metrics.columns import part_notes

LOW, HIGH = "_low", "_high"
"""Endings under which a row holds the ends of a metric's interval."""

REFERENCES = ("ground truth", "training set")
"""Rows of recorded motion: something to compare with, not something that can be best."""

RESULTS_FORMAT = 1

WIDEST = 40
"""Letters of a method's name in one line of a table."""

FIRST = ("fd", "fd_pair", "div", "mpjpe@1s", "mpjpe_mean@1s", "fs")
"""Columns that a short table begins with; others follow as they were measured."""

ARROWS: dict[Better, str] = {"low": " ↓", "high": " ↑", "real": " →", "": ""}


@cache
def own_columns() -> dict[str, Column]:
    """Columns of this package's metrics, for results that do not describe theirs."""
    return columns_of(all_metrics())


@dataclass(frozen=True)
class Results:
    """What a test run measured.

    Args:
        rows: method -> metric -> value; `<metric>_low` and `<metric>_high` beside it are its interval.
        meta: facts about the run, JSON-ready: command, commit, machine, date, seed, data, task, sampler, runtime.
        columns: how metrics are shown, by `columns_of`; those of this package's metrics need not be given.
        scenes: what each test scene measured; in a file of its own (`SceneValues.save`).
    """

    rows: dict[str, dict[str, float]]
    meta: dict[str, Any] = field(default_factory=dict)
    columns: dict[str, Column] = field(default_factory=dict)
    scenes: SceneValues | None = field(default=None, compare=False)

    @property
    def metrics(self) -> list[str]:
        """All metrics that any method has, in the order met, without interval ends."""
        names = dict.fromkeys(name for row in self.rows.values() for name in row)
        ends = {name + end for name in names for end in (LOW, HIGH)}
        return [name for name in names if name not in ends]

    def column(self, metric: str) -> Column:
        """How a metric is shown; one without a description by its own name."""
        return column(metric, own_columns() | self.columns)

    def value(self, method: str, metric: str) -> float:
        """NaN where it was not measured."""
        return float(self.rows[method].get(metric, math.nan))

    def interval(self, method: str, metric: str) -> tuple[float, float] | None:
        row = self.rows[method]
        return (row[metric + LOW], row[metric + HIGH]) if metric + LOW in row and metric + HIGH in row else None

    def best(self, metric: str) -> set[str]:
        """Methods whose shown value no other beats; recorded motion does not compete. Empty without a rival."""
        values = {m: self.value(m, metric) for m in self.rows if m not in REFERENCES}
        values = {m: v for m, v in values.items() if math.isfinite(v)}
        better = self.column(metric).better
        if len(values) < 2 or not better:
            return set()
        goal = 0.0
        if better == "real":
            goal = self.value(REFERENCES[0], metric) if REFERENCES[0] in self.rows else math.nan
            if not math.isfinite(goal):
                return set()
        badness = {m: -v if better == "high" else abs(v - goal) if better == "real" else v for m, v in values.items()}
        least = three(min(badness.values()))
        return {m for m, b in badness.items() if three(b) == least}

    # -- files -----------------------------------------------------------------------------

    def save_json(self, path: str | Path) -> Path:
        """Everything, a value that is not a number as null."""
        rows = {m: {k: v if math.isfinite(v) else None for k, v in row.items()} for m, row in self.rows.items()}
        columns = {name: shown._asdict() for name, shown in self.columns.items()}
        content = {"format": RESULTS_FORMAT, "meta": self.meta, "columns": columns, "rows": rows}
        return write_text(path, json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False, default=str) + "\n")

    @staticmethod
    def load_json(path: str | Path) -> Results:
        """Read what `save_json` wrote.

        Raises:
            ValueError: the file holds something else, or a later format.
        """
        try:
            content = json.loads(Path(path).read_text(encoding="utf-8"))
            version, meta, rows = content["format"], content["meta"], content["rows"]
            columns = {name: Column(**shown) for name, shown in content.get("columns", {}).items()}
            numbers = {m: {k: math.nan if v is None else float(v) for k, v in row.items()} for m, row in rows.items()}
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{path}: not a results file ({error!r}); write one with Results.save_json") from error
        if version > RESULTS_FORMAT:
            raise ValueError(f"{path}: results format {version}, this version reads up to {RESULTS_FORMAT}")
        return Results(numbers, meta, columns)

    def save_csv(self, path: str | Path) -> Path:
        """One line a number: method, metric, value, low, high; full precision, without meta."""
        with whole(path) as part, part.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(("method", "metric", "value", "low", "high"))
            for method, row in self.rows.items():
                for metric in self.metrics:
                    if metric in row:
                        span = self.interval(method, metric) or ("", "")
                        writer.writerow((method, metric, self.value(method, metric), *span))
        return Path(path)

    @staticmethod
    def load_csv(path: str | Path) -> Results:
        """Read what `save_csv` wrote."""
        rows: dict[str, dict[str, float]] = {}
        with Path(path).open(newline="", encoding="utf-8") as file:
            for line in csv.DictReader(file):
                row = rows.setdefault(line["method"], {})
                row[line["metric"]] = float(line["value"])
                if line["low"]:
                    row |= {line["metric"] + LOW: float(line["low"]), line["metric"] + HIGH: float(line["high"])}
        return Results(rows)

    def to_markdown(self, metrics: Sequence[str] | None = None, intervals: bool = False) -> str:
        """The table in markdown, with its footnotes."""
        chosen = self.chosen(metrics)
        lines = ["| method | " + " | ".join(self.title(m) for m in chosen) + " |", "|---|" + "---:|" * len(chosen)]
        best = {metric: self.best(metric) for metric in chosen}
        for method in self.rows:
            cells = []
            for metric in chosen:
                shown = three(self.value(method, metric))
                span = self.interval(method, metric)
                shown = f"**{shown}**" if method in best[metric] else shown
                cells.append(f"{shown} [{three(span[0])}, {three(span[1])}]" if intervals and span else shown)
            lines.append(f"| {method} | " + " | ".join(cells) + " |")
        return "\n".join(lines) + "\n\n" + "  \n".join(self._footnotes(chosen)) + "\n"

    def chosen(self, metrics: Sequence[str] | None) -> list[str]:
        """Metrics to show: those asked for, else the main ones that were measured, else all."""
        measured = self.metrics
        if metrics is not None:
            unknown = sorted(set(metrics) - set(measured))
            if unknown:
                raise ValueError(f"no metric {', '.join(unknown)} in these results; they have {', '.join(measured)}")
            return list(metrics)
        main = [m for m in measured if self.column(m).main]
        return [m for m in FIRST if m in main] + [m for m in main if m not in FIRST] or measured

    def title(self, metric: str) -> str:
        """A metric's name in a table, and an arrow to what is good."""
        shown = self.column(metric)
        return shown.title + ARROWS[shown.better]

    def _footnotes(self, metrics: list[str]) -> list[str]:
        shown: dict[str, str] = {}
        for metric in metrics:
            whole = self.column(metric.partition("@")[0])
            if whole.meaning:
                shown[whole.title] = f"{whole.title}{f' ({whole.unit})' if whole.unit else ''}: {whole.meaning}."
        arrows = {self.column(metric).better for metric in metrics}
        words: dict[Better, str] = {"low": "lower", "high": "higher", "real": "nearer the ground truth"}
        legend = "; ".join(
            f"{ARROWS[better].strip()} {text} is better" for better, text in words.items() if better in arrows
        )
        return [*shown.values(), *part_notes(metrics), *([legend + "."] if legend else [])]


def print_table(
    results: Results,
    metrics: Sequence[str] | None = None,
    *,
    intervals: bool = False,
    title: str | None = None,
    console: Console | None = None,
) -> None:
    """Print methods as rows and metrics as columns, the best in bold, and what the columns mean.

    A table wider than the screen is cut into several, never its numbers.

    Args:
        metrics: which, in this order; None: the main ones.
        intervals: also the interval of each value that has one.
    """
    console = console or Console()
    chosen = results.chosen(metrics)
    best = {metric: results.best(metric) for metric in chosen}
    parts: list[list[str]] = [[]]
    for metric in chosen:
        wider = _table(results, [*parts[-1], metric], best, intervals)
        if parts[-1] and _natural_width(wider, console) > console.width:
            parts.append([])
        parts[-1].append(metric)
    if title:
        console.print(Text(title, style="bold"))
    for part in parts:
        table = _table(results, part, best, intervals)
        console.print(table, width=_natural_width(table, console), crop=False)
    for note in results._footnotes(chosen):
        console.print(Text(note, style="dim"))


def _table(results: Results, metrics: list[str], best: dict[str, set[str]], intervals: bool) -> Table:
    table = Table(box=box.SIMPLE_HEAD, header_style="bold", pad_edge=False, collapse_padding=True)
    table.add_column("method", overflow="fold", max_width=WIDEST)  # a long name takes lines, not the numbers' room
    for metric in metrics:
        table.add_column(_in_two_lines(results, metric), justify="right", no_wrap=True, vertical="bottom")
    for method in results.rows:
        cells = [Text(method, style="italic" if method in REFERENCES else "")]
        for metric in metrics:
            cell = Text(three(results.value(method, metric)), style="bold green" if method in best[metric] else "")
            span = results.interval(method, metric)
            if intervals and span:
                cell.append(f"\n[{three(span[0])}, {three(span[1])}]", style="not bold dim")
            cells.append(cell)
        table.add_row(*cells)
    return table


def _in_two_lines(results: Results, metric: str) -> str:
    """A title of several words, cut at the space nearest to its middle."""
    title = results.title(metric)
    spaces = [at for at, letter in enumerate(results.column(metric).title) if letter == " "]
    if not spaces:
        return title
    middle = min(spaces, key=lambda at: abs(2 * at + 1 - len(title)))
    return f"{title[:middle]}\n{title[middle + 1 :]}"


def _natural_width(table: Table, console: Console) -> int:
    return table.__rich_measure__(console, console.options.update(max_width=10_000)).maximum


def three(value: float) -> str:
    """A number with three significant digits; a dash for none."""
    if not math.isfinite(value):
        return "-" if math.isnan(value) else str(value)
    if value == 0:
        return "0"
    digits = 2 - math.floor(math.log10(abs(float(f"{value:.2e}"))))
    if digits > 6:
        return f"{value:.2e}"
    return f"{round(value, digits):.{max(digits, 0)}f}"
