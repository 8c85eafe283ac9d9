from dataclasses import replace

import pytest
import torch

from magnet.sampling.noise import LEVELS
from magnet.sampling.schedule import Grid
from magnet.tasks.agentic import AgenticAsync, AgenticSync
from magnet.tasks.partner import MotionControl, PartnerInpainting, PartnerPrediction

GRID = Grid(tokens=30, agents=3, context=8, steps=10)


def test_inpainting_knows_all_of_the_others_and_nothing_of_the_target():
    schedule = PartnerInpainting((1,)).schedule(GRID)
    assert schedule.known[:, [0, 2]].all() and not schedule.known[:, 1].any()
    assert schedule.finished.all()


def test_inpainting_with_its_own_past_knows_that_too():
    schedule = PartnerInpainting((1,), own_past=True).schedule(GRID)
    assert schedule.known[:, [0, 2]].all() and schedule.known[:8].all() and not schedule.known[8:, 1].any()
    assert schedule.finished.all()
    with pytest.raises(ValueError, match="own_past goes on from a past: give it context"):
        PartnerInpainting((1,), own_past=True).schedule(Grid(12, 2, 0))


def test_prediction_leaves_the_partners_future_unknown():
    schedule = PartnerPrediction((0, 2)).schedule(GRID)
    assert torch.equal(schedule.known, GRID.past())
    assert (schedule.final_levels()[8:, 1] == LEVELS).all()
    assert schedule.finished[:, [0, 2]].all()


def test_motion_control_sees_the_others_up_to_now_and_no_further():
    schedule = MotionControl((0,)).schedule(GRID)
    assert len(schedule.stages) == 22
    for number, stage in enumerate(schedule.stages):
        now = 8 + number - stage.start
        assert stage.visibility is not None or now == stage.levels.shape[1] - 1
        if stage.visibility is not None:
            shown = stage.levels[0].masked_fill(~stage.visibility[0], LEVELS)
            assert (shown[: now + 1, 1:] == 0).all()
            assert (shown[now + 1 :] == LEVELS).all()


def test_agents_in_step_do_not_see_each_others_current_tokens():
    for stage in AgenticSync().schedule(GRID).stages:
        current = (stage.levels[0] == LEVELS) & (stage.levels[-1] == 0)
        for agent in range(3):
            hidden = ~stage.visibility[agent]
            assert torch.equal(hidden, current & (torch.arange(3) != agent))


def test_agents_in_step_plan_a_block_at_a_time():
    stages = AgenticSync(block=2).schedule(replace(GRID, tokens=12)).stages
    assert [stage.active for stage in stages] == [(8, 10), (10, 12)]


@pytest.mark.parametrize("offset", [0.0, 0.27, 0.3, 0.5, 1.0])
def test_turns_start_the_offset_apart(offset):
    grid = Grid(tokens=12, agents=3, context=8, steps=10)
    rows = torch.stack(list(AgenticAsync(offset, order=(2, 0)).schedule(grid).levels_by_step()))[:, 8:]
    starts = (rows < LEVELS).int().argmax(dim=0)
    for now in range(4):
        second, third, first = starts[now].tolist()
        assert second - first == third - second == round(10 * offset)


@pytest.mark.parametrize("offset", [0.0, 0.3, 0.5, 1.0])
def test_whoever_has_not_started_is_hidden_and_nobody_else(offset):
    grid = Grid(tokens=12, agents=3, context=8, steps=10)
    for stage in AgenticAsync(offset, order=(2, 0), block=2).schedule(grid).stages:
        waiting = (stage.levels[-1] == LEVELS) & (stage.levels[0] == LEVELS)
        waiting[int((stage.levels[-1] < LEVELS).any(dim=1).nonzero()[-1]) + 1 :] = False  # beyond the block
        assert (stage.visibility is not None) == bool(waiting.any())
        if stage.visibility is not None:
            assert torch.equal(stage.visibility, ~waiting.expand_as(stage.visibility))
        assert not stage.decentralized, "what is denoised beside each other is placed together"


