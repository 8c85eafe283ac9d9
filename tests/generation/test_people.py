"""Plans are made for the people who are there, not for the slots of the model."""

import pytest
import torch

from magnet.generation.blending import cat_time
from magnet.generation.conditioning import known_tokens, mask_unknown, occupied
from magnet.generation.rollout import generate, stream
from magnet.generation.stats import SamplingStats
from magnet.generation.world import WorldState
from magnet.motion.scene import Scene
from magnet.sampling.grid import planning_grid
from magnet.sampling.noise import NoiseStream
from magnet.sampling.options import SamplerOptions
from magnet.sampling.sampler import sample
from magnet.tasks import registry
from magnet.tasks.agentic import AgenticAsync, AgenticSync
from magnet.tasks.inbetweening import Inbetweening
from magnet.tasks.joint import Generation, JointFuture
from magnet.tasks.partner import MotionControl, PartnerInpainting, PartnerPrediction
from magnet.testing import random_scene, tiny_denoiser, without_absent
from tests.cases import few

FAST = SamplerOptions(steps=2, stride=2)


@pytest.fixture(scope="module")
def model():
    return tiny_denoiser(max_agents=4, window=8)


def people(slots: list[list[bool]], frames: int = 40) -> Scene:
    """One scene for each row of who is there."""
    scene = random_scene(len(slots), frames, len(slots[0]), torch.Generator().manual_seed(3))
    return without_absent(scene.replace(present=torch.tensor(slots)))


def run(model, scene: Scene, task, context: int = 8, stats: SamplingStats | None = None, seed: int = 0) -> Scene:
    each = [torch.Generator().manual_seed(seed + number) for number in range(scene.scenes)]
    return generate(model, scene, task, context, 40 - context, 1, FAST, each, stats=stats)


def close(a: Scene, b: Scene) -> bool:
    return all(torch.allclose(value, getattr(b, name), atol=1e-5) for name, value in a.tensors().items())


@pytest.mark.parametrize("name", few(registry.names(), 3))
def test_two_people_among_four_slots_cost_and_move_as_in_a_plan_for_two(model, name):
    scene, task, stats = people([[True, True]]), registry.get(name)(), SamplingStats()
    context = 0 if name == "generation" else 8
    made = run(model, scene, task, context, stats)
    schedule = task.schedule(planning_grid(10, 2, context // 4, 8, FAST))
    assert stats.calls == schedule.evaluations
    views = {len(stage.visibility.unique(dim=0)) if stage.visibility is not None else 1 for stage in schedule.stages}
    assert stats.evaluations <= schedule.evaluations * max(views)
    assert made.agents == 4 and torch.equal(made.present, torch.tensor([[True, True, False, False]]))
    if schedule.causal:  # shown block by block, see test_showing
        return
    padded = schedule.padded(4)
    given = mask_unknown(scene.pad_agents(4), padded.known)
    world = WorldState(model, given, padded, FAST, 1)
    start = known_tokens(model, given, padded.known)
    noise = NoiseStream((1, 4, model.layout.width), [torch.Generator().manual_seed(0)], eta=FAST.eta)
    out = sample(
        model.denoise, padded, start, given.present, model.layout, on_stage_end=world.make_consistent, noise=noise
    )
    with torch.no_grad():
        assert close(world.scene(out), made)


@pytest.mark.parametrize("task", few([AgenticAsync(), AgenticAsync(offset=0.5, order=(1,)), AgenticSync()]), ids=str)
def test_nobody_waits_for_free_slots(model, task):
    costs = []
    for slots in (2, 3, 4):
        stats = SamplingStats()
        run(model, people([[True, True]]).pad_agents(slots), task, stats=stats)
        costs.append((stats.calls, stats.evaluations))
    assert len(set(costs)) == 1


@pytest.mark.parametrize("task", few([JointFuture(), AgenticAsync(), Generation(), Inbetweening(every=4)]), ids=str)
def test_what_a_free_slot_holds_changes_nobody(model, task):
    """Free slots before, between and behind people."""
    scene = people([[True, False, True, False], [False, True, True, False]])
    context = 0 if isinstance(task, Generation) else 8
    there = scene.present[:, None, :, None, None]
    junk = scene.replace(
        T_world_root=torch.where(there, scene.T_world_root, scene.T_world_root.flip(1).roll(1, 2)),
        betas=torch.where(scene.present[..., None], scene.betas, 5.0),
    )
    a, b = (run(model, each, task, context) for each in (scene, junk))
    for number in range(2):
        here = scene.present[number]
        assert torch.equal(a.T_world_root[number][:, here], b.T_world_root[number][:, here])
        assert torch.equal(a.body_rot[number][:, here], b.body_rot[number][:, here])
    assert a.T_world_root.isfinite().all()


@pytest.mark.parametrize("task", few([JointFuture(), AgenticAsync(), AgenticSync(), Generation()]), ids=str)
def test_fewer_people_beside_more_in_a_batch_move_as_alone(model, task):
    scene = people([[True, True, False], [True, True, True]])
    context = 0 if isinstance(task, Generation) else 8
    both = run(model, scene, task, context)
    assert close(run(model, scene.select([0]), task, context), both.select([0]))
    assert close(run(model, scene.select([1]), task, context, seed=1), both.select([1]))


def test_slots_in_use_are_those_up_to_the_last_person():
    assert occupied(people([[True, True, False], [True, False, False]])) == 2
    assert occupied(people([[False, False, True, False]])) == 3


def test_scenes_without_the_people_that_a_task_needs_are_named(model):
    two = people([[True, True, True], [True, False, True], [True, True, False]]).replace(names=("a", "b", "c"))
    nobody = people([[True, True], [False, False]])
    for scene, task, message in [
        (nobody, JointFuture(), "scene 1 has nobody in it"),
        (two, PartnerInpainting((1,)), r"scene 1 \(b\) has nobody in slot 1, .* somebody to be generated"),
        (two, MotionControl((0, 1)), r"scene 2 \(c\) has nobody in slot 2, .* somebody to be given"),
        (two, PartnerPrediction((1,)), r"scene 1 \(b\) has nobody in slot 1"),
        (people([[True, True]]), PartnerInpainting((2,)), "target 2: the grid has agents 0 to 1"),
        (people([[False, True]]), PartnerPrediction((1,)), "nobody in slot 0, .* given"),
    ]:
        with pytest.raises(ValueError, match=message):
            run(model, scene, task)
    with pytest.raises(ValueError, match="scene 1 has nobody in it"):
        stream(model, nobody, JointFuture(), 8, None)


def test_a_stream_without_end_waits_for_nobody(model):
    scene = people([[True, True]], 8)
    begun = stream(model, scene, AgenticAsync(), 8, None, 1, FAST, torch.Generator().manual_seed(0), chunk=4)
    ended = stream(model, scene, AgenticAsync(), 8, 400, 1, FAST, torch.Generator().manual_seed(0), chunk=4)
    a, b = (cat_time([next(chunks) for _ in range(3)]) for chunks in (begun, ended))
    assert close(a, b)
