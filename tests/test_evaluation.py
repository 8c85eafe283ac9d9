import math

import lightning as L
import pytest
import torch

from magnet.denoiser.generation import SamplerOptions
from magnet.evaluation import MODEL, TRUTH, Evaluation, aligned
from magnet.motion.frames import canonical_frame, from_planar, to_planar
from magnet.motion.scene import Scene
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
    methods = {MODEL, "NN", "RS", "held pose", "NN, not aligned", "RS, not aligned", TRUTH, "training windows"}
    assert set(results.rows) == methods
    for method in methods - {TRUTH, "training windows"}:
        assert {"fd", "mi", "fs", "ip_ratio", "mpjpe", "mpjve", "mpjpe@0.5s"} <= set(results.rows[method])
    assert results.rows[MODEL]["div"] > 0
    assert results.rows["NN"]["div"] == results.rows["held pose"]["div"] == 0
    assert results.meta["test scenes"] == 9


def test_a_training_stretch_met_again_is_found_by_nearest_neighbour():
    clips = [random_clip("a", 120, 2, split=split) for split in ("train", "test")]
    row = run(data(clips)).results.rows["NN"]
    assert row["mpjpe"] < 0.5 * run(data(clips)).results.rows["RS"]["mpjpe"]


def test_scores_do_not_depend_on_the_recorded_future_that_the_sampler_might_see(monkeypatch):
    """The scenes handed to the model have noise for a future: same samples, same scores."""
    plain = run(data()).results.rows[MODEL]
    original = Evaluation._model

    def noisy(self, model):
        predict = original(self, model)

        def with_noise(scene: Scene, samples: int, generator: torch.Generator) -> Scene:
            noise = random_scene(scene.scenes, scene.frames, scene.agents, torch.Generator().manual_seed(5))
            noise = noise.replace(present=scene.present, betas=scene.betas)
            cut = self.context
            scene = scene.replace(
                body_rot=torch.cat([scene.body_rot[:, :cut], noise.body_rot[:, cut:]], dim=1),
                T_world_root=torch.cat([scene.T_world_root[:, :cut], noise.T_world_root[:, cut:]], dim=1),
            )
            return predict(scene, samples, generator)

        return with_noise

    monkeypatch.setattr(Evaluation, "_model", noisy)
    assert run(data()).results.rows[MODEL] == plain


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