def test_at_the_full_offset_turns_are_stages():
    grid = Grid(tokens=12, agents=3, context=8, steps=10)
    stages = AgenticAsync(1.0, order=(2, 0)).schedule(grid).stages
    who = [(stage.levels[0] != stage.levels[-1]).any(dim=0).nonzero()[:, 0].tolist() for stage in stages]
    assert who == 4 * [[2], [0], [1]]


@pytest.mark.parametrize(("order", "turns"), [((), (0, 1, 2, 3)), ((2,), (2, 0, 1, 3)), ((3, 1), (3, 1, 0, 2))])
def test_whoever_the_order_leaves_out_follows_in_their_own_each_after_the_one_before(order, turns):
    stages = AgenticAsync(order=order).schedule(Grid(tokens=9, agents=4, context=8, steps=2)).stages
    who = [(stage.levels[0] != stage.levels[-1]).any(dim=0).nonzero()[:, 0].tolist() for stage in stages]
    assert who == [[agent] for agent in turns]


def test_a_turn_is_as_long_as_the_model_is_best_sampled_where_the_task_does_not_say():
    grid = Grid(tokens=12, agents=2, context=8, steps=4)
    assert len(AgenticAsync().schedule(grid).stages) == 2 * 4
    assert len(AgenticAsync().schedule(replace(grid, turn=2)).stages) == 2 * 2
    assert len(AgenticAsync(block=4).schedule(replace(grid, turn=2)).stages) == 2
    assert len(AgenticSync().schedule(replace(grid, turn=2)).stages) == 4  # takes no turns
    with pytest.raises(ValueError, match="turn"):
        replace(grid, turn=0)


@pytest.mark.parametrize("task", [PartnerInpainting, PartnerPrediction, MotionControl])
def test_the_first_agent_is_generated_where_nothing_is_said(task):
    plan = task().schedule(GRID)
    assert (plan.finished & ~plan.known).any(dim=0).tolist() == [True, False, False]


def test_targets_must_exist_and_leave_somebody():
    with pytest.raises(ValueError, match=r"target \(1, 1\): name each agent once"):
        PartnerInpainting(target=(1, 1)).schedule(Grid(4, 3, 0))
    with pytest.raises(ValueError, match="target 5: the grid has agents 0 to 2"):
        PartnerInpainting((5,)).schedule(GRID)
    with pytest.raises(ValueError, match="target -1: the grid has agents 0 to 2"):
        PartnerInpainting((-1,)).schedule(GRID)
    with pytest.raises(ValueError, match=r"target: got .*0\.5"):
        PartnerInpainting((0.5,)).schedule(GRID)
    with pytest.raises(ValueError, match=r"target \(\): name some of the 3 agents, not none and not all"):
        PartnerInpainting(()).schedule(GRID)
    with pytest.raises(ValueError, match="not none and not all"):
        PartnerInpainting((0, 1, 2)).schedule(GRID)
    with pytest.raises(ValueError, match="--people 2` adds another"):
        PartnerInpainting().schedule(replace(GRID, agents=1))
    with pytest.raises(ValueError, match="own_past: got 'false', expected True or False"):
        PartnerInpainting(own_past="false").schedule(GRID)
    with pytest.raises(ValueError, match="offset: got 2"):
        AgenticAsync(2).schedule(GRID)
    for task in (AgenticSync(), AgenticAsync()):
        with pytest.raises(ValueError, match="continues a recording: give it context frames"):
            task.schedule(replace(GRID, context=0))
    with pytest.raises(ValueError, match="at most once"):
        AgenticAsync(order=(1, 1)).schedule(GRID)
    with pytest.raises(ValueError, match=r"order \(0, 3\): name each of the agents 0 to 2"):
        AgenticAsync(order=(0, 3)).schedule(GRID)
    with pytest.raises(ValueError, match=r"order: got .*0\.5"):
        AgenticAsync(order=(0.5,)).schedule(GRID)
