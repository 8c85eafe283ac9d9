"""What `magnet bench` measures: counts that do not depend on the machine, and its files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from magnet import cli
from magnet.bench import speed
from magnet.bench.speed import products_of
from magnet.sampling.grid import planning_grid
from magnet.sampling.options import SamplerOptions
from magnet.tasks import registry
from magnet.testing.models import tiny_denoiser
from tests.cases import few


def test_products_are_those_of_the_network_and_can_be_run_again() -> None:
    one, other = torch.randn(3, 4), torch.randn(4, 5)
    products, operators = products_of(lambda: (one @ other).relu() + 1)
    assert len(products) == 1 and operators == 3
    assert torch.equal(products[0](), one @ other)


@pytest.mark.parametrize("task", few(registry.names(), 3))
def test_counts_are_those_of_the_plan(task: str) -> None:
    model = tiny_denoiser(max_agents=2)
    options = SamplerOptions(steps=2)
    found = speed.measure(model, speed.Case(task, 2, 2), options, frames=16, rounds=1)
    context = 0 if task in speed.FROM_NOTHING else speed.CONTEXT
    tokens = (context + 16) // 4
    plan = registry.get(task)().schedule(planning_grid(tokens, 2, context // 4, model.window, options))
    assert found.evaluations_per_frame == plan.evaluations / 16
    assert found.windows_per_frame >= found.evaluations_per_frame
    assert found.operators > 20 and found.evaluation_ms > 0 and found.floor_ms > 0
    assert "denoise" not in vars(model), "the model is left as it was"


def test_recordings_are_timed_where_evaluations_are_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    """They were watched, and what is watched is not recorded."""
    asked: list[int] = []

    def replayed(graphs: Any, run: Any, inputs: Any) -> torch.Tensor:
        asked.append(len(inputs["noisy"]))
        return run(**inputs)

    for place in ("magnet.denoiser.compiled", "magnet.bench.speed"):
        monkeypatch.setattr(f"{place}.records", lambda tensor: True)
    monkeypatch.setattr("magnet.denoiser.compiled.replayed", replayed)
    model, rounds = tiny_denoiser(max_agents=2), 2
    options = SamplerOptions(steps=2, compile=True)
    found = speed.measure(model, speed.Case("joint_future", 2, 3), options, frames=16, rounds=rounds)
    # One run that records and each round ask all; one question more shows that it is recorded, one a round is timed.
    assert asked == [3] * round((rounds + 1) * 16 * found.evaluations_per_frame + 1 + rounds)
    assert found.evaluation_ms > 0 and "denoise" not in vars(model)


def test_cases_leave_out_what_one_alone_cannot_do() -> None:
    names = [str(case) for case in speed.cases(["joint_future", "motion_control"], [1, 2], [1])]
    assert names == [
        "joint_future, 1 people, batch 1",
        "joint_future, 2 people, batch 1",
        "motion_control, 2 people, batch 1",
    ]


def test_the_command_writes_what_it_measured_and_compares_it(tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.setattr("magnet.cli.bench.load", lambda name: tiny_denoiser(max_agents=2))
    out = tmp_path / "bench.json"
    words = ["bench", "--quick", "--task", "joint_future", "--frames", "8", "--rounds", "1", "--steps", "2"]
    assert cli.main([*words, "--live", "0.2", "--out", str(out)]) == 0
    found = json.loads(out.read_text())
    assert found["machine"]["cores"] and found["git"] is not None and found["sampler"]["steps"] == 2
    assert found["live"]["answers"] == 2
    assert cli.main([*words, "--live", "0", "--compare", str(out)]) == 0
    last = capsys.readouterr().out.splitlines()[-1].split()
    assert last[:5] == ["joint_future,", "2", "people,", "batch", "1"]
    assert float(last[5 + 3]) == 1.0, "evaluations a frame are the same"
    other = {"cases": {"generation, 2 people, batch 1": {}}, "live": None}
    out.write_text(json.dumps(other))
    assert cli.main([*words, "--live", "0", "--compare", str(out)]) == 0
    assert "nothing to compare: the other run measured generation, 2 people" in capsys.readouterr().out
    case = "joint_future, 2 people, batch 1"
    for damaged in (
        [],
        {"cases": {case: {"evaluation_ms": "12"}}},
        {"cases": {case: None}},
        {"cases": {case: {"evaluation_ms": -1}}},
        {"cases": {}, "live": [1]},
        {"cases": {}, "live": {"median_ms": 0}},
        {"cases": {}, "live": {"answers": 3}},
        {"cases": {}, "git": "abc"},
    ):
        out.write_text(json.dumps(damaged))
        assert cli.main([*words, "--compare", str(out)]) == 2
        said = capsys.readouterr()
        assert "not a file that" in said.err and "evals" not in said.out, "before anything is measured"
    assert cli.main([*words[:-1], "0"]) == 2


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--people 0", "--people is 0, expected at least 1"),
        ("--batch 0", "--batch is 0, expected at least 1"),
        ("--live -1", "--live is -1, expected seconds"),
        ("--device nonsense", "device: got 'nonsense'"),
        ("--people 5", "--people is 5, expected at most the model's 2"),
        ("--people 1 --task motion_control", "none of motion_control is for 1 people"),
    ],
)
def test_what_would_measure_nothing_is_refused(words: str, said: str, capsys, monkeypatch) -> None:
    monkeypatch.setattr("magnet.cli.bench.load", lambda name: tiny_denoiser(max_agents=2))
    assert cli.main(["bench", "--quick", "--live", "0", *words.split()]) == 2
    assert said in capsys.readouterr().err


def test_options_go_to_the_tasks_that_have_them(tmp_path: Path, capsys, monkeypatch) -> None:
    """Turns that overlap by half take fewer evaluations; a task without turns is measured as it is."""
    monkeypatch.setattr("magnet.cli.bench.load", lambda name: tiny_denoiser(max_agents=2))
    out = tmp_path / "bench.json"
    words = ["bench", "--quick", "--task", "agentic_async", "--task", "joint_future", "--frames", "8", "--rounds", "1"]
    words += ["--steps", "4", "--live", "0", "--out", str(out)]
    assert cli.main(words) == 0
    plain = json.loads(out.read_text())["cases"]
    assert cli.main([*words, "--task.offset", "0.5", "--task.order=[1, 0]"]) == 0
    found = json.loads(out.read_text())
    assert found["task_options"] == {"offset": 0.5, "order": [1, 0]}
    joint, turns = "joint_future, 2 people, batch 1", "agentic_async, 2 people, batch 1"
    each = {name: case["evaluations_per_frame"] for name, case in found["cases"].items()}
    before = {name: case["evaluations_per_frame"] for name, case in plain.items()}
    overlapped = f"{turns}, offset 0.5, order (1, 0)"
    assert set(each) == {joint, overlapped}
    assert each[joint] == before[joint]
    assert each[overlapped] == 0.75 * before[turns]
    capsys.readouterr()
    assert cli.main([*words, "--task.offsett", "0.5"]) == 2
    assert "offset" in capsys.readouterr().err
    assert cli.main([*words, "--task.offset"]) == 2
    assert cli.main([*words, "--task.offset", "2"]) == 2
