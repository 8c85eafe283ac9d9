"""How cells came about: what they took, and by which code."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from magnet.report.cells import Cell
from magnet.report.run import clock

UNKNOWN = "code that was not kept"

Done = Mapping[Cell, Mapping[str, Any]]
"""Cells that are done, with what their files hold."""


def took(done: Done, wanted: int) -> dict[str, str]:
    """How many of the wanted cells are there and what they took, on the clock and of a processor: facts of the page."""
    if not done:
        return {}
    kinds: dict[str, list[float]] = {}
    for cell, content in done.items():
        kinds.setdefault(cell.kind, []).append(float(content.get("seconds", 0)))
    parts = [f"{kind} {len(each)} in {clock(sum(each))}" for kind, each in sorted(kinds.items())]
    whole = f"{clock(sum(map(sum, kinds.values())))}, one cell after another ({', '.join(parts)})"
    worked = [float(content["processor_seconds"]) for content in done.values() if "processor_seconds" in content]
    kept = {"processor time": f"{clock(sum(worked))} of the {len(worked)} cells that kept it"} if worked else {}
    return {"cells": f"{len(done)} of {wanted}", "time on the clock": whole, **kept}


def by_code(done: Done) -> list[str]:
    """Lines of the page's end: which cells are by which code, so that it is seen what would come out otherwise now."""
    found: dict[str, Counter[str]] = {}
    for cell, content in done.items():
        found.setdefault(content.get("code") or UNKNOWN, Counter())[f"{cell.kind} {_of(cell)}"] += 1
    told = sorted(found.items(), key=lambda each: (each[0] == UNKNOWN, -each[1].total(), each[0]))
    lines = [f"- {code}: {kinds.total()} cells ({_listed(kinds)})" for code, kinds in told]
    return ["## By which code", "", "The commit that each cell was run by:", "", *lines, ""] if lines else []


def _of(cell: Cell) -> str:
    if cell.model is None:
        return "floors"
    return cell.model.config or str(cell.model.checkpoint)


def _listed(kinds: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in sorted(kinds.items()))
