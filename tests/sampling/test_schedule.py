from dataclasses import replace

import pytest
import torch

from magnet.sampling.noise import LEVELS
from magnet.sampling.plans import token_levels
from magnet.sampling.schedule import Grid, MaskSchedule, Stage
from magnet.tasks import registry

GRIDS = [
    Grid(tokens=46, agents=2, context=8, pyramid_offset=0),
    Grid(tokens=12, agents=3, context=8, steps=5, pyramid_offset=0),
    Grid(tokens=20, agents=1, context=0, steps=3, pyramid_offset=0),
    Grid(tokens=9, agents=4, context=1, steps=2, window=4, stride=2, pyramid_offset=0),
    Grid(tokens=100, agents=2, context=1, steps=2, pyramid_offset=0),
]


def joint(grid: Grid) -> MaskSchedule:
    return MaskSchedule.full_sequence(grid.past(), ~grid.past(), grid)


@pytest.mark.parametrize("grid", GRIDS, ids=str)
def test_everything_asked_for_ends_clean(grid: Grid):
    assert joint(grid).finished.all()


@pytest.mark.parametrize("grid", GRIDS, ids=str)
def test_each_token_is_denoised_in_exactly_the_steps_asked_for(grid: Grid):
    rows = torch.stack(list(joint(grid).levels_by_step()))
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
    plan = MaskSchedule.full_sequence(grid.past(), target, grid)
    assert (plan.final_levels()[8:, 1] == LEVELS).all()


# -- sliding windows -----------------------------------------------------------------------------------


def rolled(**options) -> MaskSchedule:
    sizes = {"tokens": 24, "agents": 2, "context": 4, "steps": 6, "window": 8, "pyramid_offset": 2, "spacing": "even"}
    grid = Grid(**{**sizes, **options})
    return MaskSchedule.full_sequence(grid.past(), ~grid.past(), grid)


def test_rolling_levels_are_a_slope_along_time():
    """Each token is `pyramid_offset` denoising steps behind the one before it."""
    plan = rolled()
    rows = torch.stack(list(plan.levels_by_step()))[:, 4:, 0]  # (steps + 1, targets)
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
    grid = Grid(24, 2, 4, steps=6, window=8, pyramid_offset=2)
    with pytest.raises(ValueError, match="before those are finished"):
        MaskSchedule.autoregressive(grid.past(), ~grid.past(), grid)


def test_rolling_over_what_is_known_in_between():
    grid = Grid(24, 2, 4, steps=6, window=8, pyramid_offset=2)
    known = grid.past()
    known[10:16] = True
    plan = MaskSchedule.full_sequence(known, ~known, grid)
    assert plan.finished.all()


@pytest.mark.parametrize("name", ["agentic_async", "agentic_sync"])
def test_padded_plans_know_and_generate_nothing_in_free_slots_and_add_no_view(name):
    plan = registry.get(name)().schedule(Grid(12, 2, 4, steps=4, window=8))
    assert any(stage.visibility is not None for stage in plan.stages)
    wide = plan.padded(4)
    assert (wide.tokens, wide.agents) == (12, 4)
    assert not wide.known[:, 2:].any()
    assert (wide.final_levels()[:, 2:] == LEVELS).all()
    assert torch.equal(wide.final_levels()[:, :2], plan.final_levels())
    for stage, narrow in zip(wide.stages, plan.stages, strict=True):
        assert (stage.visibility is None) == (narrow.visibility is None)
        if narrow.visibility is not None:
            assert len(stage.visibility.unique(dim=0)) == len(narrow.visibility.unique(dim=0))
            assert torch.equal(stage.visibility[:2, :, :2], narrow.visibility)
        assert stage.decentralized == narrow.decentralized


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"pyramid_offset": -1}, "pyramid_offset: got -1"),
        ({"noise_sampling": "both"}, "noise_sampling: got 'both', expected joint or independent"),
    ],
)
def test_options_that_mean_nothing_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        rolled(**options)


# -- a pyramid inside the window ---------------------------------------------------------------


