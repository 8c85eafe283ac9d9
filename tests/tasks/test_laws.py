"""Every registered task obeys the same laws, whoever wrote it; and the laws find those that do not."""

import dataclasses
import itertools
from dataclasses import dataclass
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor

from magnet.motion.tokens import TokenLayout
from magnet.sampling import sampler
from magnet.sampling.guidance import Guidance
from magnet.sampling.noise import LEVELS
from magnet.sampling.planned_stage import Denoising
from magnet.sampling.schedule import Grid, MaskSchedule, Stage
from magnet.tasks import registry
from magnet.testing import TASK_GRIDS, check_hidden, renaming_law, sampled_blind, task_laws
from tests.cases import few, some_slow

TWO_AND_MORE = ("partner_inpainting", "partner_prediction", "motion_control")
CANNOT_ROLL = ("agentic_async", "agentic_sync", "inbetweening", "motion_control")
FROM_NOTHING = ("generation", "partner_inpainting", "inbetweening")
HIDING = ("agentic_async", "agentic_sync")
NAMELESS = ("joint_future", "generation", "agentic_sync", "inbetweening")


@pytest.mark.parametrize("name", some_slow(registry.names(), *HIDING))
def test_every_task_obeys_the_laws(name: str):
    checked = task_laws(registry.get(name)(), nameless=name in NAMELESS)
    expected = [g for g in TASK_GRIDS if g.agents > 1 or name not in TWO_AND_MORE]
    expected = [g for g in expected if not (g.pyramid_offset and name in CANNOT_ROLL)]
    assert checked == [g for g in expected if g.context or name in FROM_NOTHING]


@pytest.mark.parametrize("name", some_slow(registry.names(), *HIDING))
@pytest.mark.parametrize("pyramid_offset", some_slow([0, 2], 0))
def test_every_task_obeys_the_laws_where_each_token_has_levels_of_its_own(name: str, pyramid_offset: int):
    """Paper A.6.2. Levels are drawn by slot, so this is the one choice in which slots are not treated alike."""
    if pyramid_offset and name in CANNOT_ROLL:
        pytest.skip("refused, with a reason: see below")
    context = 0 if name == "generation" else 4
    grid = Grid(
        20, 3, context, steps=6, window=8, stride=3, pyramid_offset=pyramid_offset, noise_sampling="independent"
    )
    assert task_laws(registry.get(name)(), [grid]) == [grid]


@pytest.mark.parametrize("target", [(0,), (0, 2)])
def test_inpainting_with_the_targets_own_past_obeys_the_laws(target: tuple[int, ...]):
    task = registry.get("partner_inpainting")(target=target, own_past=True)
    assert all(grid.context and grid.agents > len(target) for grid in task_laws(task))


@pytest.mark.parametrize("name", CANNOT_ROLL)
def test_a_task_that_cannot_roll_says_why(name: str):
    with pytest.raises(ValueError, match="pyramid_offset"):
        registry.get(name)().schedule(Grid(20, 2, 4, steps=6, window=8, pyramid_offset=2))


@pytest.mark.parametrize("name", registry.names())
def test_tasks_that_can_roll_do_so_unless_told_otherwise(name: str):
    def plan(pyramid_offset: int | None) -> list[Tensor]:
        grid = Grid(20, 2, 0 if name == "generation" else 4, steps=8, window=8, pyramid_offset=pyramid_offset)
        return list(registry.get(name)().schedule(grid).levels_by_step())

    left_to_itself, told = plan(None), plan(0 if name in CANNOT_ROLL else 2)
    assert len(left_to_itself) == len(told)
    assert all(map(torch.equal, left_to_itself, told))


def test_joint_future_needs_a_past():
    with pytest.raises(ValueError, match="use the task generation"):
        registry.get("joint_future")().schedule(Grid(20, 2, 0))


# -- what is hidden stays hidden ---------------------------------------------------------------


@pytest.mark.parametrize("name", HIDING)
@pytest.mark.parametrize(
    "guidance",
    [
        Guidance("history"),
        Guidance("self"),
        Guidance("partner", paper_average=True),
        Guidance(smooth=0.1),
        Guidance(stabilization_level=50),
        Guidance(stabilization_unseen=50),
    ],
    ids=["history", "self", "partner", "smooth", "faint", "unseen"],
)
def test_what_is_hidden_from_an_agent_is_hidden_under_guidance_too(name: str, guidance: Guidance):
    task, grid = registry.get(name)(), Grid(8, 3, 3, steps=4, window=6, stride=2)
    schedule = task.schedule(grid)
    assert any(stage.visibility is not None for stage in schedule.stages)
    check_hidden(task, grid, schedule, guidance)


