"""The table of `benchmarks/relation.py`: each number with its bar."""

from collections import defaultdict
from pathlib import Path

import pytest

from tests.scripts import module_at

relation = module_at(Path(__file__).parents[1] / "benchmarks" / "relation.py")


def rows(**changed: float) -> dict[str, dict[str, float]]:
    """A table in which every number is 1, but for some of the model's."""
    return defaultdict(lambda: defaultdict(lambda: 1.0), {"magnet": defaultdict(lambda: 1.0, changed)})


@pytest.mark.parametrize(
    ("name", "changed", "value", "met"),
    [
        ("FD pair over that of training windows", {"fd_pair": 1.1}, "1.100", "met"),
        ("FD pair over that of training windows", {"fd_pair": 1.2}, "1.200", "missed"),
        ("hands together, share of recorded", {"hand_contact": 0.9}, "0.900", "met"),
        ("hands together, share of recorded", {"hand_contact": 0.8}, "0.800", "missed"),
        ("turn rate, off recorded", {"turn_rate": 0.8}, "0.200", "missed"),
        ("turn rate, off recorded", {"turn_rate": 1.1}, "0.100", "met"),
        ("FD pair of second 5 over that of second 2", {"fd_pair@second5": 2.0}, "2.000", "missed"),
        ("frames over 10 cm deep", {"depth_over_10cm": 0.0}, "0.000", "met"),
        ("frames over 10 cm deep", {"depth_over_10cm": 0.001}, "0.001", "missed"),
    ],
)
def test_a_bar_is_met_or_missed(name: str, changed: dict[str, float], value: str, met: str):
    (line,) = [line for line in relation.table({"joint future": rows(**changed)}).splitlines() if f"| {name} |" in line]
    assert f"| {value} |" in line and line.endswith(f"| {met} |")


def test_every_bar_is_of_a_run_and_runs_that_are_not_there_are_left_out():
    assert {bar.run for bar in relation.bars()} == set(relation.RUNS)
    assert "inpainting" not in relation.table({"joint future": rows()})
