"""How far a run is, in lines and in bars."""

from __future__ import annotations

import re
import sys

import pytest

from magnet.cli import run_progress
from tests.evaluation.test_evaluator import data, prepared


def test_what_is_left_is_reckoned_from_the_second_step_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first step waited 40 seconds for data; 2 seconds each are what is to come."""
    now = iter([0.0, 40.0, 42.0, 80.0])
    monkeypatch.setattr(run_progress.time, "monotonic", lambda: next(now))
    lines = run_progress.ProgressLines(seconds=30.0)
    for done in (1, 2, 21):
        lines.tell("test: denoising step", done, 64)
    said = capsys.readouterr().out.splitlines()
    assert said == ["test: denoising step 1/64", "test: denoising step 21/64, 0:01:26 left"]


@pytest.mark.parametrize("terminal", [True, False])
def test_what_is_measured_after_sampling_is_counted_too(
    terminal: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A model and its truth, in each of three batches of three scenes."""
    monkeypatch.setattr(sys.stdout, "isatty", lambda: terminal)
    progress = run_progress.progress_bar(sampling=True)
    progress.lines.seconds = 0.0
    evaluator, trainer = prepared(baselines=False)
    trainer.callbacks.append(progress)
    trainer.test(evaluator, datamodule=data(), verbose=False)
    said = capsys.readouterr().out
    assert ("test: denoising steps" if terminal else "test: denoising step 1/") in said
    if terminal:
        assert re.search(r"test: measuring .*9/9", said)
    else:
        assert [f"{done}/9" for done in range(1, 10)] == re.findall(r"test: measuring (\d+/\d+)", said)


@pytest.mark.parametrize("terminal", [True, False])
@pytest.mark.parametrize("baselines", [True, False])
def test_what_baselines_learn_from_is_said_to_be_read_before_the_first_step(
    baselines: bool, terminal: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: terminal)
    progress = run_progress.progress_bar(sampling=True)
    progress.lines.seconds = 0.0
    evaluator, trainer = prepared(baselines=baselines, samples=1)
    trainer.callbacks.append(progress)
    trainer.test(evaluator, datamodule=data(limit=1), verbose=False)
    said = capsys.readouterr().out
    before = said[: said.index("test: denoising step")]
    assert ("test: reading training windows" in before) == baselines
    assert bool(re.search(r"test: reading training windows .*1/1", said)) == (baselines and terminal)
