"""The open benchmark: what a submission must be, that its numbers are what they say, and the split file."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from magnet.datamodules.cmu import CMUReader
from magnet.evaluation.benchmark import Benchmark, BenchmarkTakes, write_inputs
from magnet.evaluation.methods import baseline
from magnet.evaluation.submission import Submission, answered, score
from magnet.motion.scene import concatenate
from magnet.tasks.joint import JointFuture
from magnet.tasks.partner import PartnerInpainting
from tests.datamodules.fakes import FakeData
from tests.evaluation.test_evaluator import data

SAMPLES, CONTEXT, HORIZON = 3, 16, 20


@functools.cache
def made() -> tuple[Benchmark, FakeData, torch.Tensor]:
    """A benchmark of made-up scenes, their data and the recorded futures as (B, 1, horizon, P, 22, 3)."""
    datamodule = data(max_agents=2)
    scenes = concatenate(list(datamodule.test_dataloader()))
    small = {"context_frames": CONTEXT, "horizon_frames": HORIZON, "samples": SAMPLES, "scenes": scenes.names}
    return replace(Benchmark.read(), **small), datamodule, datamodule.body.joints(scenes.slice(CONTEXT))[:, None]


def submitted(joints: torch.Tensor, task: str = "joint_future", method: str = "mine") -> Submission:
    benchmark = made()[0]
    return Submission(benchmark.label, task, method, benchmark.scenes, joints)


def rows(*submissions: Submission, baselines: bool = False) -> dict[str, dict[str, float]]:
    benchmark, datamodule, _ = made()
    (results,) = score(benchmark, datamodule, submissions, baselines).values()
    return results.rows


def test_a_submission_is_off_by_as_much_as_it_was_moved(tmp_path: Path) -> None:
    benchmark, _, truth = made()
    moved = truth + torch.tensor([0.0, 0.05, 0.0])  # up, which is up in every world
    path = submitted(moved).save(tmp_path / "moved.npz", benchmark.fps)
    found = rows(submitted(truth, method="recorded"), Submission.load(path, benchmark))
    assert found["recorded"]["mpjpe"] == pytest.approx(0, abs=1e-5)
    assert found["mine"]["mpjpe"] == pytest.approx(0.05, rel=1e-4)
    assert found["mine"]["mpjve"] == pytest.approx(0, abs=1e-5)
    assert found["mine"]["fd"] == pytest.approx(21 * 0.05**2, rel=0.05)


def test_the_order_of_scenes_and_whatever_is_given_make_no_difference(tmp_path: Path) -> None:
    benchmark, _, truth = made()
    noise = torch.randn(SAMPLES, *truth.shape[2:], generator=torch.Generator().manual_seed(0))
    joints = truth + 0.1 * noise
    plain = rows(submitted(joints, "partner_prediction"))["mine"]
    joints[:, :, :, 1] = torch.nan  # of who is given
    turned = Submission(benchmark.label, "partner_prediction", "mine", benchmark.scenes[::-1], joints.flip(0))
    again = rows(Submission.load(turned.save(tmp_path / "turned", benchmark.fps), benchmark))["mine"]
    assert again == pytest.approx(plain, rel=1e-6, nan_ok=True)


def test_a_baseline_handed_in_scores_as_the_baseline_beside_it() -> None:
    """Random samples too: their noise is the scene's own."""
    benchmark, datamodule, _ = made()
    names, joints = answered(datamodule, baseline("RS", JointFuture(), datamodule), SAMPLES)
    assert tuple(names) == benchmark.scenes
    found = rows(submitted(joints, method="RS"), baselines=True)
    assert {"RS", "RS ()", "NN", "training set", "ground truth"} <= set(found)
    assert found["RS ()"]["mpjpe"] == pytest.approx(found["RS"]["mpjpe"], rel=1e-6)
    assert found["RS ()"]["fd"] == pytest.approx(found["RS"]["fd"], rel=1e-6)
    with pytest.raises(ValueError, match="which PartnerInpainting does not give; name a model"):
        baseline("NN", PartnerInpainting(), datamodule)


