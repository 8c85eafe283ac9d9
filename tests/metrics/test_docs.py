"""docs/metrics.md defines every number that is measured, and says what the metrics say of themselves."""

import re
from pathlib import Path

import pytest
import torch

from magnet.metrics import ClipMeans, Column, NearestTraining, all_metrics, column, columns_of

from .batches import draw_batch

PAGE = (Path(__file__).parents[2] / "docs" / "metrics.md").read_text(encoding="utf-8")

UNITS = {"": {"-", "share", "ratio"}}
"""What the page calls numbers without a unit."""


@pytest.fixture(scope="module")
def measured() -> list[str]:
    metrics = all_metrics()
    metrics.update(*draw_batch(frames=64, people=2))
    return sorted({name.partition("@")[0] for name in metrics.compute()})


def test_every_number_is_defined(measured: list[str]) -> None:
    named = set(re.findall(r"`(\w+)(?:@\w+)?`", PAGE))
    missing = set(measured) - named
    assert not missing


def test_tables_say_the_unit_and_direction_that_the_metric_says() -> None:
    known = {**columns_of(all_metrics()), **NearestTraining.columns}  # which needs a training set to be made
    rows = re.findall(r"^\| (`\w+`[^|]*) \| ([^|]+) \| (low|high|real) \|", PAGE, flags=re.MULTILINE)
    assert len(rows) > 20
    for names, units, better in rows:
        for name in re.findall(r"`(\w+)", names):
            said = column(name, known)
            assert said.meaning, f"{name} is not measured"
            assert said.better == better, name
            assert {unit.strip() for unit in units.split(",")} & UNITS.get(said.unit, {said.unit}), name


def test_the_pages_metric_of_your_own_measures_and_shows_itself() -> None:
    source = re.search(r"```python\n(from magnet\.metrics import ClipMeans.*?)```", PAGE, flags=re.DOTALL)
    assert source is not None
    space: dict[str, type[ClipMeans]] = {}
    exec(source[1], space)  # type: ignore[arg-type]
    metric = space["HeadHeight"]()
    joints = torch.zeros(1, 5, 2, 22, 3)
    joints[..., 15, 1] = 1.5
    metric.update(joints[None], joints, torch.ones(1, 2, dtype=torch.bool))
    assert float(metric.compute()["head_height"]) == pytest.approx(1.5)
    assert columns_of(metric)["head_height"] == Column("head", "m", "real", "how high heads are", main=True)


def test_the_pages_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    source = re.search(r"```python\n(import torch.*?)```", PAGE, flags=re.DOTALL)
    assert source is not None
    exec(source[1], {})
    assert float(re.search(r"tensor\(([\d.]+)", capsys.readouterr().out)[1]) > 0  # type: ignore[index]
