"""`magnet score`: what it says where it cannot score."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from magnet import cli
from magnet.cli import outputs, score
from magnet.evaluation import benchmark, submission
from magnet.evaluation.results import Results
from magnet.testing import tiny_denoiser
from tests.datamodules.fakes import FakeData


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "nothing to score: name files"),
        (("none.npz",), "none.npz: no such file"),
        (("--inputs", "in.npz", "--task", "dance"), "task: got 'dance', expected one of joint_future"),
        (("a.npz",), "a.npz: lacks benchmark, task, method, fps, scenes; it has joints"),
        (("--inputs", "in.npz", "--root", "nowhere"), "nowhere: no such folder"),
    ],
)
def test_what_cannot_be_scored_is_said_in_a_line(
    words: tuple[str, ...], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    np.savez("a.npz", joints=np.zeros(3))
    assert cli.main(("score", *words)) == 2
    error = capsys.readouterr().err
    assert said in error
    assert "Traceback" not in error


def test_the_tables_of_all_tasks_are_written_before_one_is_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    tables = {task: Results({"mine": {"fd": 1.0}}) for task in ("joint_future", "motion_control")}
    monkeypatch.setattr(submission, "score", lambda *words: tables)
    monkeypatch.setattr(submission, "doubted", lambda *words: ["a.npz: legs are 3 m long"])

    def closed(*words: object, **more: object) -> None:
        raise BrokenPipeError

    monkeypatch.setattr(outputs, "print_table", closed)
    with pytest.raises(BrokenPipeError):
        score.show(score.parser().parse_args(["--out", str(tmp_path)]), None, None, [])
    assert capsys.readouterr().err == "magnet: a.npz: legs are 3 m long\n"
    assert all((tmp_path / task / "results.json").exists() for task in tables)


def test_inputs_are_written_under_the_whole_name_that_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    class NoTakes:
        def __init__(self, *words: object, **more: object) -> None: ...
        def prepare_data(self) -> None: ...

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(benchmark, "BenchmarkTakes", NoTakes)
    monkeypatch.setattr(benchmark.Benchmark, "check", lambda *words: None)
    monkeypatch.setattr(benchmark, "write_inputs", lambda *words: words[-1])
    for name, written in (("my.scenes.v2", "my.scenes.v2.npz"), ("scenes.npz", "scenes.npz")):
        assert cli.main(["score", "--inputs", name]) == 0
        assert f"written: {written}, not to be passed on" in capsys.readouterr().out


@pytest.mark.parametrize("trained", ["smplx-neutral", "open-1"])
def test_an_example_by_a_model_that_learned_from_another_body_says_so(
    trained: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    model, answer = tiny_denoiser(), torch.zeros(1, 1, 4, 2, 22, 3)
    model.trained_body = trained
    monkeypatch.setattr("magnet.denoiser.core.DenoiserCore.load", lambda _: model)
    monkeypatch.setattr("magnet.evaluation.methods.model", lambda *_: None)
    monkeypatch.setattr(submission, "answered", lambda *_: (["a"], answer))
    given = score.parser().parse_args(["--example", str(tmp_path / "out.npz"), "--method", "duet"])
    score.example(given, benchmark.Benchmark.read(), FakeData([]))
    said = "magnet: the model was trained with body 'smplx-neutral', but these people have 'open-1', "
    assert (said in capsys.readouterr().err) == (trained != "open-1")
