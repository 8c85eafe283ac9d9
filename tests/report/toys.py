"""What tests of reports share: a plan of tiny cells, and made-up runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from magnet.report.cells import BUDGETS
from magnet.report.plan import ReportOptions

PLAN = ReportOptions(BUDGETS["tiny"], configs=Path(__file__).parents[2] / "configs" / "report")


def run_of(values: list[float]) -> dict[str, Any]:
    """A seed whose number is the mean over units of one value each."""
    n = len(values)
    without = {str(k): {"fd": (sum(values) - values[k]) / (n - 1)} for k in range(n)}
    return {"value": {"fd": sum(values) / n}, "without": without}
