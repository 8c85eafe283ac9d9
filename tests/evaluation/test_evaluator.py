import json
import math
import warnings
from dataclasses import replace
from typing import ClassVar

import lightning as L
import pytest
import torch

from magnet.datamodules.options import HeldOutScenes
from magnet.evaluation.evaluator import MODEL, TRAINING, TRUTH, Evaluator, aligned
from magnet.evaluation.results import Results
from magnet.metrics import ClipMeans, Column, beside
from magnet.metrics.base import clip_sums
from magnet.metrics.registry import METRICS
from magnet.motion.frames import canonical_frame, from_planar, to_planar
from magnet.motion.scene import Scene, concatenate
from magnet.plugins import Registered
from magnet.sampling.options import SamplerOptions
from magnet.sampling.schedule import Grid
from magnet.tasks import registry
from magnet.testing import random_scene, tiny_denoiser
from tests.cases import few, some_slow
from tests.datamodules.fakes import FakeData, random_clip

FAST = SamplerOptions(steps=2, stride=2)
TESTED = HeldOutScenes(context_frames=16, horizon_frames=20, batch_size=3)


def data(clips: list | None = None, max_agents: int = 3, **options) -> FakeData:
    clips = clips or [random_clip(f"{split}{k}", 120, 2, split=split) for split in ("train", "test") for k in range(3)]
    return FakeData(clips, max_agents=max_agents, test=replace(TESTED, **options))


def prepared(**options) -> tuple[Evaluator, L.Trainer]:
    model = tiny_denoiser(max_agents=3)
    evaluation = Evaluator(model, **{"samples": 3, "sampler": FAST, "baseline_stride": 10, **options})
    trainer = L.Trainer(accelerator="cpu", logger=False, enable_progress_bar=False, enable_model_summary=False)
    return evaluation, trainer


def run(datamodule: FakeData, **options) -> Evaluator:
    evaluation, trainer = prepared(**options)
    trainer.test(evaluation, datamodule=datamodule, verbose=False)
    return evaluation


def predicted(datamodule: FakeData, **options) -> tuple[Scene, Evaluator]:
    """All scenes that `magnet predict` writes, whatever batches they came in."""
    evaluation, trainer = prepared(**options)
    return concatenate(trainer.predict(evaluation, datamodule=datamodule)), evaluation


@pytest.fixture(scope="module")
def measured() -> Results:
    """Everything by default."""
    return run(data()).results


@pytest.fixture(scope="module")
def answered() -> tuple[Scene, Evaluator]:
    return predicted(data())


def test_every_method_is_measured_on_the_same_scenes(measured):
    results = measured
    memorisation = {f"nearest_training{end}" for end in ("", "_low", "_high")}
    answering = {MODEL, "NN", "RS", "zero velocity", "ridge", "NN, not aligned", "RS, not aligned"}
    assert set(results.rows) == answering | {TRUTH, TRAINING}
    for method in answering:
        assert {"fd", "mi", "fs", "ip_ratio", "mpjpe", "mpjve", "mpjpe@0.5s"} <= set(results.rows[method])
    assert {"fd", "fd_pair", "fs", "ip_ratio"} <= set(results.rows[TRAINING])
    compared = {name for name in results.rows[MODEL] if beside(name, results.columns)}
    assert {"mpjpe", "mpjpe@0.5s", "mpjve", "div"} <= compared
    assert results.rows[TRAINING].keys() == results.rows[MODEL].keys() - compared - memorisation
    assert results.rows[MODEL]["div"] > 0
    for method in ("NN", "zero velocity", "ridge"):
        assert results.rows[method]["div"] == 0
    assert {method for method, row in results.rows.items() if "nearest_training" in row} == {MODEL, TRUTH}
    assert results.rows["ridge"]["mpjpe"] < results.rows["zero velocity"]["mpjpe"]
    assert results.meta["test scenes"] == 9 and results.meta["seed"] == 1111


class Divergence(ClipMeans):
    columns: ClassVar = {
        "divergence": Column("divergence", "m", "real", "how high heads are, called much like DIV"),
        "mpj_count": Column("joints", "", "", "the same, called much like MPJPE"),
        "miss": Column("miss", "m", "low", "the same, of a recording", beside="recording"),
        "spread": Column("spread", "m", "", "the same, of samples", beside="samples"),
    }

    def measure(self, futures):
        return [clip_sums(futures.generated[..., 15, 1], futures.scored)] * 4


def test_the_training_sets_row_leaves_out_what_columns_say_and_nothing_by_its_name(monkeypatch):
    monkeypatch.setattr(METRICS, "discovered", True)
    monkeypatch.setattr(METRICS, "known", {"divergence": Registered("divergence", Divergence, "a plug-in")})
    rows = run(data(), task=registry.get("generation")()).results.rows
    own = {row: set(Divergence.columns) & rows[row].keys() for row in rows}
    everything = set(Divergence.columns)
    assert own == {MODEL: everything - {"miss"}, TRAINING: {"divergence", "mpj_count"}, TRUTH: everything}


