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
    "a mean of many": ("joint_future", lambda joints: 0 * joints, "legs are 0 m long"),
}


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
