from dataclasses import replace

import pytest
import torch

from magnet.sampling.noise import LEVELS
from magnet.sampling.schedule import Grid, MaskSchedule, Stage

GRIDS = [
    Grid(tokens=46, agents=2, context=8),
    Grid(tokens=12, agents=3, context=8, steps=5),
    Grid(tokens=20, agents=1, context=0, steps=3),
    Grid(tokens=9, agents=4, context=1, steps=2, window=4, stride=2),
    Grid(tokens=100, agents=2, context=1, steps=2),
]


def joint(grid: Grid) -> MaskSchedule:
    return MaskSchedule.together(grid.past(), ~grid.past(), grid)


@pytest.mark.parametrize("grid", GRIDS, ids=str)
def test_everything_asked_for_ends_clean(grid: Grid):
    assert joint(grid).finished.all()


@pytest.mark.parametrize("grid", GRIDS, ids=str)
def test_each_token_is_denoised_in_exactly_the_steps_asked_for(grid: Grid):
    rows = torch.stack(list(joint(grid).rows()))
    changes = (rows.diff(dim=0) != 0).sum(dim=0)
    assert (changes[grid.context :] == grid.steps).all()
    assert (changes[: grid.context] == 0).all()


@pytest.mark.parametrize("grid", GRIDS, ids=str)
def test_later_windows_see_at_least_window_minus_stride_finished_steps(grid: Grid):
    for stage in joint(grid).stages[1:]:
        finished = (stage.levels[0] == 0).all(dim=1).sum()
        assert finished >= min(grid.window, grid.tokens) - grid.stride


@pytest.mark.parametrize("grid", GRIDS, ids=str)
def test_no_window_is_longer_than_what_the_model_was_trained_on(grid: Grid):
    assert all(stage.levels.shape[1] <= grid.window for stage in joint(grid).stages)


def stage(*rows: int) -> Stage:
    return Stage(0, torch.tensor(rows)[:, None, None])


def schedule(*stages: Stage, known: bool = False) -> MaskSchedule:
    return MaskSchedule(1, 1, stages, torch.tensor([[known]]))


@pytest.mark.parametrize(
    ("stages", "known", "message"),
    [
        ([stage(1000, 400, 500, 0)], False, "token 0 of agent 0 rises from 400 to 500 at step 2"),
        ([stage(1000, 500), stage(600, 0)], False, "rises from 500 to 600"),
        ([stage(1000, 500), stage(400, 0)], False, "begins at level 400 but was left at 500"),
        ([stage(900, 0)], False, "begins at level 900 but was left at 1000"),
        ([stage(1000, 0)], True, "rises from 0 to 1000"),
        ([stage(1000, 500, 500, 0)], False, "step 1 changes nothing"),
        ([stage(1000, 500, -3)], False, "outside 0..1000"),
        ([Stage(1, torch.tensor([[[1000]], [[0]]]))], False, "do not fit"),
    ],
)
def test_a_broken_law_names_the_place(stages, known, message):
    with pytest.raises(ValueError, match=message):
        schedule(*stages, known=known)


def test_unfinished_columns_stay_where_they_are():
    plan = schedule(stage(1000, 500))
    assert plan.final_levels().item() == 500
    assert not plan.finished.any()


def test_a_lone_unknown_future_stays_at_pure_noise():
    grid = Grid(tokens=16, agents=2, context=8)
    target = ~grid.past()
    target[:, 1] = False
    plan = MaskSchedule.together(grid.past(), target, grid)
    assert (plan.final_levels()[8:, 1] == LEVELS).all()


# -- rolling -----------------------------------------------------------------------------------


def rolled(**options) -> MaskSchedule:
    grid = Grid(**{"tokens": 24, "agents": 2, "context": 4, "steps": 6, "window": 8, "rolling": 2, **options})
    return MaskSchedule.together(grid.past(), ~grid.past(), grid)


