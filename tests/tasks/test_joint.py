"""Everybody at once: what is known, and that agents at a time step share their level."""

import pytest
import torch

from magnet.sampling.schedule import Grid
from magnet.tasks.joint import Generation, JointFuture

GRID = Grid(tokens=20, agents=3, context=4, steps=6, window=8, stride=3)


def test_futures_go_on_from_everybodys_past_and_scenes_from_nothing():
    assert torch.equal(JointFuture().schedule(GRID).known, GRID.past())
    assert not Generation().schedule(GRID).known.any(), "not even from a past that there is"


@pytest.mark.parametrize("task", [JointFuture(), Generation()])
def test_agents_at_a_time_step_share_their_level(task):
    plan = task.schedule(GRID)
    assert plan.finished.all()
    for levels in plan.levels_by_step():
        assert torch.equal(levels, levels[:, :1].expand(-1, 3))
