"""The world of a scene while it is generated: tokens, places and bodies that agree."""

from dataclasses import dataclass
from itertools import pairwise

import pytest
import torch

from magnet.generation.blending import freeze_after
from magnet.generation.causal_bodies import shown_to
from magnet.generation.conditioning import known_tokens, mask_unknown
from magnet.generation.rollout import generate
from magnet.generation.stats import SamplingStats
from magnet.generation.world import WorldState
from magnet.motion.frames import canonical_frame, inverse, to_planar
from magnet.motion.scene import Scene
from magnet.sampling.options import SamplerOptions
from magnet.sampling.sampler import sample
from magnet.sampling.schedule import Grid, MaskSchedule
from magnet.tasks import registry
from magnet.tasks.agentic import AgenticAsync, AgenticSync
from magnet.tasks.base import Task
from magnet.tasks.inbetweening import Inbetweening
from magnet.tasks.joint import Generation
from magnet.tasks.partner import MotionControl, PartnerInpainting, PartnerPrediction
from magnet.testing import random_scene, without_absent
from tests.cases import few, some_slow

OPTIONS = SamplerOptions(steps=2, stride=2)


def test_settling_changes_nothing_but_what_it_is_told_of(model, scene):
    """And the step into a known token, once the gap in front of it is closed."""
    schedule = Inbetweening(keys=(4,)).schedule(Grid(8, 3, 2, 2, 8, 2))
    world = WorldState(model, mask_unknown(scene, schedule.known), schedule, OPTIONS, 1)
    tokens = torch.randn(2, 8, 3, model.layout.width, generator=torch.Generator().manual_seed(0))
    finished = torch.zeros(8, 3, dtype=torch.bool)
    finished[2:4] = True
    settled = world.make_consistent(tokens.clone(), finished)
    changed = (settled != tokens).any(dim=0)
    assert changed[2:4].all(dim=-1).all()
    assert not changed[[0, 1, 5, 6, 7]].any()
    step = torch.zeros(model.layout.width, dtype=torch.bool)
    step[model.layout.latent : model.layout.latent + 9] = True
    assert torch.equal(changed[4], step.expand(3, -1) & changed[4]) and changed[4].any()


def test_whoever_has_ended_stands_as_in_the_frame_before(scene):
    there = torch.ones(8, 3, dtype=torch.bool)
    there[3:, 1], there[:, 2] = False, False
    part = scene.slice(20, 28)
    held = freeze_after(part, there, scene.slice(19, 20))
    assert torch.equal(held.T_world_root[:, :, 0], part.T_world_root[:, :, 0])
    assert torch.equal(held.T_world_root[:, 3:, 1], part.T_world_root[:, 2:3, 1].expand(-1, 5, -1, -1))
    assert torch.equal(held.body_rot[:, :, 2], scene.body_rot[:, 19:20, 2].expand(-1, 8, -1, -1, -1))


# -- with the true tokens ------------------------------------------------------------------------

PLACEMENTS = ("integrate", "anchor", "fuse")
TASKS = {
    **{name: registry.get(name)() for name in registry.names()},
    "second's future": PartnerPrediction((1,)),
    "second's and third's future": PartnerPrediction((1, 2)),
    "second, from nothing": PartnerInpainting((1,)),
    "controlled": MotionControl((0, 2), block=2),
    "turns": AgenticAsync(offset=0.5, order=(2, 0)),
    "turns of two tokens": AgenticAsync(block=2),
}
TOKENS = 12