@pytest.mark.parametrize("task", Benchmark.read().tasks)
def test_inputs_hold_what_a_task_gives_and_nothing_else(task: str, tmp_path: Path) -> None:
    benchmark, datamodule, truth = made()
    with np.load(write_inputs(benchmark, datamodule, task, tmp_path / "in.npz")) as file:
        read = dict(file)
    assert read["known"][CONTEXT:, 0].sum() == 0  # the future of who is generated
    assert read["known"][:, 1].all() == (task in ("partner_inpainting", "motion_control"))
    assert read["known"][:CONTEXT, 0].all() == (task != "partner_inpainting")
    assert read["scored"].sum() == HORIZON * (2 if task == "joint_future" else 1)
    for key in ("joints", "T_world_root", "body_rotations"):
        there = np.isfinite(read[key]).reshape(*read[key].shape[:3], -1)
        assert (there == read["known"][None, ..., None]).all()
    if task == "partner_inpainting":
        np.testing.assert_allclose(read["joints"][:, CONTEXT:, 1], truth[:, 0, :, 1], atol=1e-5)


Arrays = dict[str, Any]
BROKEN: dict[str, tuple[Callable[[Arrays], Any], str]] = {
    "another frame rate": (lambda a: a.update(fps=20.0), r"fps: got 20.0, expected 30; resample"),
    "no frame rate": (lambda a: a.update(fps=np.nan), "fps: got nan, expected 30"),
    "a frame rate as text": (lambda a: a.update(fps="30"), "fps: got '30', expected 30"),
    "Python objects": (
        lambda a: a.update(scenes=np.array(list(a["scenes"]), dtype=object)),
        r"b\.npz: scenes: got Python objects, expected text or numbers",
    ),
    "two methods": (lambda a: a.update(method=["a", "b"]), r"method: got \['a', 'b'\], expected one text"),
    "another benchmark": (lambda a: a.update(benchmark="x-1"), "benchmark: got 'x-1', expected 'cmu-salsa-duets-1'"),
    "another task": (lambda a: a.update(task="dance"), "task: got 'dance', expected one of joint_future"),
    "a scene lost": (lambda a: a.update(scenes=a["scenes"][1:], joints=a["joints"][1:]), r"lacks test0 \[0:36\]"),
    "a scene twice": (lambda a: a.update(scenes=[a["scenes"][1], *a["scenes"][1:]]), r"has twice test0 \[36:72\]"),
    "a strange scene": (lambda a: a.update(scenes=["odd", *a["scenes"][1:]]), "has the unknown odd"),
    "too few samples": (lambda a: a.update(joints=a["joints"][:, :2]), r"\(9, 2, 20, 2, 22, 3\), expected floats"),
    "too few frames": (lambda a: a.update(joints=a["joints"][:, :, 1:]), r"\(9, 3 or 1, 20, 2, 22, 3\): scenes"),
    "no axes": (lambda a: a.update(joints=np.zeros(3)), r"got float64 \(3,\), expected floats"),
    "whole numbers": (lambda a: a.update(joints=a["joints"].astype(int)), "got int64"),
    "no number": (
        lambda a: a["joints"].__setitem__((4, 1, 7, 1, 0, 0), np.nan),
        "scene 4, sample 1, frame 7, person 1",
    ),
    "too large": (
        lambda a: a.update(joints=np.where(a["joints"] == a["joints"].max(), 1e300, a["joints"].astype(float))),
        "not finite as float32 in scene",
    ),
    "no joints": (lambda a: a.pop("joints"), "lacks joints; it has benchmark, fps, method, scenes, task"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_submission_is_refused_with_what_to_do(name: str, tmp_path: Path) -> None:
    benchmark, _, truth = made()
    with np.load(submitted(truth.expand(-1, SAMPLES, -1, -1, -1, -1)).save(tmp_path / "a.npz", 30)) as file:
        arrays = dict(file)
    change, said = BROKEN[name]
    change(arrays)
    np.savez(tmp_path / "b.npz", **arrays)
    with pytest.raises(ValueError, match=said):
        Submission.load(tmp_path / "b.npz", benchmark)


def test_text_may_be_written_as_bytes(tmp_path: Path) -> None:
    benchmark, _, truth = made()
    with np.load(submitted(truth.expand(-1, SAMPLES, -1, -1, -1, -1)).save(tmp_path / "a.npz", 30)) as file:
        arrays = {key: value.astype("S") if value.dtype.kind == "U" else value for key, value in dict(file).items()}
    np.savez(tmp_path / "b.npz", **arrays)
    read = Submission.load(tmp_path / "b.npz", benchmark)
    assert (read.method, read.scenes) == ("mine", benchmark.scenes)


def test_a_file_that_is_no_npz_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.npz").write_text("no")
    with pytest.raises(ValueError, match="not a readable npz"):
        Submission.load(tmp_path / "a.npz", made()[0])


def test_other_recordings_are_refused() -> None:
    benchmark, datamodule, _ = made()
    with pytest.raises(ValueError, match=r"test0 \[0:36\] is new \(9 scenes, expected 8\); get the recordings anew"):
        replace(benchmark, scenes=benchmark.scenes[1:]).check(datamodule)


def test_the_split_is_by_take_and_its_scenes_do_not_overlap() -> None:
    benchmark = Benchmark.read()
    takes = [name for names in benchmark.takes.values() for name in names]
    assert len(takes) == len(set(takes)) == 11
    spans: dict[str, list[tuple[int, int]]] = {}
    for scene in benchmark.scenes:
        take, _, frames = scene.partition(" ")
        first, last = map(int, frames.strip("[]").split(":"))
        assert last - first == benchmark.context_frames + benchmark.horizon_frames
        spans.setdefault(take, []).append((first, last))
    assert set(spans) == set(benchmark.takes["test"])
    for each in spans.values():
        assert all(before[1] <= after[0] for before, after in itertools.pairwise(each))


def test_the_split_names_every_real_take_of_the_couple(cmu_root: Path) -> None:
    found = CMUReader(cmu_root, singles=False).found()
    split = {name: split for split, names in Benchmark.read().takes.items() for name in names}
    assert {take.name: take.split for take in found if take.name.startswith("60_")} == split


@pytest.mark.slow
def test_real_recordings_give_the_benchmarks_scenes(cmu_root: Path, tmp_path: Path) -> None:
    """The test takes alone, fitted anew; the recorded future handed in is at no distance from itself."""
    benchmark = Benchmark.read()
    for path in [*cmu_root.rglob("6[01].asf"), *cmu_root.rglob("6[01]_05.amc"), *cmu_root.rglob("6[01]_1[05].amc")]:
        (tmp_path / path.name).symlink_to(path)
    datamodule = BenchmarkTakes(benchmark, root=str(tmp_path), cache=str(tmp_path / "cache"))
    benchmark.check(datamodule)
    truth = datamodule.body.joints(concatenate(list(datamodule.test_dataloader())).slice(benchmark.context_frames))
    handed = Submission(benchmark.label, "joint_future", "recorded", benchmark.scenes, truth[:, None])
    (results,) = score(benchmark, datamodule, [handed], baselines=False).values()
    assert results.rows["recorded"]["mpjpe"] == pytest.approx(0, abs=1e-5)
    assert results.rows["recorded"]["fs"] == pytest.approx(results.rows["ground truth"]["fs"], rel=1e-3)


def test_a_methods_name_is_one_line_and_a_folder_is_no_submission(tmp_path: Path) -> None:
    benchmark, _, truth = made()
    path = submitted(truth, method=" two\nlines ").save(tmp_path / "a.npz", benchmark.fps)
    assert Submission.load(path, benchmark).method == "two lines"
    with pytest.raises(ValueError, match=r"is a folder, expected a submission's npz, such as .*\*\.npz"):
        Submission.load(tmp_path, benchmark)