@pytest.mark.parametrize("name", HIDING)
def test_a_sampler_that_shows_what_is_hidden_breaks_the_law(name: str, monkeypatch: pytest.MonkeyPatch):
    honest = sampler.run_planned_stage

    def open_to_all(how: Denoising, stage: Stage, *rest: Any) -> Tensor:
        return honest(how, dataclasses.replace(stage, visibility=None), *rest)

    monkeypatch.setattr(sampler, "run_planned_stage", open_to_all)
    task = registry.get(name)(**({"offset": 0.25} if name == "agentic_async" else {}))  # at 1 there is nothing to see
    with pytest.raises(AssertionError, match="what it hides from agent 0 influences"):
        task_laws(task, [Grid(8, 2, 3, steps=4, window=6, stride=2)])


# -- slots are no names ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "options"),
    few(
        [
            ("partner_inpainting", {"target": (0,)}),
            ("partner_inpainting", {"target": (0, 2)}),
            ("partner_inpainting", {"target": (0, 2), "own_past": True}),
            ("partner_prediction", {"target": (0,)}),
            ("partner_prediction", {"target": (0, 2)}),
            ("motion_control", {"target": (0,)}),
            ("motion_control", {"target": (0, 2), "block": 2}),
            ("agentic_async", {"order": (0, 1, 2)}),
            ("agentic_async", {"order": (2, 0, 1), "offset": 0.5, "block": 2}),
            ("agentic_async", {"order": (0, 1, 2), "offset": 0.0}),
            ("inbetweening", {"keys": (8, -1), "agents": (0, 2)}),
            ("inbetweening", {"pairs": ((0, 8), (1, 11), (2, -1))}),
        ],
        4,
    ),
)
def test_an_agent_is_treated_as_its_role_says_whichever_slot_it_is_in(name: str, options: dict[str, Any]):
    task = registry.get(name)
    pyramid_offset = (0,) if name in CANNOT_ROLL else (0, 2)
    for order, slope in itertools.product(itertools.permutations(range(3)), pyramid_offset):
        grid = Grid(14, 3, 4, steps=4, window=8, stride=3, pyramid_offset=slope)
        moved = dict(options)
        for field in set(options) & {"target", "order", "agents"}:
            moved[field] = tuple(order.index(slot) for slot in options[field])
        if "pairs" in options:
            moved["pairs"] = tuple((order.index(slot), step) for slot, step in options["pairs"])
        renaming_law(task(**options), task(**moved), grid, torch.tensor(order))


def test_turns_that_follow_the_slots_are_found_to():
    task = registry.get("agentic_async")()
    with pytest.raises(AssertionError, match="for the slots they are in"):
        renaming_law(task, task, Grid(14, 3, 4, steps=4), torch.tensor([1, 2, 0]))


@pytest.mark.parametrize("name", registry.names())
def test_empty_slots_change_nothing(name: str):
    """Two people are sampled in four slots as in two, whatever stands in the slots that nobody is in."""
    small, large = (TokenLayout(latent=4, agents=agents) for agents in (2, 4))
    checked = 0
    for context, pyramid_offset in itertools.product((0, 4), (0, 2)):
        try:
            plan = registry.get(name)().schedule(Grid(14, 2, context, 4, 8, 3, pyramid_offset))
        except ValueError:
            continue
        generator = torch.Generator().manual_seed(3)
        drawn = [torch.randn(2, 14, 2, small.width, generator=generator) for _ in range(3)]
        rest = [torch.randn(2, 14, 4, large.width, generator=generator) for _ in range(3)]
        alone = sampled_blind(plan, small, 2, drawn)
        seated = [in_more_slots(*pair, small, large) for pair in zip(drawn, rest, strict=True)]
        out = sampled_blind(plan.padded(4), large, 2, seated)
        torch.testing.assert_close(in_more_slots(alone, out, small, large), out, atol=1e-4, rtol=0)
        checked += 1
    assert checked


