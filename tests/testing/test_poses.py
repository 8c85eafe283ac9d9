"""The law of poses over time holds for every task that needs it, and finds what breaks it."""

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar

import pytest
import torch

from magnet.generation import causal_bodies, expected
from magnet.sampling.guidance import Guidance
from magnet.sampling.noise import LEVELS
from magnet.sampling.options import SamplerOptions
from magnet.sampling.schedule import Grid, MaskSchedule
from magnet.tasks import registry
from magnet.tasks.agentic import AgenticAsync, AgenticSync
from magnet.tasks.partner import MotionControl
from magnet.testing.poses import never_shown, pose_law
from tests.cases import few

GRID = Grid(12, 2, 3, steps=2, window=6, stride=2)
THREE = Grid(10, 3, 3, steps=2, window=6, stride=3)

CAUSAL = [
    MotionControl(),
    MotionControl((1,), block=3),
    AgenticSync(),
    AgenticSync(block=3),
    *(AgenticAsync(offset, block=block) for offset in (0.0, 0.5, 1.0) for block in (1, 3)),
]


@pytest.mark.parametrize("task", few(CAUSAL, 2), ids=str)
def test_no_pose_depends_on_what_is_not_known_yet(task):
    assert pose_law(task, GRID)


@pytest.mark.slow
def test_among_three_each_knows_what_it_may():
    assert pose_law(MotionControl((0, 2)), THREE) and pose_law(AgenticAsync(0.5, order=(2, 0)), THREE)


@pytest.mark.parametrize(
    "options",
    few(
        [
            SamplerOptions(keep_given=False),
            SamplerOptions(requantize=False, placement="anchor", blend=0, eta=0.0),
            SamplerOptions(guidance=Guidance("partner")),
            SamplerOptions(guidance=Guidance(smooth=0.01)),
            SamplerOptions(guidance=Guidance("history", stabilization_level=50)),
        ]
    ),
    ids=["bare", "anchor", "partner", "smooth", "history"],
)
@pytest.mark.parametrize("task", few([MotionControl(), AgenticSync()], 1), ids=str)
def test_no_pose_looks_ahead_however_it_is_sampled(task, options):
    assert pose_law(task, GRID, options)


@pytest.mark.parametrize("name", registry.names())
def test_tasks_that_know_everything_from_the_start_have_nothing_to_hide(name):
    causal = name in ("motion_control", "agentic_sync", "agentic_async")
    context = 0 if name == "generation" else 3
    assert registry.get(name)().schedule(dataclasses.replace(GRID, context=context)).causal == causal


def test_what_an_agent_has_not_been_shown_is_told_by_its_plan():
    """Of a block at token 3, and of all that comes after."""
    later = torch.arange(12) >= 4

    def unseen(task) -> list[list[bool]]:
        """Whose part of the block each agent does not see."""
        schedule = task.schedule(GRID)
        stages = [stage for stage in schedule.stages if stage.active[0] == 3]
        secret = never_shown(schedule, stages)
        assert secret[:, later].all() and not secret[:, :3].any()
        return secret[:, 3].tolist()

    assert unseen(AgenticSync()) == [[False, True], [True, False]]
    assert unseen(AgenticAsync(1.0)) == [[False, True], [False, False]]
    assert unseen(AgenticAsync(0.5)) == unseen(AgenticAsync(0.0)) == [[False, False], [False, False]]


# -- the law finds what breaks it ----------------------------------------------------------------


@dataclass(frozen=True)
class Peeking:
    """Says that it does not look ahead, and shows the model what comes next."""

    formula: ClassVar[str] = "P(A_t | A_0:t-1, B_0:t)"

    def schedule(self, grid: Grid) -> MaskSchedule:
        known = grid.past()
        known[:, 1:] = True
        return dataclasses.replace(MaskSchedule.autoregressive(known, ~known, grid), lookahead=False)


def test_a_plan_that_shows_what_comes_next_is_found():
    with pytest.raises(AssertionError, match="poses of agent 0 before frame 16 depend on what it does not know"):
        pose_law(Peeking(), GRID)


@dataclass(frozen=True)
class Hiding:
    """A plan of one's own: the agents' stages hide from each what the others do from now on."""

    formula: ClassVar[str] = "P(A_t | A_0:t-1, B_0:t-1) ..."
    hides: bool = True

    def schedule(self, grid: Grid) -> MaskSchedule:
        plan = AgenticSync().schedule(grid)
        stages = [dataclasses.replace(stage, ahead=0) for stage in plan.stages]
        if not self.hides:
            stages[:-1] = [dataclasses.replace(stage, visibility=None) for stage in stages[:-1]]
        return MaskSchedule(grid.tokens, grid.agents, tuple(stages), plan.known)


def test_a_plan_that_hides_something_anywhere_is_shown_block_by_block():
    """Whether or not its author says so."""
    assert Hiding().schedule(GRID).causal and pose_law(Hiding(), GRID)
    assert Hiding(hides=False).schedule(GRID).causal and pose_law(Hiding(hides=False), GRID)


def breaking(how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let poses look ahead in one way or another."""
    made, kept = causal_bodies.decode_bodies, expected.Expected.keep

    def looking_ahead(world: Any, tokens: Any, first: int, stop: int, near: int, *_: Any) -> Any:
        return made(world, tokens, first, stop, min(near + 2, tokens.shape[1]))

    def last_word(self: Any, *said: Any) -> None:
        self.row = -1
        kept(self, *said)

    if how == "decoder":
        monkeypatch.setattr(causal_bodies, "decode_bodies", looking_ahead)
    else:
        monkeypatch.setattr(expected.Expected, "keep", last_word)


def test_a_decoder_that_looks_ahead_is_found(monkeypatch: pytest.MonkeyPatch):
    breaking("decoder", monkeypatch)
    with pytest.raises(AssertionError, match="before frame 16 depend on what it does not know"):
        pose_law(MotionControl(), GRID)


def test_an_expectation_that_knows_too_much_is_found(monkeypatch: pytest.MonkeyPatch):
    """Agent 0 is done before agent 1 begins; what is then expected of it has seen agent 1."""
    breaking("expectation", monkeypatch)
    with pytest.raises(AssertionError, match="poses of agent 0 before frame 16"):
        pose_law(AgenticAsync(), GRID)


def test_pure_noise_beyond_a_window_tells_nothing():
    """The tokens ahead of a window are nobody's."""
    for stage in MotionControl().schedule(GRID).stages:
        assert stage.ahead > 0 and stage.stop == stage.active[1]
        assert stage.ahead + len(stage.levels[0]) == GRID.window
        assert (stage.levels[0, -1] == torch.tensor([LEVELS, 0])).all()