def pyramid(**options) -> MaskSchedule:
    """A slope so gentle that the window cannot slide along it."""
    return rolled(**{"pyramid_offset": 1, "steps": 30, "window": 16, "tokens": 40, **options})


@pytest.mark.parametrize("pyramid_offset", [1, 2])
def test_a_slope_too_gentle_for_the_window_is_a_pyramid_in_each_of_its_places(pyramid_offset):
    """Diffusion forcing's pyramid matrix: new token n is at step s - n * pyramid_offset, clamped to 0..S."""
    plan = pyramid(pyramid_offset=pyramid_offset, window=12 if pyramid_offset == 1 else 15)
    done = 4
    for stage in plan.stages:
        new = ((stage.levels[0] > 0).any(dim=1)).nonzero()[:, 0]
        assert stage.start + int(new[0]) == done
        done += len(new)
        assert len(stage.levels) == 31 + pyramid_offset * (len(new) - 1)
        for step, row in enumerate(stage.levels):
            passed = [min(max(step - pyramid_offset * n, 0), 30) for n in range(len(new))]
            assert row[new, 0].tolist() == row[new, 1].tolist() == [1000 * (30 - s) // 30 for s in passed]
    assert done == 40 and plan.finished.all()


def test_a_pyramids_window_moves_on_by_the_stride():
    starts = [stage.start for stage in pyramid(stride=3).stages]
    assert starts == [0, *range(3, 25, 3)]


def test_a_window_rolls_as_soon_as_it_holds_all_that_is_half_denoised():
    """15 tokens in the making fit into 16, 30 do not."""
    rolls, strides = (pyramid(pyramid_offset=pyramid_offset, context=8) for pyramid_offset in (2, 1))
    assert (len(rolls.stages), rolls.evaluations) == (32, 30 + 31 * 2)
    assert (len(strides.stages), strides.evaluations) == (7, 30 + 7 + 6 * (30 + 3))


def test_a_pyramid_over_what_is_known_in_between_generates_the_rest():
    grid = Grid(24, 2, 4, steps=20, window=8, pyramid_offset=1)
    known = grid.past()
    known[10:16, 0] = True
    plan = MaskSchedule.full_sequence(known, ~known, grid)
    assert plan.finished.all() and torch.equal(plan.known, known)


# -- levels that agents share, or draw of their own (paper A.6.2) ------------------------------


def independent(**options) -> MaskSchedule:
    return rolled(**{"pyramid_offset": 0, "steps": 20, "noise_sampling": "independent", **options})


@pytest.mark.parametrize("pyramid_offset", [0, 2, 4])
def test_jointly_agents_at_a_time_step_are_at_one_level_throughout(pyramid_offset):
    for stage in rolled(pyramid_offset=pyramid_offset).stages:
        assert torch.equal(stage.levels[..., 0], stage.levels[..., 1])


@pytest.mark.parametrize("pyramid_offset", [0, 4])
def test_independently_each_token_passes_levels_of_its_own(pyramid_offset):
    plan = independent(pyramid_offset=pyramid_offset)
    rows = torch.stack(list(plan.levels_by_step()))[:, 4:]
    passed = [tuple(column.unique_consecutive().tolist()) for column in rows.flatten(1).T]
    assert all(len(each) == 21 and each[0] == 1000 and each[-1] == 0 for each in passed)
    assert len(set(passed)) == 8 * 2  # no two alike inside a window; the next window's are these again
    assert plan.finished.all()


def test_as_many_independent_levels_as_there_are_are_all_of_them():
    every = token_levels(Grid(4, 2, 0, steps=LEVELS, window=4, noise_sampling="independent", spacing="even"))
    assert torch.equal(every, torch.arange(LEVELS, -1, -1)[:, None, None].expand(-1, 4, 2))


def test_independent_levels_are_drawn_evenly():
    """500 steps leave about every second level, so a token's median is near the middle."""
    levels = token_levels(Grid(16, 4, 0, steps=500, noise_sampling="independent", spacing="even"))
    between = levels[1:-1].double() / 1000
    assert (between.mean() - 0.5).abs() < 0.01
    assert (between.std(dim=0) - 12**-0.5).abs().max() < 0.03


def test_a_plan_draws_no_random_numbers():
    torch.manual_seed(1)
    first = independent()
    torch.manual_seed(2)
    assert all(torch.equal(a.levels, b.levels) for a, b in zip(first.stages, independent().stages, strict=True))


@pytest.mark.parametrize("window", [2, 3, 8, 16])
@pytest.mark.parametrize("steps", [1, 4, 20, 30, 50])
def test_by_default_half_of_the_window_is_in_the_making(steps, window):
    grid = Grid(24, 2, 4, steps, window, stride=1, pyramid_offset=None)
    assert grid.tokens_in_flight <= window // 2
    assert grid.token_offset == 1 or -(-steps // (grid.token_offset - 1)) > window // 2  # no gentler slope would do


def test_by_default_a_window_of_one_token_does_not_roll():
    grid = Grid(6, 2, 2, steps=3, window=1, stride=1, pyramid_offset=None)
    assert MaskSchedule.full_sequence(grid.past(), ~grid.past(), grid).evaluations == 4 * 3


@pytest.mark.parametrize("size", ["tokens", "agents", "steps"])
def test_a_grid_of_nothing_names_the_size(size):
    with pytest.raises(ValueError, match=f"{size}: got 0, expected at least 1"):
        replace(Grid(4, 2, 0), **{size: 0})


def test_more_context_than_there_is_is_refused():
    with pytest.raises(ValueError, match="context: got 5 token steps, expected at most the 4 there are"):
        Grid(4, 2, 5)
    for size in ("stride", "turn"):
        with pytest.raises(ValueError, match=f"{size} must lie between 1 and the window of 4: got 5"):
            Grid(**{"tokens": 8, "agents": 2, "context": 4, "window": 4, "stride": 4, size: 5})


@pytest.mark.parametrize("rolls", [True, False])
@pytest.mark.parametrize("steps", [1, 4, 16])
def test_an_opening_is_more_steps_at_high_noise_where_nothing_is_known(steps, rolls):
    """The first window alone is denoised in more steps, and otherwise in the same."""
    grid = Grid(tokens=30, agents=2, context=0, steps=steps, spacing="log_snr", pyramid_offset=None if rolls else 0)
    plain, opened = joint(grid), joint(replace(grid, opening=5))
    assert opened.evaluations == plain.evaluations + 5
    (first, *rest), (before, *others) = opened.stages, plain.stages
    assert all(one.same_but_start(other) for one, other in zip(rest, others, strict=True))
    assert torch.equal(first.levels[[0, *range(6, steps + 6)]], before.levels)
    new = first.levels[1:6]
    assert (new == new[:, :1, :1]).all() and (first.levels.diff(dim=0) < 0).all()
    assert new.min() > 950 and new.max() < LEVELS


@pytest.mark.parametrize("rolls", [True, False])
@pytest.mark.parametrize(("name", "context"), [("joint_future", 1), ("partner_inpainting", 0), ("inbetweening", 4)])
def test_with_something_known_there_is_no_opening(name, context, rolls):
    grid = Grid(tokens=30, agents=2, context=context, steps=4, pyramid_offset=None if rolls else 0)
    plain, opened = (registry.get(name)().schedule(replace(grid, opening=opening)) for opening in (0, 5))
    assert opened.evaluations == plain.evaluations


def test_a_window_that_is_a_pyramid_of_its_own_has_no_opening():
    grid = Grid(tokens=30, agents=2, context=0, steps=16, pyramid_offset=1)
    assert joint(replace(grid, opening=5)).evaluations == joint(grid).evaluations


def test_an_opening_has_no_more_steps_than_there_are_levels():
    grid = Grid(tokens=8, agents=1, context=0, steps=999, spacing="even", pyramid_offset=0)
    assert joint(replace(grid, opening=5)).evaluations == 999
