"""What a report says on its first screen: how many of the paper's orderings hold here, which, and what is missing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

VERDICTS = ("holds", "does not hold", "cannot be told", "not measured")


def summary(tables: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[str]:
    """Lines of the page. tables: as in report.json, blocks with `title`, `claims` and `incomplete`"""
    lines = ["| table | " + " | ".join(VERDICTS) + " |", "|---|" + "---:|" * len(VERDICTS)]
    total: Counter[str] = Counter()
    for name, blocks in tables.items():
        counts = Counter(claim["verdict"] for block in blocks for claim in block["claims"])
        total += counts
        if counts:
            lines.append(f"| {name} | " + " | ".join(str(counts[each] or "") for each in VERDICTS) + " |")
    lines += ["| all | " + " | ".join(str(total[each]) for each in VERDICTS) + " |", ""]
    for verdict in VERDICTS[:2]:
        lines += [f"What {verdict} here, by the interval of the difference:", ""]
        lines += _listed(tables, verdict) or ["- nothing"]
        lines += [""]
    return lines


def missing(tables: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[str]:
    """Lines of the page's end: rows that were not measured with every seed."""
    found = [
        f"- {name}, {block['title']}: {', '.join(block['incomplete'])}"
        for name, blocks in tables.items()
        for block in blocks
        if block["incomplete"]
    ]
    return ["## What is missing", "", "Seeds that are there, of how many:", "", *found, ""] if found else []


def _listed(tables: Mapping[str, Sequence[Mapping[str, Any]]], verdict: str) -> list[str]:
    """A line a block: its orderings of this verdict."""
    found: dict[str, list[str]] = {}
    for name, blocks in tables.items():
        for block in blocks:
            told = [
                f"{claim['claim']} ({claim['difference']})" for claim in block["claims"] if claim["verdict"] == verdict
            ]
            if told:
                found.setdefault(f"- {name}, {block['title']}", []).extend(dict.fromkeys(told))
    return [f"{place}: {'; '.join(told)}" for place, told in found.items()]
