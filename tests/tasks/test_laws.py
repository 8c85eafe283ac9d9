"""Every registered task obeys the same laws, whoever wrote it."""

import pytest
import torch

from magnet.sampling.noise import LEVELS
from magnet.sampling.schedule import Grid
from magnet.tasks import registry

GRIDS = [Grid(46, 2, 8), Grid(20, 3, 4, steps=5), Grid(16, 4, 8, steps=3), Grid(24, 1, 1, steps=2)]


def grid_for(name: str, grid: Grid) -> Grid:
    return Grid(grid.tokens, grid.agents, 0, grid.steps) if name == "generation" else grid


TWO_AND_MORE = ("partner_inpainting", "partner_prediction", "motion_control")


@pytest.mark.parametrize("name", registry.names())
@pytest.mark.parametrize("grid", GRIDS, ids=str)
def test_columns_never_rise_and_targets_end_clean(name: str, grid: Grid):
    if name in TWO_AND_MORE and grid.agents == 1:
        pytest.skip("needs a partner")
    schedule = registry.get(name)().schedule(grid_for(name, grid))
    rows = torch.stack(list(schedule.rows()))
    assert (rows.diff(dim=0) <= 0).all()
    assert (rows[:, schedule.known] == 0).all()
    assert ((rows[-1] == 0) | (rows[-1] == LEVELS)).all()


@pytest.mark.parametrize("name", registry.names())
def test_every_task_says_what_it_samples(name: str):
    task = registry.get(name)
    assert task.formula.startswith("P(") and task.__doc__


def test_joint_future_needs_a_past():
    with pytest.raises(ValueError, match="use the task generation"):
        registry.get("joint_future")().schedule(Grid(20, 2, 0))
