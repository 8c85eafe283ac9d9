"""`magnet compare`: two results, scene by scene."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from magnet import cli
from magnet.cli import compare, outputs
from magnet.evaluation.by_scene import SceneValues
from magnet.evaluation.results import Results
from magnet.sampling.guidance import Guidance
from magnet.sampling.options import SamplerOptions


def results_in(folder: Path, worse: float = 0.0, scenes: int = 12, first: int = 0, **facts: object) -> Path:
    """The results of a test whose MPJPE is so much worse than chance; NN has half a metre more."""
    error = np.random.default_rng(0).uniform(0.2, 0.8, size=first + scenes)[first:] + worse
    rows = {}
    for name, values in {"magnet": error, "NN": error + 0.5}.items():
        rows[name] = {metric: np.stack([values, np.full(scenes, 3.0)], axis=1) for metric in ("mpjpe@1s", "mpjve")}
    names = tuple(f"take [{n}:{n + 1}]" for n in range(first, first + scenes))
    means = {name: {metric: float(each[:, 0].mean()) for metric, each in row.items()} for name, row in rows.items()}
    results = Results(means, {"task": "joint_future", "samples": 10, **facts})
    outputs.write_results(
        Results(results.rows, results.meta, {}, SceneValues(names, tuple(range(scenes)), rows)), folder, {}
    )
    return folder


def said(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    assert cli.main(["compare", *map(str, words)]) == 0
    return capsys.readouterr().out


def test_two_results_are_compared_over_their_scenes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one, other = results_in(tmp_path / "a", 0.1), results_in(tmp_path / "b")
    text = said(capsys, one, other)
    assert "magnet (A) and magnet (B), 12 scenes of both (12 independent)" in text
    (line,) = [line.split() for line in text.splitlines() if "MPJPE" in line]
    assert line[-5:] == ["-0.100", "[-0.100,", "-0.100]", "magnet", "(B)"]
    assert "MPJVE" not in text and "MPJVE" in said(capsys, one, other, "--full")
    assert "settings differ" not in text
    assert "cannot be told" in said(capsys, one, one / "scenes.json")


def test_two_rows_of_one_result_are_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = said(capsys, results_in(tmp_path / "a"), "--rows", "NN", "magnet")
    (line,) = [line.split() for line in text.splitlines() if "MPJPE" in line]
    assert line[-4:] == ["-0.500", "[-0.500,", "-0.500]", "magnet"]


def test_what_is_not_alike_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = results_in(tmp_path / "a", samples={"magnet": 1})
    text = said(capsys, one, results_in(tmp_path / "b", first=2, task="generation"))
    assert "10 scenes of both" in text
    assert "4 scenes are in one of them alone" in text, "the first two of one, the last two of the other"
    assert "settings differ: task joint_future / generation, samples 1 / 10\n" in text
    assert "1 scene is in one of them alone" in said(capsys, one, results_in(tmp_path / "c", scenes=11))


def recorded_in(folder: Path, speed: float, task: str = "joint_future") -> Path:
    """Results with a row of recordings, whose feet slide so fast."""
    scenes = 6
    rows = {"magnet": {"fs": np.stack([np.linspace(0.2, 0.3, scenes), np.ones(scenes)], axis=1)}}
    rows["ground truth"] = {"fs": np.stack([np.linspace(0.1, 0.2, scenes) * speed, np.ones(scenes)], axis=1)}
    values = SceneValues(tuple(f"take [{n}:{n + 1}]" for n in range(scenes)), tuple(range(scenes)), rows)
    means = {name: {"fs": float(each["fs"][:, 0].mean())} for name, each in rows.items()}
    outputs.write_results(Results(means, {"task": task}, {}, values), folder, {})
    return folder


def test_other_recordings_under_the_same_names_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = recorded_in(tmp_path / "a", 1.0)
    text = said(capsys, one, recorded_in(tmp_path / "b", 1.3))
    assert "recordings differ in 6 of them, such as take [0:1]; ground truth has other numbers there" in text
    assert "recordings differ" not in said(capsys, one, recorded_in(tmp_path / "c", 1.0001))
    text = said(capsys, one, recorded_in(tmp_path / "d", 1.3, task="partner_prediction"))
    assert "settings differ: task" in text and "recordings differ" not in text


def test_options_that_differ_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    held = SamplerOptions(settle="hold", steps=16, smooth_path=True)
    firm = SamplerOptions(settle="firm", steps=8, smooth_path=False, guidance=Guidance(weight=2.0))
    one = results_in(tmp_path / "a", sampler=asdict(held), seed=1, **{"task options": "Own(block=1, at=(0, 1))"})
    task = "Own(block=2, at=(0, 2), least=-inf)"
    other = results_in(tmp_path / "b", sampler=asdict(firm), **{"task options": task})
    text = said(capsys, one, other)
    line = "steps 16 / 8, settle hold / firm, smooth_path true / false, guidance.weight 1.0 / 2.0, block 1 / 2"
    assert f"settings differ: {line}\n" in text
    assert "settings differ" not in said(capsys, one, one / "results.json")
    assert compare.scalars("Mine(3) of x") == compare.scalars("") == {}, "a task whose repr is its own"


def test_two_checkpoints_of_one_name_are_told_apart(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    digests = {name: {"checkpoint": "last.ckpt", "checkpoint sha256": name * 64} for name in "cd"}
    text = said(capsys, *(results_in(tmp_path / name, **facts) for name, facts in digests.items()))
    assert "last.ckpt (sha256 cccccccccccc)\n" in text and "last.ckpt (sha256 dddddddddddd)\n" in text


def test_folders_and_the_ground_truth_that_decides_are_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folders = [results_in(tmp_path / name, checkpoint=at) for name, at in (("a", "runs/1/last.ckpt"), ("b", "None"))]
    for folder, hands in zip(folders, (0.9, 0.5), strict=True):
        values = SceneValues.load(folder / "scenes.json")
        for row, each in {"magnet": hands, "ground truth": 0.6}.items():
            values.rows.setdefault(row, {})["hand_contact"] = np.full((12, 2), [each, 3.0])
        values.save(folder / "scenes.json")
    text = said(capsys, *folders)
    assert f"\nA: {folders[0]}, checkpoint runs/1/last.ckpt\nB: {folders[1]}\n" in text
    (line,) = [line.split() for line in text.splitlines() if "hands" in line]
    assert line == ["hands", "→", "0.900", "0.500", "0.600", "-0.400", "[-0.400,", "-0.400]", "magnet", "(B)"]
    (line,) = [line.split() for line in text.splitlines() if "MPJPE" in line]
    assert line[3] == line[4] and line[5] == "0", "no ground truth of what is best when low"
    assert " ground " in text and " ground " not in said(capsys, results_in(tmp_path / "c"), "--rows", "NN", "magnet")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["a"], "got 1 folder, expected two, or one with --rows ROW ROW"),
        (["a", "nowhere"], "nowhere: is not there, expected a folder that magnet test or magnet score"),
        (["a", "."], ".: has no results.json, expected a folder that magnet test or"),
        (["a", "old"], "old: has no scenes.json"),
        (["a", "--rows", "magnet", "nn"], "no row nn; there are magnet, NN. See a"),
        (["a", "far"], "no common test scenes: one has take [0:1], the other take [50:51]"),
    ],
)
def test_what_cannot_be_compared_is_said_in_a_line(
    words: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    results_in(Path("a")), results_in(Path("far"), first=50), results_in(Path("old"))
    Path("old/scenes.json").unlink()
    assert cli.main(["compare", *words]) == 2
    error = capsys.readouterr().err
    assert message in error and len(error.splitlines()) == 1