class OfTheRecording(Divergence):
    """Fails for the row of the ground truth alone."""

    def measure(self, futures):
        if self.of == "truth":
            raise KeyError("of theirs")
        return super().measure(futures)


def test_a_strangers_metric_that_fails_for_one_row_is_left_out_of_all_and_nothing_else_is(monkeypatch, measured):
    monkeypatch.setattr(METRICS, "discovered", True)
    known = {"theirs": Registered("theirs", OfTheRecording, "their-package 1.0")}
    monkeypatch.setattr(METRICS, "known", known)
    with pytest.warns(UserWarning, match=r"metric theirs is left out, it fails: KeyError: .*\(of their-package 1.0\)"):
        rows = run(data()).results.rows
    assert {name: set(row) for name, row in rows.items()} == {name: set(row) for name, row in measured.rows.items()}


class Unreal(Divergence):
    """NaN of samples, infinite of recordings, each in one number."""

    def measure(self, futures):
        (total, count), *others = super().measure(futures)
        return [(total * (math.inf if self.of == "truth" else math.nan), count), *others]


def test_a_strangers_metric_that_is_no_number_over_all_scenes_is_named(monkeypatch):
    monkeypatch.setattr(METRICS, "discovered", True)
    monkeypatch.setattr(METRICS, "known", {"theirs": Registered("theirs", Unreal, "their-package 1.0")})
    with pytest.warns(UserWarning, match="metric theirs") as warned:
        rows = run(data(), baselines=False).results.rows
    assert math.isnan(rows[MODEL]["divergence"]) and math.isinf(rows[TRUTH]["divergence"])
    assert [str(each.message) for each in warned if "metric" in str(each.message)] == [
        "metric theirs gave nan, inf over all scenes: divergence in magnet, ground truth; results.json holds null "
        "there (of their-package 1.0)"
    ]


def test_a_training_stretch_met_again_is_found_by_nearest_neighbour():
    clips = [random_clip("a", 120, 2, split=split) for split in ("train", "test")]
    rows = run(data(clips)).results.rows
    assert rows["NN"]["mpjpe"] < 0.5 * rows["RS"]["mpjpe"]


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


@pytest.mark.parametrize("name", few(registry.names(), 4))
def test_nothing_that_a_task_does_not_give_reaches_the_samples(name):
    """From the data loader on: the samples that are measured are bit-identical when the rest is noise."""
    seen: list[Scene] = []
    options = {"max_agents": 3, "test": TESTED}
    clips = [random_clip(f"{split}{k}", 120, 2, split=split) for split in ("train", "test") for k in range(3)]
    noisy = NoisyData(clips, **options)
    task = registry.get(name)()
    noisy.known = task.schedule(Grid(9, 3, 4, 2, 8, 2)).known
    for datamodule in (FakeData(clips, **options), noisy):
        model = tiny_denoiser(max_agents=3)
        evaluation = Evaluator(model, task, samples=2, sampler=FAST, baselines=False)
        evaluation.start(datamodule)
        batch = next(iter(datamodule.test_dataloader()))
        seen.append(evaluation.sample(batch, 2, evaluation.generators_of(batch.scenes)))
    plain, replaced = seen
    assert torch.equal(plain.body_rot, replaced.body_rot)
    assert torch.equal(plain.T_world_root, replaced.T_world_root)


QUICK = ("generation", "joint_future")


@pytest.mark.parametrize("name", some_slow(registry.names(), *(set(registry.names()) - set(QUICK))))
def test_every_task_gives_a_table(name):
    results = run(data(), task=registry.get(name)(), baselines=False).results
    assert {"fd", "mi", "fs", "ip_ratio"} <= set(results.rows[MODEL])
    assert ("mpjpe" in results.rows[MODEL]) == (name != "generation")


def test_baselines_are_asked_only_where_their_past_is_given():
    from magnet.tasks.partner import PartnerInpainting

    assert set(run(data(), task=PartnerInpainting()).results.rows) == {MODEL, TRUTH, TRAINING}


def test_scores_follow_the_seed():
    same = [run(data(), baselines=False, seed=3).results.rows[MODEL] for _ in range(2)]
    assert same[0] == same[1]
    assert run(data(), baselines=False, seed=4).results.rows[MODEL] != same[0]


@pytest.mark.slow
def test_samples_do_not_depend_on_the_batch_that_they_are_drawn_in(measured, answered):
    """Random retrieval draws, too: a scene's noise is its own."""
    one_by_one = run(data(batch_size=1)).results
    for method in (MODEL, "RS"):
        alone, together = one_by_one.rows[method], measured.rows[method]
        assert alone.keys() == together.keys()
        for metric in alone:
            assert alone[metric] == pytest.approx(together[metric], rel=1e-3, abs=1e-4, nan_ok=True), (method, metric)
    (alone, _), (together, _) = predicted(data(batch_size=1)), answered
    torch.testing.assert_close(alone.body_rot, together.body_rot, rtol=0, atol=1e-4)
    torch.testing.assert_close(alone.T_world_root, together.T_world_root, rtol=0, atol=1e-4)


