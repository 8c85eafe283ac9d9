"""`magnet report`: numbers with their intervals, cells that are done once, and pages that a kill does not change."""

from __future__ import annotations

import contextlib
import json
import math
import re
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from magnet import cli
from magnet.cli.report import chosen
from magnet.cli.train import run_trainer
from magnet.denoiser.module import Denoiser
from magnet.report import measure, run
from magnet.report.cells import Cell, Store, Weights
from magnet.report.made import by_code, took
from magnet.report.page import page
from magnet.report.run import Runner, own_window
from magnet.report.summary import missing, summary
from magnet.report.tables import TABLES, cells_of
from tests.report.toys import PLAN, run_of

TINY_TRAINING = """
data:
  class_path: Synthetic
  init_args: {people: [2], max_agents: 2, train_clips: 2, val_clips: 1, clip_frames: 120, window_frames: 32}
model:
  class_path: Denoiser
  init_args: {tokenizer: duet, network: {width: 24, layers: 1, heads: 2, level_width: 16, agent_width: 16}}
trainer: {accelerator: cpu, max_steps: 4, logger: false, enable_progress_bar: false}
"""

# -- cells that are done once ----------------------------------------------------------------------

CELL = Cell("measure", 0, "salsa", Weights("duet"), "joint_future", scenes=2, samples=2)


def test_a_cell_is_whole_or_not_there(tmp_path: Path) -> None:
    store = Store(tmp_path)
    with pytest.raises(ValueError):
        store.put(CELL, {"rows": {"ours": math.nan}})
    assert not list(tmp_path.rglob("*.json"))
    store.put(CELL, {"rows": {"ours": 1.0}, "seconds": 2.0})
    assert [path.name for path in (tmp_path / "cells").iterdir()] == [f"{CELL.name}.json"]
    again = Store(tmp_path)
    assert again.get(CELL) is not None
    assert again.get(CELL) == store.get(CELL)
    assert again.get(replace(CELL, samples=3)) is None
    assert again.of_kind("measure") == [2.0]
    store.path(CELL).write_text('{"settings": ')
    assert Store(tmp_path).get(CELL) is None


def made_up(cell: Cell, checkpoint: str | None, *_: Any) -> dict[str, Any]:
    """Numbers that only a cell's name and the weights it is given decide."""
    seed = sum(map(ord, f"{cell.name}{Path(checkpoint or '').name}"))
    values = torch.rand(4, generator=torch.Generator().manual_seed(seed)).tolist()
    rows = (
        "ours",
        "ours, the given scored too",
        *("RS", "NN", "zero velocity", "ridge"),
        "training set",
        "ground truth",
    )
    return {"rows": {row: run_of(values) for row in rows}}


class Killed:
    """Stands for the process: ends it, as ctrl-c or a kill does, the n-th time that it works."""

    def __init__(self, at: set[int]) -> None:
        self.at, self.done = at, 0
        self.words: list[list[str]] = []

    def __call__(self, *arguments: Any) -> Any:
        self.done += 1
        if self.done in self.at:
            raise KeyboardInterrupt
        return made_up(*arguments)

    def fit(self, words: list[str]) -> int:
        """A training that is stopped after its first checkpoint, if it is to be."""
        self.words.append(words)
        last = Path(words[words.index("--out") + 1]) / "checkpoints" / "last.ckpt"
        last.parent.mkdir(parents=True, exist_ok=True)
        last.write_text("some weights")
        self.done += 1
        return 130 if self.done in self.at else 0


