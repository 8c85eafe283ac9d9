"""Feet of people who are made are lifted where they swing; those of recorded people stay as they are."""

from __future__ import annotations

import pytest
import torch

from magnet.body.repair import repaired
from magnet.generation.live_settling import settled_on
from magnet.generation.settling import settled_chunk
from tests.gliding import BODY, gliding, rise


@pytest.mark.parametrize("how", ["light", "firm", "hold"])
def test_toes_of_a_finished_scene_that_swing_are_lifted(how: str) -> None:
    scene = gliding(2.0, frames=30)
    fixed = torch.zeros(30, 1, dtype=torch.bool)
    assert float(rise(scene).abs().max()) < 1e-4
    assert float(rise(settled_chunk(scene, fixed, how, None)[0])[4:-4].min()) > 0.02
    assert float(rise(settled_chunk(gliding(0.0, frames=30), fixed, how, None)[0]).abs().max()) < 0.002


def test_toes_that_swing_are_lifted_block_by_block_too() -> None:
    new, sees = torch.ones(12, 1, dtype=torch.bool), torch.zeros(1, 1, dtype=torch.bool)
    scene = gliding(2.0, frames=16)
    made, _ = settled_on(scene.slice(4), scene.slice(0, 4), new, 4, sees, "hold", None)
    assert float(rise(made)[:4].max()) > 0.005
    assert float(rise(made)[4:8].min()) > float(rise(made)[0].max())


def test_people_of_a_file_may_drag_their_feet() -> None:
    assert float(rise(repaired(gliding(2.0, frames=30), BODY, "firm")).abs().max()) < 0.005
