"""Result tables: every number shown, the right one best, nothing lost in files."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path
from typing import ClassVar

import pytest
import torch
from rich.console import Console
from torchmetrics import Metric, MetricCollection

from magnet.evaluation.results import Results, print_table, three
from magnet.metrics import Column, NearestTraining, all_metrics, columns_of


@pytest.fixture
def results() -> Results:
    rows = {
        "magnet": {"fd": 0.2834, "div": 2.911, "mpjpe": 0.20549, "mpjpe_low": 0.19, "mpjpe_high": 0.223, "jitter": 9.1},
        "NN": {"fd": 0.354, "div": math.nan, "mpjpe": 0.47, "jitter": 30.0},
        "held pose": {"fd": 1.61, "div": 0.0, "mpjpe": 0.2054, "jitter": 0.0},
        "ground truth": {"fd": 0.0, "jitter": 10.0, "fd halves": 0.37},
    }
    return Results(rows, {"command": "magnet test", "seed": 1, "seconds": {"magnet": 3.5}})


def printed(results: Results, width: int = 200, **options: object) -> str:
    console = Console(file=io.StringIO(), width=width, color_system=None)
    print_table(results, console=console, **options)  # type: ignore[arg-type]
    return console.file.getvalue()  # type: ignore[attr-defined]


def test_numbers_have_three_significant_digits() -> None:
    values = [0.20549, 0.3, 12.345, 1829.48, 9.996, 0.09996, 0.0, -0.5, 1.23e-7, math.nan, math.inf, 100.0]
    shown = ["0.205", "0.300", "12.3", "1830", "10.0", "0.100", "0", "-0.500", "1.23e-07", "-", "inf", "100"]
    assert [three(value) for value in values] == shown


@pytest.mark.parametrize("width", [200, 60, 30])
def test_a_table_shows_every_number_however_narrow_the_screen(results: Results, width: int) -> None:
    text = printed(results, width, metrics=results.metrics)
    for method, row in results.rows.items():
        assert method in text
        for metric in row:
            if metric in results.metrics:
                assert three(row[metric]) in text
    assert "[0.190, 0.223]" in printed(results, metrics=["mpjpe"], intervals=True)


@pytest.mark.parametrize("width", [100, 60])
def test_a_methods_long_name_takes_no_room_from_numbers(results: Results, width: int) -> None:
    name = "a method of a very long name [with brackets] " * 5
    text = printed(
        Results({name: results.rows["magnet"], "NN": results.rows["NN"]}), width, metrics=results.metrics[:3]
    )
    assert all(number in text for number in ("0.283", "2.91", "0.205", "0.354", "0.470"))
    assert max(map(len, text.splitlines())) <= width
    assert "".join(name.split()) in "".join(line[:41].replace(" ", "") for line in text.splitlines())


def test_the_best_is_marked_and_recordings_do_not_compete(results: Results) -> None:
    assert results.best("fd") == {"magnet"}
    assert results.best("div") == {"magnet"}
    assert results.best("mpjpe") == {"magnet", "held pose"}, "equal as shown"
    assert results.best("jitter") == {"magnet"}, "nearest to the recorded value"
    assert results.best("fd halves") == set()
    assert Results({"magnet": {"fd": 1.0}}).best("fd") == set()
    lines = results.to_markdown(["fd", "div", "mpjpe", "jitter"], intervals=True).splitlines()
    assert lines[0] == "| method | FD ↓ | DIV ↑ | MPJPE ↓ | jitter → |"
    assert lines[2] == "| magnet | **0.283** | **2.91** | **0.205** [0.190, 0.223] | **9.10** |"
    assert "FD (m²)" in results.to_markdown() and "↓ lower is better" in results.to_markdown()


def test_json_returns_what_was_saved(results: Results, tmp_path: Path) -> None:
    path = results.save_json(tmp_path / "deep" / "results.json")
    assert "NaN" not in path.read_text()
    back = Results.load_json(path)
    assert back.meta == results.meta
    assert str(back.rows) == str(results.rows)


def test_csv_returns_what_was_saved(results: Results, tmp_path: Path) -> None:
    path = results.save_csv(tmp_path / "results.csv")
    assert str({m: dict(sorted(row.items())) for m, row in Results.load_csv(path).rows.items()}) == str(
        {m: dict(sorted(row.items())) for m, row in results.rows.items()}
    )


def test_bad_files_and_metrics_are_named(results: Results, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"format": 1, "meta": {}, "rows": {"m": {"fd": []}}}')
    with pytest.raises(ValueError, match=r"a\.json: not a results file"):
        Results.load_json(tmp_path / "a.json")
    (tmp_path / "a.json").write_text("[]")
    with pytest.raises(ValueError, match=r"a\.json: not a results file"):
        Results.load_json(tmp_path / "a.json")
    (tmp_path / "b.json").write_text(json.dumps({"format": 99, "meta": {}, "rows": {}}))
    with pytest.raises(ValueError, match="format 99"):
        Results.load_json(tmp_path / "b.json")
    with pytest.raises(ValueError, match=r"no metric speed.*they have fd"):
        results.to_markdown(["speed"])


@pytest.fixture(scope="module")
def measured() -> dict[str, float]:
    """Everything that the project measures of five seconds of two people."""
    metrics = all_metrics(30.0, confidence=0.9)
    generator = torch.Generator().manual_seed(0)
    truth = torch.randn(3, 150, 2, 22, 3, generator=generator)
    generated = truth + 0.1 * torch.randn(2, 3, 150, 2, 22, 3, generator=generator)
    metrics.update(generated, truth, torch.ones(3, 2, dtype=torch.bool))
    return {name: float(value) for name, value in metrics.compute().items()}


def test_every_metric_of_the_project_says_how_it_is_shown(measured: dict[str, float]) -> None:
    results = Results({"magnet": measured})
    shown = {name: results.column(name) for name in results.metrics}
    assert all(column.meaning for column in shown.values()), [name for name in shown if not shown[name].meaning]
    assert len({column.title for column in shown.values()}) == len(shown), "two numbers under one title"
    unmeasured = set(columns_of(all_metrics())) - set(shown)
    assert unmeasured <= {"fd_velocity"}, "a metric describes a number that it does not have"


METHODS = ("magnet", "NN", "RS", "zero velocity", "ridge", "ground truth", "training set")


def test_the_short_table_is_one_table_that_shows_people_together(measured: dict[str, float]) -> None:
    """Of all rows that it has, with the widest of usual numbers, in a hundred columns."""
    row = dict.fromkeys([*measured, "nearest_training"], 0.0123)
    results = Results(dict.fromkeys(METHODS, row), columns=NearestTraining.columns)
    short = results.chosen(None)
    assert {"fd", "fd_pair", "div", "fs", "hand_contact", "depth_body_over_5cm", "nearest_training"} <= set(short)
    assert {"mpjpe@1s", "mpjpe_mean@1s"} <= set(short)
    text = printed(results, 100)
    assert text.count("method") == 1
    table = text[: text.index("FD (m²)")]
    assert max(map(len, table.splitlines())) <= 100
    assert all(table.count(method) == 1 for method in METHODS)
    assert printed(results, 100, metrics=results.metrics).count("method") > 1


def test_parts_of_a_number_are_said_in_words(measured: dict[str, float]) -> None:
    results = Results({"magnet": measured})
    titles = {
        "mpjpe@2s": ("MPJPE 2s", "up to 2 s"),
        "fd_pair@second3": ("FD pair second 3", "within second 3"),
        "turn_rate@agent1": ("turning agent 1", "of agent 1"),
    }
    for name, (title, meaning) in titles.items():
        assert name in measured
        assert results.column(name).title == title and results.column(name).meaning.endswith(meaning)
    notes = results.to_markdown([*titles, "mpjpe@1s", "fd_pair@second1"])
    assert "| FD pair second 3 ↓ |" in notes
    for said in ("such as 2s: over the frames up to then", "such as second 3: over", "such as agent 1: of that slot"):
        assert notes.count(said) == 1
    assert results.column("novel") == Column("novel", "", "", "")


class Bounce(Metric):
    """Somebody else's metric, which knows nothing of this package but how numbers are described."""

    columns: ClassVar[dict[str, Column]] = {"bounce": Column("bounce", "m", "high", "how high people jump", main=True)}

    def update(self, *batch: object) -> None: ...

    def compute(self) -> dict[str, torch.Tensor]:
        return {"bounce": torch.tensor(0.25), "silent": torch.tensor(1.0)}


def test_somebody_elses_metric_shows_itself(tmp_path: Path) -> None:
    metrics = MetricCollection({"bounce": Bounce(), "DIV": all_metrics()["DIV"]}, compute_groups=False)
    rows = {"ours": {"bounce": 0.25, "silent": 1.0, "div": 2.0}, "theirs": {"bounce": 0.5, "silent": 2.0, "div": 1.0}}
    results = Results(rows, columns=columns_of(metrics))
    assert results.chosen(None) == ["div", "bounce"] and results.best("bounce") == {"theirs"}
    assert results.best("silent") == set()
    text = results.to_markdown()
    assert "| bounce ↑ |" in text and "bounce (m): how high people jump." in text
    back = Results.load_json(results.save_json(tmp_path / "results.json"))
    assert back.to_markdown() == text


def test_results_from_before_metrics_described_themselves_are_read(results: Results, tmp_path: Path) -> None:
    path = results.save_json(tmp_path / "results.json")
    content = json.loads(path.read_text())
    del content["columns"]
    path.write_text(json.dumps(content))
    assert Results.load_json(path).to_markdown() == results.to_markdown()
