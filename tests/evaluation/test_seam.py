"""Submissions that begin in another place, frame, scene, side or person than the recorded past ends in are doubted."""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from magnet.body.joints import MIRROR
from magnet.evaluation.submission import doubted
from magnet.motion.scene import concatenate
from tests.evaluation.test_benchmark import CONTEXT, HORIZON, SAMPLES, made, submitted

BEGIN = r"people begin \d\.\d\d m from where they were a frame before"
Change = Callable[[Tensor], Tensor]


def whole() -> Tensor:
    """(B, 1, context + horizon, P, 22, 3) as recorded"""
    _, datamodule, _ = made()
    return datamodule.body.joints(concatenate(list(datamodule.test_dataloader())))[:, None]


def exchanged(joints: Tensor, one: int, other: int) -> Tensor:
    order = list(range(len(joints)))
    order[one], order[other] = other, one
    return joints[order]


def moved(joints: Tensor, scene: int, metres: float) -> Tensor:
    joints = joints.clone()
    joints[scene, ..., 0] += metres
    return joints


def turned(joints: Tensor) -> Tensor:
    x, y, z = joints.unbind(-1)
    return torch.stack([z, y, -x], dim=-1)


FROM = f"counted from 0; expected frames {CONTEXT} to {CONTEXT + HORIZON - 1}"
BEGUN: dict[str, tuple[str, Change, str]] = {
    "half a metre off": (
        "joint_future",
        lambda joints: joints + torch.tensor([0.4, 0, 0.3]),
        f"{BEGIN}, in the same poses",
    ),
    "elsewhere and in other poses": (
        "joint_future",
        lambda joints: turned(joints) + torch.tensor([2, 0, 2]),
        f"{BEGIN}; expected the frames after the context, in the world of the inputs",
    ),
    "under the floor": ("motion_control", lambda joints: joints - torch.tensor([0, 0.3, 0]), "in the same poses"),
    "left is right": ("joint_future", lambda joints: joints[..., MIRROR, :], f"{BEGIN}, and as if left were right"),
    "x turned around": (
        "joint_future",
        lambda joints: joints * torch.tensor([-1, 1, 1]),
        f"{BEGIN}, and as if x were turned around: expected the world of the inputs",
    ),
    "z turned around": (
        "partner_prediction",
        lambda joints: joints * torch.tensor([1, 1, -1]),
        f"{BEGIN}, and as if z were",
    ),
    "x for z": ("joint_future", lambda joints: joints[..., [2, 1, 0]], f"{BEGIN}, and as if x and z were exchanged"),
    "a quarter turn": ("motion_control", turned, f"{BEGIN}, and as if turned by 90 degrees"),
    "a half turn": ("joint_future", lambda joints: turned(turned(joints)), "turned by 180 degrees"),
    "three quarters": ("joint_future", lambda joints: turned(turned(turned(joints))), "turned by 270 degrees"),
    "the scene's beginning": ("joint_future", lambda _: whole()[:, :, :HORIZON], f"begins with frame 0 of .* {FROM}"),
    "a token early": (
        "partner_prediction",
        lambda _: whole()[:, :, CONTEXT - 4 : HORIZON + CONTEXT - 4],
        f"begins with frame {CONTEXT - 4} of a scene, {FROM}",
    ),
    "a frame early": (
        "joint_future",
        lambda _: whole()[:, :, CONTEXT - 1 : -1],
        f"begins with frame {CONTEXT - 1} of a scene, {FROM}",
    ),
    "early beside who is given": (
        "partner_inpainting",
        lambda _: whole()[:, :, :HORIZON],
        f"begins with frame 0 of a scene, {FROM}",
    ),
    "scenes exchanged": (
        "joint_future",
        lambda joints: exchanged(joints, 0, 5),
        r"test0 \[0:36\] begins where .* goes on, and 1 more so: are scenes and joints in one order\?",
    ),
    "scenes rolled": ("joint_future", lambda joints: joints.roll(1, 0), "and [0-9]+ more so: are scenes and joints"),
    "one scene elsewhere": (
        "joint_future",
        lambda joints: moved(joints, 0, 4.0),
        r"test0 \[0:36\] begins 3\.95 m from where people were a frame before; other scenes do not",
    ),
}


@pytest.mark.parametrize("name", BEGUN)
@pytest.mark.parametrize("samples", [1, SAMPLES])
def test_what_begins_elsewhere_is_doubted_and_told_why(name: str, samples: int) -> None:
    benchmark, datamodule, truth = made()
    task, change, said = BEGUN[name]
    joints = change(truth).expand(-1, samples, -1, -1, -1, -1)
    found = doubted(benchmark, datamodule, [submitted(joints, task)])
    assert len(found) == 1
    assert re.search(said, found[0])


def test_a_pose_that_is_held_is_not_taken_for_a_frame_too_early() -> None:
    benchmark, datamodule, _ = made()
    held = whole()[:, :, CONTEXT - 1 : CONTEXT].expand(-1, -1, HORIZON, -1, -1, -1)
    assert doubted(benchmark, datamodule, [submitted(held)]) == []


def test_half_precision_changes_no_doubt() -> None:
    benchmark, datamodule, truth = made()
    assert doubted(benchmark, datamodule, [submitted(truth.half().float())]) == []
    early = whole()[:, :, CONTEXT - 1 : -1].half().float()
    assert "expected frames" in doubted(benchmark, datamodule, [submitted(early)])[0]