def told(
    model, scene: Scene, task: Task, placement: str, context: int, wrong: torch.Tensor | None = None, **about
) -> tuple[WorldState, torch.Tensor]:
    """The finished world and tokens where a model says the truth, and `wrong` (B, N, P, D) on top."""
    options = SamplerOptions(steps=4, stride=2, placement=placement, pairwise_weight=0.1)
    schedule = task.schedule(Grid(TOKENS, 3, context, 4, 8, 2))
    given = mask_unknown(scene, schedule.known)
    world = WorldState(model, given, schedule, options, 1, **about)
    truth = known_tokens(model, scene.slice(0, 4 * TOKENS), torch.ones_like(schedule.known))
    truth = truth if wrong is None else truth + wrong
    position = iter([stage for stage in schedule.stages for _ in range(len(stage.levels) - 1)])

    def oracle(noisy: torch.Tensor, levels: torch.Tensor, present: torch.Tensor) -> torch.Tensor:
        stage = next(position)
        return truth[:, stage.start : stage.stop].repeat_interleave(len(noisy) // len(truth), dim=0)

    start = known_tokens(model, given, schedule.known)
    generator = torch.Generator().manual_seed(1)
    tokens = sample(oracle, schedule, start, scene.present, model.layout, generator, world.make_consistent)
    return world, tokens


def off(world: WorldState, scene: Scene, free: bool) -> torch.Tensor:
    """Metres and radians that placed people are away from where they were; `free`: the scene may stand anywhere."""
    true, placed = canonical_frame(scene.slice(0, 4 * TOKENS).T_world_root), world.T_world_can
    if free:
        lead = torch.arange(scene.scenes), 0, scene.present.int().argmax(dim=1)
        true, placed = (inverse(T[lead])[:, None, None] @ T for T in (true, placed))
    yaw, ground = to_planar(inverse(true) @ placed)
    away = yaw.abs() + ground.norm(dim=-1)
    counts = world.placed.repeat_interleave(4, dim=0)[None] & scene.present[:, None]
    return away[counts].max()


@pytest.mark.parametrize("placement", PLACEMENTS)
@pytest.mark.parametrize("name", few(TASKS, 6))
def test_with_the_true_tokens_everybody_is_where_they_were(model, scene, name, placement):
    context = 0 if name == "generation" else 3
    world, _ = told(model, scene, TASKS[name], placement, context)
    # What is left at keyframes is the guess of the one step into each.
    assert off(world, scene, free=name == "generation") < (0.05 if name == "inbetweening" else 2e-3)


@pytest.mark.parametrize("placement", PLACEMENTS)
@pytest.mark.parametrize("task", [Generation(), Inbetweening(keys=(6,)), Inbetweening(every=5)], ids=str)
def test_nobody_is_hung_off_an_absent_agent(model, scene, task, placement):
    """Other slots are free in each scene of a batch, and what the model says of them means nothing."""
    present = torch.tensor([[True, True, False], [False, True, True]])
    some = without_absent(scene.replace(present=present))
    wrong = torch.randn(2, TOKENS, 3, model.layout.width, generator=torch.Generator().manual_seed(2))
    wrong[model.layout.spread(model.layout.group_present(present))[:, None].expand_as(wrong)] = 0
    world, _ = told(model, some, task, placement, 0, wrong)
    assert off(world, some, free=isinstance(task, Generation)) < (2e-3 if isinstance(task, Generation) else 0.05)


# -- agents who do not see each other -------------------------------------------------------------


TURNS = (AgenticSync(), AgenticSync(block=2), AgenticAsync(), AgenticAsync(block=2))


@pytest.mark.parametrize("placement", PLACEMENTS)
@pytest.mark.parametrize("task", some_slow(TURNS, *TURNS[1:3]), ids=str)
def test_what_an_unseen_agent_does_moves_nobody(model, scene, task, placement):
    """Agent 0 sees nothing of what agent 1 does now, so whatever that is, agent 0 stands where it stood.

    In full turns agent 0 is done before agent 1 starts.
    """
    generator = torch.Generator().manual_seed(2)
    wrong = torch.zeros(2, TOKENS, 3, model.layout.width)
    wrong[:, :, 1] = torch.randn(wrong[:, :, 1].shape, generator=generator)
    wrong[:, :, 0, model.layout.groups() == 1] = 1.0  # of agent 1 too: where it is to agent 0
    plain, tokens = told(model, scene, task, placement, 3)
    other, changed = told(model, scene, task, placement, 3, wrong)
    own = model.layout.latent + 36
    assert torch.equal(plain.T_world_can[:, :, 0], other.T_world_can[:, :, 0])
    assert torch.equal(tokens[:, :, 0, :own], changed[:, :, 0, :own])
    assert (plain.T_world_can[:, 12:, 1] != other.T_world_can[:, 12:, 1]).any()


@pytest.mark.parametrize("offset", [0.0, 0.5, 1.0])
def test_whoever_is_on_turn_is_placed_by_the_relation_to_those_who_were(model, scene, offset):
    """The second sees the first, so what it says of where the first stands counts; in step nobody's word does."""
    wrong = torch.zeros(2, TOKENS, 3, model.layout.width)
    wrong[:, :, 1, model.layout.latent + 36 : model.layout.latent + 72] = 0.3  # agent 1's relation to agent 0
    for task, counts in ((AgenticAsync(offset), True), (AgenticSync(), False)):
        plain, _ = told(model, scene, task, "fuse", 3)
        other, _ = told(model, scene, task, "fuse", 3, wrong)
        moved = (plain.T_world_can[:, 12:, 1] - other.T_world_can[:, 12:, 1]).abs().max() > 1e-3
        assert bool(moved) == counts


def test_relations_between_agents_who_saw_nothing_of_each_other_do_not_count_as_drift(model, scene):
    for task, counted in ((AgenticSync(), False), (AgenticAsync(), True), (PartnerPrediction((0, 1)), True)):
        stats = SamplingStats()
        told(model, scene, task, "fuse", 3, stats=stats)
        assert (stats.pairwise_drifts > 0) == counted
    schedule = PartnerInpainting((0, 1)).schedule(Grid(TOKENS, 3, 0, 2, 8, 2))
    finished = torch.zeros(TOKENS, 3, dtype=torch.bool)
    finished[:2, :2] = True
    for decentralized, pairs in (
        (False, 6),
        (True, 4),
    ):  # each of two with the third, both ways; and the two, both ways
        stats = SamplingStats()
        world = WorldState(model, mask_unknown(scene, schedule.known), schedule, OPTIONS, 1, stats)
        world.make_consistent(torch.zeros(2, TOKENS, 3, model.layout.width), finished, decentralized)
        assert stats.pairwise_drifts == 2 * 2 * pairs


@dataclass(frozen=True)
class Blind:
    """Agent 0 is generated and shown nothing of agent 1's block, though that is given."""

    def schedule(self, grid: Grid) -> MaskSchedule:
        unknown = (torch.arange(grid.agents) == 0) & ~grid.past()
        unseen = torch.zeros(grid.agents, grid.agents, dtype=torch.bool)
        unseen[0, 1] = True
        return MaskSchedule.autoregressive(~unknown, unknown, grid, unseen=unseen, lookahead=False)


@pytest.mark.parametrize("settle", ["off", "firm"])
def test_what_is_given_and_hidden_moves_nobody(model, settle):
    scene = random_scene(1, 16, 2, torch.Generator().manual_seed(4))
    other = scene.T_world_root.clone()
    other[:, 12:, 1, :3, 3] = scene.T_world_root[:, 12:, 0, :3, 3]  # in the middle of where agent 0 is
    options = SamplerOptions(steps=2, settle=settle, any_floor=True)
    once, again = (
        generate(model, each, Blind(), 12, 4, 1, options, torch.Generator().manual_seed(0))
        for each in (scene, scene.replace(T_world_root=other))
    )
    assert torch.equal(once.T_world_root[:, :, 0], again.T_world_root[:, :, 0])


@pytest.mark.parametrize(
    "task, expected",
    [
        (MotionControl((0,)), [(0, 1), (0, 2)]),
        (Blind(), [(0, 2)]),
        (AgenticSync(), []),
        (AgenticAsync(), [(1, 0), (2, 0), (2, 1)]),
        (AgenticAsync(order=(2,)), [(0, 2), (1, 0), (1, 2)]),
        (AgenticAsync(offset=0.0), []),  # all at once: nobody is finished before another
    ],
    ids=str,
)
def test_a_block_is_corrected_by_what_was_given_or_finished_before_it(task, expected):
    plan, saw = task.schedule(Grid(TOKENS, 3, 3, 4, 8, 2)), torch.ones(3, 3, dtype=torch.bool)
    for stage, following in pairwise([*plan.stages, None]):
        saw = shown_to(stage, saw)
        if following is None or following.active != stage.active:  # the block is finished
            others = saw & ~torch.eye(3, dtype=torch.bool) & ~plan.known.all(dim=0)[:, None]
            assert others.nonzero().tolist() == [list(pair) for pair in expected]