def in_more_slots(people: Tensor, slots: Tensor, small: TokenLayout, large: TokenLayout) -> Tensor:
    """People's tokens in the first of more slots, the rest as it is in `slots`."""
    P = small.agents
    whole = [part.clone() for part in large.unpack(slots)]
    latent, deltas, pairs = small.unpack(people)
    whole[0][:, :, :P], whole[1][:, :, :P], whole[2][:, :, :P, : P - 1] = latent, deltas, pairs
    return large.pack(*whole)


# -- the laws find what breaks them ------------------------------------------------------------


@dataclass(frozen=True)
class Broken:
    """A task that breaks a law of one's choice."""

    formula: ClassVar[str] = "P(A)"
    law: str = ""

    def schedule(self, grid: Grid) -> MaskSchedule:
        known = grid.past()
        plan = MaskSchedule.full_sequence(known, ~known, grid)
        rows = torch.full((3, grid.tokens, grid.agents), LEVELS)
        rows[1], rows[2] = 500, 0
        if self.law == "rise":
            rows[1:] = torch.tensor([0, 500])[:, None, None]
        if self.law == "half":
            rows[2] = 300
        if self.law in ("rise", "half", "wide"):
            return MaskSchedule(grid.tokens, grid.agents, (Stage(0, rows),), grid.mask())
        if self.law == "nothing":
            return MaskSchedule(grid.tokens, grid.agents, (), known)
        if self.law == "random":
            known = torch.rand(grid.tokens, grid.agents) < 0.5
            return MaskSchedule.full_sequence(known, ~known, grid)
        if self.law == "names":
            known[:, 0] = True
            return MaskSchedule.full_sequence(known, ~known, grid)
        if self.law in ("rumour", "blind"):
            # Rumour: 0 does not see 1, but sees 2, who sees 1.
            unseen = torch.zeros(grid.agents, grid.agents, dtype=torch.bool)
            unseen[0, 1 if self.law == "rumour" else 0] = True
            return MaskSchedule.autoregressive(known, ~known, grid, unseen=unseen)
        if self.law == "refuse":
            raise ValueError("this task needs seven agents")
        return plan


GRID = Grid(24, 2, 4, steps=3)


@pytest.mark.parametrize(
    ("law", "message"),
    [
        ("rise", "rises from 0 to 500"),
        ("half", "half denoised"),
        ("wide", "stage 0 is 24 tokens wide, the window 16"),
        ("nothing", "nothing is generated"),
        ("random", "the plans differ"),
        ("names", "for the slots they are in"),
    ],
)
def test_a_broken_law_is_named(law: str, message: str):
    with pytest.raises(AssertionError, match=message):
        task_laws(Broken(law), [GRID], nameless=law == "names")


def test_what_is_hidden_must_not_be_told_by_others():
    assert task_laws(Broken("rumour"), [Grid(24, 2, 4, steps=3)])
    with pytest.raises(AssertionError, match="what it hides from agent 0 influences"):
        task_laws(Broken("rumour"), [Grid(24, 3, 4, steps=3)])


def test_an_agent_must_see_what_is_generated_of_it():
    with pytest.raises(AssertionError, match="hides from an agent what it generates of itself"):
        task_laws(Broken("blind"), [GRID])


def test_a_lawful_task_passes():
    assert task_laws(Broken(), [GRID], nameless=True) == [GRID]


def test_a_task_that_refuses_every_grid_is_told():
    with pytest.raises(ValueError, match="refuses every grid: this task needs seven agents"):
        task_laws(Broken("refuse"))
    with pytest.raises(ValueError, match="this task needs seven agents"):
        task_laws(Broken("refuse"), [GRID])


def test_a_task_must_be_a_frozen_dataclass_that_says_what_it_samples():
    @dataclass
    class Changing:
        """Its options may change."""

        formula: ClassVar[str] = "P(A)"
        schedule = Broken.schedule

    @dataclass(frozen=True)
    class Speechless:
        """Says nothing."""

        formula: ClassVar[str] = ""
        schedule = Broken.schedule

    with pytest.raises(AssertionError, match="frozen=True"):
        task_laws(Changing())
    with pytest.raises(AssertionError, match="does not say what is sampled"):
        task_laws(Speechless())
