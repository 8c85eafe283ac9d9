"""Pages that quote the report say what it says: its counts, and under each table's heading numbers of that table."""

from __future__ import annotations

import json
import re
from collections import Counter
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
EVIDENCE = DOCS / "evidence"
QUOTED = {
    "evidence.md": r"^### .*?\((?:Table )?(?P<table>[^)]+)\)$",
    "benchmark.md": r"^## Numbers of baselines and of the models here(?P<table>)$",
}
"""Pages and the headings under which they quote a table, which the heading names in brackets: else the benchmark's."""


def parts(text: str, heading: str) -> list[tuple[str, str]]:
    """Headings of a page that match, by their table, each with what stands under it."""
    found = []
    for match in re.finditer(heading, text, re.MULTILINE):
        below = text[match.end() :]
        level = match.group().partition(" ")[0]
        end = re.search(rf"^#{{1,{len(level)}}} ", below, re.MULTILINE)
        found.append((match.groupdict().get("table") or "benchmark", below[: end.start()] if end else below))
    return found


def measured(text: str) -> set[str]:
    """Numbers with a point, as they are printed."""
    return set(re.findall(r"(?<![\d.\w])-?\d+\.\d+(?![\d\w])", text))


@pytest.mark.parametrize("page", QUOTED)
def test_numbers_that_a_page_quotes_of_a_table_stand_in_it(page: str) -> None:
    report = (EVIDENCE / "report.md").read_text(encoding="utf-8")
    there = dict(parts(report, r"^## (?:Table )?(?P<table>\S.*)$"))
    quoted = parts((DOCS / page).read_text(encoding="utf-8"), QUOTED[page])
    assert quoted
    for table, text in quoted:
        assert measured(text) <= measured(there[table]), table


def test_the_page_counts_orderings_and_cells_as_the_report_does() -> None:
    text = " ".join((DOCS / "evidence.md").read_text(encoding="utf-8").split())
    report = json.loads((EVIDENCE / "report.json").read_text(encoding="utf-8"))
    blocks = [block for blocks in report["tables"].values() for block in blocks]
    counts = Counter(claim["verdict"] for block in blocks for claim in block["claims"])
    said = re.search(r"(\d+) hold, (\d+) do not, and (\d+) cannot be told", text)
    assert said is not None
    assert [int(each) for each in said.groups()] == [
        counts[verdict] for verdict in ("holds", "does not hold", "cannot be told")
    ]
    assert re.findall(r"\d+ of \d+(?= cells)", text) == [report["facts"]["cells"]]