def test_no_two_samples_share_their_noise():
    evaluation, _ = prepared()
    seeds = [g.initial_seed() for g in evaluation.generators_of(2)]
    evaluation.scenes = 2
    seeds += [g.initial_seed() for g in evaluation.generators_of(1)]
    assert len(set(seeds)) == len(seeds) == 9


def test_prediction_counts_what_it_costs(answered):
    """Two denoising steps for the first token after the past, and one for each token that follows on the slope."""
    scenes, evaluation = answered
    stats = evaluation.stats
    tokens = scenes.frames // 4
    past = evaluation.context // 4
    assert (evaluation.scenes, scenes.scenes, stats.runs) == (9, 27, 3)
    assert stats.means()["calls"] == stats.evaluations == FAST.steps + tokens - past - 1
    assert evaluation.facts()["sampling"]["evaluations"] == stats.evaluations
    said = json.loads(json.dumps(evaluation.facts()["sampler"]))
    assert (said["steps"], said["guidance"]["kind"]) == (FAST.steps, FAST.guidance.kind), "as a configuration has it"


@pytest.mark.parametrize(
    "name", some_slow(["generation", "partner_inpainting", "inbetweening"], "partner_inpainting", "inbetweening")
)
def test_no_past_is_no_past_that_baselines_could_continue(name: str):
    datamodule = data(context_frames=0)
    results = run(datamodule, task=registry.get(name)()).results
    assert set(results.rows) == {MODEL, TRUTH, TRAINING}
    assert math.isfinite(results.rows[MODEL]["fd"])


def test_where_nothing_went_before_scenes_are_placed_at_their_first_frame():
    datamodule = data(context_frames=0)
    seen = run(datamodule, task=registry.get("generation")())
    assert (seen.scoring.now, seen.scoring.past_is_given) == (0, False)
    batch = next(iter(datamodule.test_dataloader()))
    made = seen.sample(batch, 3, seen.generators_of(batch.scenes))
    yaw, ground = to_planar(canonical_frame(made.T_world_root)[:, 0])
    there = made.present[..., None]
    middle = torch.where(there, ground, 0).sum(dim=1) / there.sum(dim=1)
    assert middle.abs().max() < 1e-5
    assert yaw[:, 0].abs().max() < 1e-5


@pytest.mark.slow
def test_composed_scenes_have_baselines_of_their_size(monkeypatch):
    monkeypatch.setattr("magnet.evaluation.scoring.BASELINE_COMPOSED", 8)
    clips = [random_clip(f"{split}{k}", 120, k, split=split) for split in ("train", "test") for k in (1, 2)]
    results = run(data(clips, composed=2)).results
    assert math.isfinite(results.rows["NN"]["mpjpe"])
    assert math.isfinite(results.rows["ridge"]["mpjpe"])
    assert math.isfinite(results.rows[MODEL]["nearest_training"])


def test_aligned_scenes_share_one_world(scene):
    seen = aligned(scene.transformed(from_planar(torch.tensor(1.0), torch.tensor([3.0, 2.0]))), 20)
    yaw, ground = to_planar(canonical_frame(seen.T_world_root)[:, 20])
    assert ground.mean(dim=1).abs().max() < 1e-5
    assert yaw[:, 0].abs().max() < 1e-5


def test_a_context_of_broken_tokens_is_refused():
    datamodule = data(context_frames=15)
    with pytest.raises(ValueError, match="context_frames is 15"):
        run(datamodule)


class Foreign(L.LightningDataModule):
    def test_dataloader(self):
        return torch.utils.data.DataLoader(torch.zeros(4, 2))

    predict_dataloader = test_dataloader


@pytest.mark.parametrize("what", ["test", "predict"])
@pytest.mark.parametrize("named", [True, False])
def test_data_without_context_and_horizon_are_refused(what, named):
    evaluation, trainer = prepared(baselines=False)
    given = {"datamodule": Foreign()} if named else {"dataloaders": Foreign().test_dataloader()}
    got = r"\S+\.Foreign" if named else "no data module"
    with pytest.raises(ValueError, match=f"data: got {got}, expected a MotionDataModule, .* see docs/own.md"):
        getattr(trainer, what)(evaluation, **given)


@pytest.mark.parametrize(
    ("what", "trained"), [("test", "smplx-neutral"), ("predict", "smplx-neutral"), ("predict", "open-1")]
)
def test_data_of_another_body_than_the_models_are_warned_of(what, trained):
    evaluation, trainer = prepared(baselines=False, samples=1)
    evaluation.denoiser.trained_body = trained
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        getattr(trainer, what)(evaluation, datamodule=data())
    said = [str(each.message) for each in caught if "trained with body" in str(each.message)]
    assert len(said) == (trained != "open-1")
    assert all("'smplx-neutral', but these people have 'open-1'" in each for each in said)
    assert all(each.endswith("; give its file: --data.body_model FILE") for each in said)


@pytest.mark.parametrize("name", ["samples", "baseline_stride"])
def test_no_samples_and_no_stride_are_refused(name):
    with pytest.raises(ValueError, match=f"{name}: got 0, expected at least 1"):
        run(data(), **{name: 0})
