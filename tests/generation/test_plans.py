"""Plans of the sampler in whole scenes: pyramids inside the window, and levels of each token's own."""

import itertools

import pytest
import torch

from magnet.generation.rollout import stream
from magnet.motion.scene import Scene, cat_time
from magnet.sampling.options import SamplerOptions
from magnet.tasks import registry
from magnet.tasks.joint import JointFuture
from magnet.testing import random_scene
from tests.cases import few

PYRAMID = SamplerOptions(steps=12, stride=2, pyramid_offset=1)
INDEPENDENT = SamplerOptions(steps=4, stride=2, pyramid_offset=0, noise_sampling="independent")
CANNOT_ROLL = ("agentic_async", "agentic_sync", "inbetweening", "motion_control")


def run(model, scene: Scene, task, options: SamplerOptions, context: int = 16, frames: int | None = 32, **more):
    generator = torch.Generator().manual_seed(0)
    return stream(model, scene, task, context, frames, 1, options, generator, **more)


@pytest.mark.parametrize("options", [PYRAMID, INDEPENDENT], ids=["pyramid", "independent"])
@pytest.mark.parametrize("name", few(registry.names(), 3))
def test_every_task_samples_whole_scenes_by_these_plans(model, scene, name, options):
    if options is PYRAMID and name in CANNOT_ROLL:
        pytest.skip("refuses to roll, with a reason: tests/tasks/test_laws.py")
    context = 0 if name == "generation" else 16
    made = cat_time(list(run(model, scene, registry.get(name)(), options, context, 48 - context)))
    assert made.T_world_root.isfinite().all()
    assert torch.equal(made.T_world_root[made.given], scene.slice(0, 48).T_world_root[made.given])


@pytest.mark.parametrize("options", [PYRAMID, INDEPENDENT], ids=["pyramid", "independent"])
def test_scenes_without_end_begin_as_long_ones_do(model, options):
    scene = random_scene(1, 16, 2, torch.Generator().manual_seed(4))
    whole = cat_time(list(run(model, scene, JointFuture(), options, frames=120, chunk=4)))
    chunks = run(model, scene, JointFuture(), options, frames=None, chunk=4)
    begun = cat_time(list(itertools.islice(chunks, 6)))
    assert torch.allclose(begun.T_world_root, whole.slice(0, begun.frames).T_world_root, atol=1e-5)


def test_what_the_target_did_before_is_given_and_what_it_does_after_is_not_read(model, scene, generator):
    task = registry.get("partner_inpainting")((1,), own_past=True)
    noise = random_scene(2, 64, 3, generator)
    other = scene.replace(
        body_rot=torch.cat([scene.body_rot[:, :16], noise.body_rot[:, 16:]], dim=1),
        T_world_root=torch.cat([scene.T_world_root[:, :16], 50 * noise.T_world_root[:, 16:]], dim=1),
    )
    mixed = scene.replace(body_rot=scene.body_rot.clone(), T_world_root=scene.T_world_root.clone())
    mixed.body_rot[:, :, 1], mixed.T_world_root[:, :, 1] = other.body_rot[:, :, 1], other.T_world_root[:, :, 1]
    a, b = (cat_time(list(run(model, s, task, PYRAMID))) for s in (scene, mixed))
    assert torch.equal(a.T_world_root, b.T_world_root) and torch.equal(a.body_rot, b.body_rot)
    assert a.given[0, :16].all() and a.given[0, 16:].float().mean(dim=0).tolist() == [1, 0, 1]
    assert torch.equal(a.T_world_root[:, :16], scene.T_world_root[:, :16])
