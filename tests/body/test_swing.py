"""Toes that swing are lifted as dancers lift them; those that stand stay down."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from magnet.body.joints import TOES
from magnet.body.settle import corrected, correction
from magnet.body.settle_options import Settle
from magnet.body.settle_residuals import DRAGS, SWUNG, swung
from magnet.body.settle_wishes import Wishes
from magnet.datamodules.reading.asf_amc import read_amc, read_asf
from tests.gliding import BODY, gliding, rise


@pytest.mark.parametrize("speed", [0.0, 0.3, 0.6, 1.0, 2.0, 4.0])
def test_toes_are_to_be_lifted_the_more_the_faster_they_go(speed: float) -> None:
    lift = swung(BODY.joints(gliding(speed)), 30.0)
    assert lift.shape == (1, 24, 1, 2)
    faster = swung(BODY.joints(gliding(speed + 0.2)), 30.0)
    least, most = (0.0, 1e-5) if speed <= DRAGS else (0.002, SWUNG)
    assert least <= float(lift.min()) and float(lift.max()) < most
    assert bool((faster > lift - 1e-5).all())


def test_the_slower_of_two_steps_counts_also_that_from_the_frame_before() -> None:
    """A foot that has just come to stand, or is about to leave, stays down."""
    joints = BODY.joints(gliding(2.0))
    stopped = torch.cat([joints[:, :12], joints[:, 11:12].expand(-1, 12, -1, -1, -1)], dim=1)
    lift = swung(stopped, 30.0)
    assert bool((lift[:, :11] > 0.02).all()) and float(lift[:, 12:].max()) == 0
    whole, begun = swung(stopped, 30.0)[:, 1:], swung(stopped[:, 1:], 30.0, stopped[:, :1])
    assert torch.allclose(whole, begun)
    still = swung(joints[:, 1:], 30.0, joints[:, 1:2])
    assert bool((still[:, 0] == 0).all()) and bool((still[:, 1:] > 0.02).all())
    assert bool((swung(joints[:, :1], 30.0) == 0).all())


def test_toes_that_drag_are_lifted_and_toes_that_stand_are_not() -> None:
    for speed, least, most in ((2.0, 0.02, 0.035), (0.0, -0.002, 0.002)):
        scene = gliding(speed)
        assert float(rise(scene).abs().max()) < 1e-4
        offset = correction(scene, BODY, Wishes.of(scene, BODY), settle=Settle(swing=4.0, lift=10.0))
        lifted = rise(corrected(scene, offset))[4:-4]
        assert least < float(lifted.min()) and float(lifted.max()) < most, speed


def test_unless_asked_for_toes_may_drag() -> None:
    """What people recorded, such as who slides, stays as it is."""
    scene = gliding(2.0)
    offset = correction(scene, BODY, Wishes.of(scene, BODY), settle=Settle())
    assert float(rise(corrected(scene, offset)).abs().max()) < 0.002


@pytest.mark.parametrize("take", ["60_01", "61_08", "61_11"])
def test_most_recorded_toes_are_lifted_so_far_at_each_speed(cmu_root: Path, take: str) -> None:
    read = read_amc(cmu_root / f"salsa/{take}.amc", read_asf(cmu_root / f"salsa/{take[:2]}.asf"), 60.0)
    names, ends = read.skeleton.names, torch.from_numpy(read.world()[1][::2]).float()
    joints = ends.new_zeros(1, len(ends), 1, 22, 3)
    joints[0, :, 0, TOES] = ends[:, [names.index(foot) for foot in ("lfoot", "rfoot")]]
    lift, height = swung(joints, 30.0), joints[..., TOES, 1]
    lifted = height - height[lift == 0].median()
    for least, most in ((0.015, 0.025), (0.025, SWUNG)):
        at = (lift > least) & (lift <= most)
        assert 0.05 < float((lifted < lift)[at].double().mean()) < 0.45, (least, most)