@pytest.mark.parametrize("name", ["5", "3"])
def test_a_report_that_was_killed_twice_is_the_same(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blocks = {name: TABLES[name](PLAN)}
    pages, trainings = [], []
    for number, at in enumerate([set(), {2, 8}]):
        process = Killed(at)
        monkeypatch.setattr(measure, "run", process)
        folder = tmp_path / str(number)
        for _ in range(3):
            runner = Runner(Store(folder), process.fit, PLAN.configs, "duet", say=lambda _: None)
            try:
                runner.run(cells_of(blocks[name]))
                break
            except KeyboardInterrupt:
                continue
        assert not runner.failed and not runner.missing(cells_of(blocks[name]))
        pages.append(page(blocks, Store(folder), {}, {"budget": "tiny"}).read_text())
        trainings.append([words for words in process.words if "--ckpt_path" in words])
    assert pages[0] == pages[1]
    assert not trainings[0]
    assert len(trainings[1]) == 1  # the second job is a training, which goes on from its last checkpoint
    assert "| FD: Ours < " in pages[0]


def test_what_cannot_be_done_is_said_and_the_rest_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run(cell: Cell, *arguments: Any) -> dict[str, Any]:
        if cell.task == "partner_prediction":
            raise ValueError("this peer fills in partners alone")
        return made_up(cell, *arguments)

    monkeypatch.setattr(measure, "run", run)
    blocks = {"3": TABLES["3"](replace(PLAN, only_shipped=True))}
    store = Store(tmp_path)
    runner = Runner(store, lambda _: 1, PLAN.configs, "duet", say=lambda _: None)
    runner.run(cells_of(blocks["3"]))
    text = page(blocks, store, runner.failed, {}).read_text()
    assert "Ours: this peer fills in partners alone" in text
    assert "| FD: Ours < R2R | section 4.2, partner prediction | not measured | - |" in text
    content = json.loads((tmp_path / "report.json").read_text())
    assert content["tables"]["3"][1]["rows"]["Ours"]["fd"]["low"] is not None
    assert (tmp_path / "pictures" / "3-1.svg").read_text().startswith("<svg ")


def test_a_training_that_fails_is_told_at_every_cell_that_needs_it(tmp_path: Path) -> None:
    blocks = TABLES["5"](PLAN)
    trained = [cell for cell in cells_of(blocks) if cell.model is not None]
    runner = Runner(Store(tmp_path), lambda _: 2, PLAN.configs, "duet", say=lambda _: None)
    runner.run(trained)
    assert set(runner.failed) == set(trained)
    assert all("the training ended with code 2" in said for said in runner.failed.values())


def test_the_time_left_is_told_without_reading_what_is_done_for_every_cell_that_is_left(tmp_path: Path) -> None:
    asked: list[str] = []

    class Counted(Store):
        def of_kind(self, kind: str) -> list[float]:
            asked.append(kind)
            return [60.0]

    said: list[str] = []
    trained = [cell for cell in cells_of(TABLES["5"](PLAN)) if cell.model is not None]
    Runner(Counted(tmp_path), lambda _: 2, PLAN.configs, "duet", say=said.append).run(trained)
    rounds = [line for line in said if line.startswith("[")]
    assert f"about {run.clock(60.0 * len(rounds))} left" in rounds[0]
    assert 0 < len(asked) <= len({cell.kind for cell in trained}) * len(rounds)


# -- the command -----------------------------------------------------------------------------------


def test_a_dry_run_lists_cells_and_runs_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(measure, "run", Killed({1}))
    out = str(tmp_path / "out")
    assert cli.main(["report", "3", "--shipped", "--budget", "tiny", "--dry_run", "--out", out]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"12 cells, 0 done; the other 12 may take \S+ h, guessed for the budget small .*", lines[-1])
    assert not Path(out).exists()
    assert cli.main(["report", "9"]) == 2
    assert "table: got '9', expected one of 2, 3, 4" in capsys.readouterr().err


def test_a_training_that_is_skipped_is_not_run_for_what_needs_it_which_waits_unless_it_is_done(tmp_path: Path) -> None:
    cells = cells_of(TABLES["5"](PLAN))
    done, *others = [cell for cell in cells if cell.kind == "train"]
    store = Store(tmp_path)
    runner = Runner(store, lambda _: 1, PLAN.configs, "duet", say=lambda _: None)
    last = Path("trainings", done.name, "checkpoints", "last.ckpt")
    (tmp_path / last).parent.mkdir(parents=True)
    (tmp_path / last).write_text("some weights")
    store.put(done, {"rows": {}, "checkpoint": str(last)})
    todo = runner.missing(chosen(runner, cells, [""], ["train-"]))
    assert others and todo == [cell for cell in cells if cell.kind != "train" and cell.needs not in others]
    assert done in {cell.needs for cell in todo}
    assert runner.missing(chosen(runner, cells, ["measure-"], [])) == [cell for cell in cells if cell != done]


@pytest.mark.slow
def test_a_small_report_is_made_from_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The shipped weights on two made-up scenes; run again there is nothing left to do."""
    words = ["report", "4", "--shipped", "--budget", "tiny", "--only", "synthetic2", "--out", str(tmp_path)]
    assert cli.main(words) == 0
    first = (tmp_path / "report.md").read_text()
    assert "### joint future of 2 people, synthetic scenes" in first
    rows = json.loads((tmp_path / "report.json").read_text())["tables"]["4"][0]["rows"]
    assert rows["Ours"]["mpjpe"]["value"] > 0
    assert rows["ground truth"].keys() == {"fs", "ip_ratio"}
    capsys.readouterr()
    assert cli.main(words) == 0
    assert "/" not in capsys.readouterr().out.partition("written")[0]


REMOS = """
data: {class_path: Synthetic, init_args: {people: [2], window_frames: 184}}
model: {class_path: magnet.peers.ReMoS, init_args: {tokenizer: duet, network: {width: 24, layers: 1, heads: 2}}}
trainer: {accelerator: cpu, logger: false, enable_progress_bar: false}
"""
DUOBOX = (
    "data: {class_path: DuoBox, init_args: {path: store, body_model: fake/body.npz, max_agents: 2, window_frames: 64}}"
)


@pytest.mark.slow
def test_a_report_on_other_recordings_trains_on_them_by_windows_that_a_peer_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a made-up DuoBox; the peer answers for 182 frames and says so, the file of the data has windows of 64."""
    monkeypatch.chdir(tmp_path)
    assert cli.main(["data", "fake", "duobox", "fake", "--frames", "200", "--takes", "4"]) == 0
    store = ["--root", "fake", "--out", "store", "--workers", "1", "--body", "fake/body.npz"]
    assert cli.main(["data", "prepare", "duobox", *store]) == 0
    Path("peer_remos.yaml").write_text(REMOS, encoding="utf-8")
    Path("data.yaml").write_text(DUOBOX, encoding="utf-8")
    words = ["--budget", "tiny", "--data", "data.yaml", "--configs", ".", "--out", "out"]
    assert cli.main(["report", "2", *words, "--only", "remos-partner_inpainting-data-seed0"]) == 0
    rows = json.loads(Path("out/report.json").read_text(encoding="utf-8"))["tables"]["2"][0]["rows"]
    assert rows["ReMoS"]["mpjpe"]["value"] > 0
    (run_config,) = Path("out/trainings").glob("*/config.yaml")
    trained = yaml.safe_load(run_config.read_text())["data"]
    assert trained["class_path"].endswith("DuoBox") and trained["init_args"]["window_frames"] == 184


@pytest.mark.parametrize(
    ("training", "below", "flags"),
    [
        ("data: Synthetic", "", []),
        ("data: {class_path: Synthetic, init_args: }", "", []),
        ("data: {init_args: {window_frames: 184}}", "", ["--data.window_frames", "184"]),
        ("extends: below.yaml\ndata:", "model: Denoiser\ndata: {init_args: {window_frames: 184}}",
         ["--data.window_frames", "184"]),
        ("extends: below.yaml\nmodel: Denoiser", "data: {init_args: {window_frames: 64}}", []),
    ],
)  # fmt: skip
def test_a_training_asks_for_its_window_by_what_it_extends_and_not_by_data_that_are_replaced(
    training: str, below: str, flags: list[str], tmp_path: Path
) -> None:
    (tmp_path / "below.yaml").write_text(below, encoding="utf-8")
    (tmp_path / "training.yaml").write_text(training, encoding="utf-8")
    assert own_window(tmp_path / "training.yaml") == flags


class Gone(BaseException):
    """Stands for a kill: nothing that is to be done at an ordinary end is done."""


@pytest.mark.slow
def test_a_training_and_a_measurement_that_were_killed_give_what_they_give_undisturbed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A kill in step 3 of 4, with a checkpoint of step 2, and one after a measurement, before its file is there."""
    (tmp_path / "base.yaml").write_text(TINY_TRAINING, encoding="utf-8")
    monkeypatch.setattr(run, "CHECKPOINTED", 2)
    weights = Weights(config="base", steps=4, batch=2)
    measured = Cell("measure", 0, "synthetic2", weights, "joint_future", scenes=2, samples=2)
    assert measured.needs is not None
    step, measuring, kills = Denoiser.training_step, measure.run, []

    def killed_step(self: Denoiser, batch: Any, batch_idx: int) -> torch.Tensor:
        if self.global_step == 2 and not kills:
            kills.append("training")
            raise Gone
        return step(self, batch, batch_idx)

    def killed_measurement(*words: Any) -> Any:
        result = measuring(*words)
        if len(kills) < 2:
            kills.append("measurement")
            raise Gone
        return result

    found = []
    for name, disturbed in (("calm", False), ("killed", True)):
        store = Store(tmp_path / name)
        if disturbed:
            monkeypatch.setattr(Denoiser, "training_step", killed_step)
            monkeypatch.setattr(measure, "run", killed_measurement)
        for _ in range(3 if disturbed else 1):
            runner = Runner(store, lambda words: run_trainer("fit", words), tmp_path, "duet", say=lambda _: None)
            with contextlib.suppress(Gone):
                runner.run([measured.needs, measured])
        assert not runner.failed
        content, trained = store.get(measured), store.get(measured.needs)
        assert content is not None and trained is not None
        found.append((content["rows"], Denoiser.load(store.folder / trained["checkpoint"]).state_dict()))
    assert kills == ["training", "measurement"]
    (rows, calm), (again, killed) = found
    assert rows == again
    assert all(torch.equal(value, killed[name]) for name, value in calm.items())


def test_a_report_goes_on_from_packed_cells_and_trains_again_only_what_is_wanted(tmp_path: Path) -> None:
    weights = Weights(config="base", steps=2)
    first, second = (Cell("measure", 0, "salsa", weights, "joint_future", scenes=n, samples=2) for n in (2, 3))
    assert first.needs is not None
    store = Store(tmp_path / "there")
    store.put(first.needs, {"rows": {}, "checkpoint": "trainings/some", "seconds": 1.0})
    rows = {"ours": {"value": {"fd": 1 / 3}, "without": {}}}
    store.put(first, {"rows": rows, "seconds": 2.0})
    store.pack()
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    (folder / "cells.json").write_text(
        (tmp_path / "there" / "cells.json").read_text(encoding="utf-8"), encoding="utf-8"
    )
    runner = Runner(Store(folder), lambda _: 0, PLAN.configs, "duet")
    content = runner.store.get(first)
    assert content is not None and content["rows"]["ours"]["value"]["fd"] == pytest.approx(1 / 3, rel=1e-6)
    assert runner.store.of_kind("measure") == [2.0]
    assert not runner.missing([first.needs, first])
    assert runner.missing([first.needs, first, second]) == [first.needs, second]


def test_the_page_says_what_its_cells_took_and_which_code_ran_them() -> None:
    training = Cell("train", 0, model=Weights(config="base"))
    cells = [training, CELL, replace(CELL, seed=1), replace(CELL, seed=2), replace(CELL, model=None)]
    found = [
        {"seconds": 3600.0, "code": "1a2b3c4"},
        {"seconds": 600.0, "processor_seconds": 120.0, "code": "5d6e7f8"},
        {"seconds": 1200.0, "processor_seconds": 240.0, "code": "5d6e7f8"},
        {"seconds": 60.0},
        {"seconds": 0.0, "code": ""},
    ]
    done = dict(zip(cells, found, strict=True))
    assert took(done, 7) == {
        "cells": "5 of 7",
        "time on the clock": "1:31 h, one cell after another (measure 4 in 0:31 h, train 1 in 1:00 h)",
        "processor time": "0:06 h of the 2 cells that kept it",
    }
    assert by_code(done)[-4:-1] == [
        "- 5d6e7f8: 2 cells (measure duet 2)",
        "- 1a2b3c4: 1 cells (train base 1)",
        "- code that was not kept: 2 cells (measure duet 1, measure floors 1)",
    ]
    assert took({}, 7) == {} and by_code({}) == []


def test_a_cell_keeps_the_code_and_the_time_that_it_took(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def work(*arguments: Any) -> dict[str, Any]:
        end = time.process_time() + 0.15
        while time.process_time() < end:
            pass
        return made_up(*arguments)

    monkeypatch.setattr(measure, "run", work)
    store = Store(tmp_path)
    Runner(store, lambda _: 0, PLAN.configs, "duet", code="1a2b3c4+", say=lambda _: None).run([CELL])
    content = Store(tmp_path).get(CELL)
    assert content is not None and content["code"] == "1a2b3c4+"
    assert content["processor_seconds"] >= 0.1 and content["seconds"] >= 0.1


def test_the_first_screen_counts_what_holds_and_names_what_is_missing() -> None:
    claims = [
        {"claim": f"FD: Ours < {worse}", "verdict": said, "difference": "-1"}
        for worse, said in (("RS", "holds"), ("R2R", "does not hold"), ("NN", "holds"), ("ReMoS", "cannot be told"))
    ]
    tables = {
        "3": [{"title": "dyadic", "claims": claims, "incomplete": ["R2R 2 of 3", "Ours 0 of 3"]}],
        "A.4": [{"title": "people", "claims": [], "incomplete": []}],
    }
    lines = summary(tables)
    assert "| 3 | 2 | 1 | 1 |  |" in lines and "| all | 2 | 1 | 1 | 0 |" in lines
    assert "- 3, dyadic: FD: Ours < RS (-1); FD: Ours < NN (-1)" in lines
    assert "- 3, dyadic: FD: Ours < R2R (-1)" in lines
    assert "- 3, dyadic: R2R 2 of 3, Ours 0 of 3" in missing(tables)
    assert missing({"A.4": tables["A.4"]}) == []
