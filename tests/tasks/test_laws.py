"""Every registered task obeys the same laws, whoever wrote it; and the laws find those that do not."""

from dataclasses import dataclass
from typing import ClassVar

import pytest
import torch

from magnet.sampling.noise import LEVELS
from magnet.sampling.schedule import Grid, MaskSchedule, Stage
from magnet.tasks import registry
from magnet.testing import TASK_GRIDS, task_laws

TWO_AND_MORE = ("partner_inpainting", "partner_prediction", "motion_control")
CANNOT_ROLL = ("agentic_async", "inbetweening")
FROM_NOTHING = ("generation", "partner_inpainting", "inbetweening")
NAMELESS = ("joint_future", "generation", "agentic_sync", "inbetweening")


@pytest.mark.parametrize("name", registry.names())
def test_every_task_obeys_the_laws(name: str):
    checked = task_laws(registry.get(name)(), nameless=name in NAMELESS)
    expected = [g for g in TASK_GRIDS if g.agents > 1 or name not in TWO_AND_MORE]
    expected = [g for g in expected if not (g.rolling and name in CANNOT_ROLL)]
    assert checked == [g for g in expected if g.context or name in FROM_NOTHING]


@pytest.mark.parametrize("name", CANNOT_ROLL)
def test_a_task_that_cannot_roll_says_why(name: str):
    with pytest.raises(ValueError, match="rolling"):
        registry.get(name)().schedule(Grid(20, 2, 4, steps=6, window=8, rolling=2))


def test_turns_that_all_begin_at_once_can_roll():
    registry.get("agentic_async")(offset=0.0).schedule(Grid(20, 2, 4, steps=6, window=8, rolling=2))


def test_joint_future_needs_a_past():
    with pytest.raises(ValueError, match="use the task generation"):
        registry.get("joint_future")().schedule(Grid(20, 2, 0))


# -- the laws find what breaks them ------------------------------------------------------------


@dataclass(frozen=True)
class Broken:
    """A task that breaks a law of one's choice."""

    formula: ClassVar[str] = "P(A)"
    law: str = ""

    def schedule(self, grid: Grid) -> MaskSchedule:
        known = grid.past()
        plan = MaskSchedule.together(known, ~known, grid)
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
            return MaskSchedule.together(known, ~known, grid)
        if self.law == "names":
            known[:, 0] = True
            return MaskSchedule.together(known, ~known, grid)
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
