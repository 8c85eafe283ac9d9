"""Submissions in another unit, axis, world or order of people than the inputs are refused or doubted, and no others."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

from magnet.evaluation.methods import baseline
from magnet.evaluation.submission import Submission, answered, doubted
from tests.evaluation.test_benchmark import HORIZON, SAMPLES, made, submitted

Change = Callable[[Tensor], Tensor]
IMPOSSIBLE: dict[str, tuple[Change, str]] = {
    "centimetres": (lambda joints: joints * 100, r"legs are \d+\.?\d* m long, as if in cm: .* metres \(times 0.01\)"),
    "millimetres": (lambda joints: joints * 1000, "as if in mm"),
    "inches": (lambda joints: joints / 0.0254, "as if in inch"),
    "feet": (lambda joints: joints / 0.3048, "as if in foot"),
    "y and z swapped": (lambda joints: joints[..., [0, 2, 1]], "stand along z and not along y, which points up"),
    "z up": (lambda joints: joints[..., [2, 0, 1]], "stand along z"),
    "x up": (lambda joints: joints[..., [1, 0, 2]], "stand along x"),
    "y down": (lambda joints: -joints, "stand along -y"),
}


@pytest.mark.parametrize("name", IMPOSSIBLE)
@pytest.mark.parametrize("task", ["joint_future", "partner_inpainting"])
def test_another_unit_or_axis_is_refused(name: str, task: str, tmp_path: Path) -> None:
    benchmark, _, truth = made()
    change, said = IMPOSSIBLE[name]
    path = submitted(change(truth), task).save(tmp_path / "a.npz", benchmark.fps)
    with pytest.raises(ValueError, match=rf"a\.npz: joints: .*{said}"):
        Submission.load(path, benchmark)


BY_LIMB = [0, 1, 4, 7, 10, 2, 5, 8, 11, 3, 6, 9, 12, 15, 13, 16, 18, 20, 14, 17, 19, 21]

UNLIKELY: dict[str, tuple[str, Change, str]] = {
    "both swapped": ("joint_future", lambda joints: joints.flip(3), "where the other one was: are people in"),
    "one swapped": ("partner_prediction", lambda joints: joints.flip(3), "where the other one was"),
    "the given one": ("partner_inpainting", lambda joints: joints.flip(3), "stands where the given one does"),
    "another world": ("joint_future", lambda joints: joints + torch.tensor([3.0, 0, 0]), "begin 3.00 m from .* world"),
    "around the pelvis": (
        "partner_inpainting",
        lambda joints: joints - joints[..., :1, :],
        r"the lowest joints are at -\d\.\d m",
    ),
    "joints by limb": ("partner_inpainting", lambda joints: joints[..., BY_LIMB, :], "joints SMPL's 22, in its order"),
    "a mean of many": ("joint_future", lambda joints: 0 * joints, "legs are 0 m long"),
}


def left_empty(joints: Tensor, place: tuple[int | slice, ...]) -> Tensor:
    joints = joints.expand(-1, SAMPLES, -1, -1, -1, -1).clone()
    joints[place] = 0.25
    return joints


@pytest.mark.parametrize(
    ("place", "said"),
    [
        ((slice(None), 1), "in scene 0, sample 1, frame 0, person 0, who is scored"),
        ((4,), "in scene 4, sample 0, frame 0, person 0"),
        ((2, 1, HORIZON - 1, 1), f"in scene 2, sample 1, frame {HORIZON - 1}, person 1, who is scored; 1 such places"),
    ],
)
def test_joints_that_nobody_filled_in_are_refused(place: tuple[int | slice, ...], said: str, tmp_path: Path) -> None:
    benchmark, _, truth = made()
    path = submitted(left_empty(truth, place)).save(tmp_path / "a.npz", benchmark.fps)
    with pytest.raises(ValueError, match=rf"a\.npz: joints: all are in one place {said}.*: fill them in"):
        Submission.load(path, benchmark)


def test_who_is_given_may_be_left_empty(tmp_path: Path) -> None:
    benchmark, datamodule, truth = made()
    joints = left_empty(truth, (slice(None), slice(None), slice(None), 1))
    path = submitted(joints, "partner_prediction").save(tmp_path / "a.npz", benchmark.fps)
    assert doubted(benchmark, datamodule, [Submission.load(path, benchmark)]) == []


def test_a_scene_in_another_unit_is_doubted_by_its_name() -> None:
    benchmark, datamodule, truth = made()
    joints = truth.clone()
    joints[3] *= 100
    lines = doubted(benchmark, datamodule, [submitted(joints, "partner_inpainting")])
    assert any(re.search(rf"legs are \d+ m long in {re.escape(benchmark.scenes[3])};", line) for line in lines)


@pytest.mark.parametrize("name", UNLIKELY)
def test_another_place_or_order_is_doubted(name: str) -> None:
    benchmark, datamodule, truth = made()
    task, change, said = UNLIKELY[name]
    assert any(re.search(said, line) for line in doubted(benchmark, datamodule, [submitted(change(truth), task)]))


@pytest.mark.parametrize("task", ["joint_future", "partner_prediction", "partner_inpainting", "motion_control"])
def test_recordings_are_not_doubted(task: str, tmp_path: Path) -> None:
    benchmark, datamodule, truth = made()
    path = submitted(truth.expand(-1, SAMPLES, -1, -1, -1, -1), task).save(tmp_path / "a.npz", benchmark.fps)
    assert doubted(benchmark, datamodule, [Submission.load(path, benchmark)]) == []


@pytest.mark.parametrize("name", ["NN", "RS", "zero velocity", "ridge"])
def test_baselines_are_not_doubted(name: str, tmp_path: Path) -> None:
    benchmark, datamodule, _ = made()
    names, joints = answered(datamodule, baseline(name, benchmark.task("joint_future"), datamodule), SAMPLES)
    handed = Submission(benchmark.label, "joint_future", name, tuple(names), joints)
    assert joints.shape[2] == HORIZON
    assert doubted(benchmark, datamodule, [Submission.load(handed.save(tmp_path / "a.npz", 30), benchmark)]) == []