def test_rolling_levels_are_a_slope_along_time():
    """Each token is `rolling` denoising steps behind the one before it."""
    plan = rolled()
    rows = torch.stack(list(plan.rows()))[:, 4:, 0]  # (steps + 1, targets)
    slope = [1000 * (6 - s) // 6 for s in range(7)]
    for step, row in enumerate(rows):
        assert row.tolist() == [slope[min(max(step - 2 * token, 0), 6)] for token in range(20)]


def test_rolling_finishes_a_token_at_each_stage_and_costs_its_share():
    plan = rolled()
    assert len(plan.stages) == 20
    assert plan.evaluations == 6 + 19 * 2
    assert plan.finished.all()
    for stage in plan.stages:
        done = (stage.levels[-1] == 0) & (stage.levels[0] > 0)
        assert done.any(dim=1).sum() == 1


def test_a_rolling_window_keeps_some_past_in_view():
    for stage in rolled().stages[4:]:
        assert stage.levels.shape[0] == 3
        assert (stage.levels[0] == 0).all(dim=1).sum() >= 8 - 3 - 1


def test_plans_in_which_agents_see_each_other_as_they_are_cannot_roll():
    grid = Grid(24, 2, 4, steps=6, window=8, rolling=2)
    with pytest.raises(ValueError, match="half made up"):
        MaskSchedule.blocks(grid.past(), ~grid.past(), grid)


def test_rolling_over_what_is_known_in_between():
    grid = Grid(24, 2, 4, steps=6, window=8, rolling=2)
    known = grid.past()
    known[10:16] = True
    plan = MaskSchedule.together(known, ~known, grid)
    assert plan.finished.all()


def test_padded_plans_know_and_generate_nothing_in_free_slots_and_add_no_view():
    from magnet.tasks.agentic import AgenticAsync

    plan = AgenticAsync(0.5).schedule(Grid(12, 2, 4, steps=4, window=8))
    wide = plan.padded(4)
    assert (wide.tokens, wide.agents) == (12, 4)
    assert not wide.known[:, 2:].any()
    assert (wide.final_levels()[:, 2:] == LEVELS).all()
    assert torch.equal(wide.final_levels()[:, :2], plan.final_levels())
    for stage, narrow in zip(wide.stages, plan.stages, strict=True):
        assert len(stage.hidden.unique(dim=0)) == len(narrow.hidden.unique(dim=0))
        assert torch.equal(stage.hidden[:2, :, :2], narrow.hidden)
        assert stage.apart == narrow.apart


@pytest.mark.parametrize(
    ("options", "message"),
    [({"rolling": 1, "steps": 30}, "keeps 30 tokens half denoised"), ({"rolling": -1}, "rolling: got -1")],
)
def test_a_slope_that_does_not_fit_the_window_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        rolled(**options)


@pytest.mark.parametrize("window", [2, 3, 8, 16])
@pytest.mark.parametrize("steps", [1, 4, 20, 30, 50])
def test_by_default_half_of_the_window_is_in_the_making(steps, window):
    grid = Grid(24, 2, 4, steps, window, stride=1, rolling=None)
    assert grid.rolled <= window // 2
    assert grid.slope == 1 or -(-steps // (grid.slope - 1)) > window // 2  # no gentler slope would do


def test_by_default_a_window_of_one_token_does_not_roll():
    grid = Grid(6, 2, 2, steps=3, window=1, stride=1, rolling=None)
    assert MaskSchedule.together(grid.past(), ~grid.past(), grid).evaluations == 4 * 3


@pytest.mark.parametrize("size", ["tokens", "agents", "steps"])
def test_a_grid_of_nothing_names_the_size(size):
    with pytest.raises(ValueError, match=f"{size}: got 0, expected at least 1"):
        replace(Grid(4, 2, 0), **{size: 0})


def test_more_context_than_there_is_is_refused():
    with pytest.raises(ValueError, match="context: got 5 token steps, expected at most the 4 there are"):
        Grid(4, 2, 5)
