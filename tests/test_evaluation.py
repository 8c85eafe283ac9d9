import math

import lightning as L
import pytest
import torch

from magnet.denoiser.generation import SamplerOptions
from magnet.evaluation import HALVES, MODEL, TRAINING, TRUTH, Evaluation, aligned
from magnet.motion.frames import canonical_frame, from_planar, to_planar
from magnet.motion.scene import Scene
from magnet.sampling.schedule import Grid
from magnet.tasks import registry
from magnet.testing import random_scene, tiny_denoiser
from tests.datamodules.fakes import FakeData, random_clip

FAST = SamplerOptions(steps=2, stride=2)


def data(clips: list | None = None, **options) -> FakeData:
    clips = clips or [random_clip(f"{split}{k}", 120, 2, split=split) for split in ("train", "test") for k in range(3)]
    return FakeData(clips, max_agents=3, context_frames=16, horizon_frames=20, test_batch_size=3, **options)


def run(datamodule: FakeData, **options) -> Evaluation:
    model = tiny_denoiser(max_agents=3)
    evaluation = Evaluation(samples=3, options=FAST, baseline_stride=10, **options)
    model.configure_test(evaluation)
    trainer = L.Trainer(accelerator="cpu", logger=False, enable_progress_bar=False, enable_model_summary=False)
    trainer.test(model, datamodule=datamodule, verbose=False)
    return evaluation


def test_every_method_is_measured_on_the_same_scenes():
    results = run(data()).results
    methods = {MODEL, "NN", "RS", "held pose", "NN, not aligned", "RS, not aligned", TRUTH, TRAINING, HALVES}
    assert set(results.rows) == methods
    for method in methods - {TRUTH, TRAINING, HALVES}:
        assert {"fd", "mi", "fs", "ip_ratio", "mpjpe", "mpjve", "mpjpe@0.5s"} <= set(results.rows[method])
    assert results.rows[MODEL]["div"] > 0
    assert results.rows["NN"]["div"] == results.rows["held pose"]["div"] == 0
    assert results.meta["test scenes"] == 9


def test_a_training_stretch_met_again_is_found_by_nearest_neighbour():
    clips = [random_clip("a", 120, 2, split=split) for split in ("train", "test")]
    row = run(data(clips)).results.rows["NN"]
    assert row["mpjpe"] < 0.5 * run(data(clips)).results.rows["RS"]["mpjpe"]


class NoisyData(FakeData):
    """Test scenes in which everything that a schedule does not know has been replaced by noise."""

    known: torch.Tensor

    def test_dataloader(self):
        generator = torch.Generator().manual_seed(5)
        for scene in super().test_dataloader():
            noise = random_scene(scene.scenes, scene.frames, scene.agents, generator)
            keep = self.known.repeat_interleave(4, dim=0)[: scene.frames, :, None, None]
            yield scene.replace(
                body_rot=torch.where(keep[..., None], scene.body_rot, noise.body_rot),
                T_world_root=torch.where(keep, scene.T_world_root, noise.T_world_root),
            )


@pytest.mark.parametrize("name", registry.names())
def test_nothing_that_a_task_does_not_give_reaches_the_samples(name):
    """From the data loader on: the samples that are measured are bit-identical when the rest is noise."""
    seen: list[Scene] = []
    options = {"max_agents": 3, "context_frames": 16, "horizon_frames": 20, "test_batch_size": 3}
    clips = [random_clip(f"{split}{k}", 120, 2, split=split) for split in ("train", "test") for k in range(3)]
    noisy = NoisyData(clips, **options)
    task = registry.get(name)()
    noisy.known = task.schedule(Grid(9, 3, 4, 2, 8, 2)).known
    for datamodule in (FakeData(clips, **options), noisy):
        model = tiny_denoiser(max_agents=3)
        evaluation = Evaluation(task, samples=2, options=FAST, baselines=False)
        evaluation.start(model, datamodule)
        batch = next(iter(datamodule.test_dataloader()))
        seen.append(evaluation.methods[MODEL](batch, 2, evaluation._generator(model, 0)))
    plain, replaced = seen
    assert torch.equal(plain.body_rot, replaced.body_rot)
    assert torch.equal(plain.T_world_root, replaced.T_world_root)


@pytest.mark.parametrize("name", registry.names())
def test_every_task_gives_a_table(name):
    results = run(data(), task=registry.get(name)(), baselines=False).results
    assert {"fd", "mi", "fs", "ip_ratio"} <= set(results.rows[MODEL])
    assert ("mpjpe" in results.rows[MODEL]) == (name != "generation")


def test_baselines_are_asked_only_where_their_past_is_given():
    from magnet.tasks.partner import PartnerInpainting

    assert set(run(data(), task=PartnerInpainting()).results.rows) == {MODEL, TRUTH, TRAINING, HALVES}


def test_scores_follow_the_seed():
    same = [run(data(), baselines=False, seed=3).results.rows[MODEL] for _ in range(2)]
    assert same[0] == same[1]
    assert run(data(), baselines=False, seed=4).results.rows[MODEL] != same[0]


def test_composed_scenes_have_baselines_of_their_size():
    clips = [random_clip(f"{split}{k}", 120, k, split=split) for split in ("train", "test") for k in (1, 2)]
    results = run(data(clips, composed_test=2)).results
    assert math.isfinite(results.rows["NN"]["mpjpe"])


def test_aligned_scenes_share_one_world(scene):
    seen = aligned(scene.moved(from_planar(torch.tensor(1.0), torch.tensor([3.0, 2.0]))), 20)
    yaw, ground = to_planar(canonical_frame(seen.T_world_root)[:, 20])
    assert ground.mean(dim=1).abs().max() < 1e-5
    assert yaw[:, 0].abs().max() < 1e-5


def test_a_context_of_broken_tokens_is_refused():
    datamodule = data()
    datamodule.context_frames = 15
    with pytest.raises(ValueError, match="context_frames is 15"):
        run(datamodule)
