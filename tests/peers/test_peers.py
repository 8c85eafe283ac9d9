"""Laws of every peer: its training, and what its answers may depend on."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from lightning.pytorch import Trainer
from torch import Tensor

from magnet import peers
from magnet.body import load_body
from magnet.datamodules.options import HeldOutScenes
from magnet.evaluation.evaluator import Evaluator
from magnet.motion.scene import Scene
from magnet.peers import Peer
from magnet.sampling.schedule import Grid
from magnet.tasks import registry
from magnet.tasks.base import Task
from magnet.testing import random_scene, tiny_tokenizer
from tests.cases import few
from tests.datamodules.fakes import FakeData, random_clip
from tests.test_configs import ROOT, said

CONFIGS = sorted((ROOT / "report").glob("peer_*.yaml"))
NAMES = [path.stem for path in CONFIGS]
QUIET: dict[str, Any] = {
    "accelerator": "cpu",
    "logger": False,
    "enable_progress_bar": False,
    "enable_model_summary": False,
}
CONTEXT, HORIZON, SAMPLES = 8, 10, 2
TASKS = {
    "peer_ready_to_react": ["joint_future", "partner_prediction", "motion_control"],
    "peer_remos": ["partner_inpainting"],
    "peer_duolando": ["partner_inpainting"],
}
CASES = [(name, task) for name, tasks in TASKS.items() for task in tasks]


@pytest.fixture(scope="module")
def trained() -> dict[str, Peer]:
    """Every peer after two steps of its own configuration, at a tiny size."""
    data = FakeData([random_clip("a", 60), random_clip("b", 60)], window_frames=24, batch_size=2, epoch_size=4)
    models = {}
    for path in CONFIGS:
        options = said(path)["model"]
        kind = getattr(peers, options["class_path"].rpartition(".")[2])
        network = {"width": 24, "layers": 1, "heads": 2, "mlp_ratio": 1}
        with torch.random.fork_rng():
            torch.manual_seed(0)
            model = kind(**{**options["init_args"], "tokenizer": None, "network": network, "window": 6})
            model.build(tiny_tokenizer(quantizer={"codebook_dim": 16, "codebook_size": 32, "num_quantizers": 2}))
            before = {name: each.detach().clone() for name, each in model.named_parameters() if each.requires_grad}
            trainer = Trainer(max_steps=2, enable_checkpointing=False, limit_val_batches=0, **QUIET)
            trainer.fit(model, datamodule=data)
        left = [name for name, each in model.named_parameters() if name in before and torch.equal(each, before[name])]
        assert not left, f"{path.stem}: not trained: {left}"
        models[path.stem] = model.eval()
    return models


def task_of(name: str) -> Task:
    return registry.get(name)()


def people(seed: int = 0) -> Scene:
    return random_scene(2, CONTEXT + HORIZON, 2, torch.Generator().manual_seed(seed))


def sources(seed: int = 0) -> list[torch.Generator]:
    return [torch.Generator().manual_seed(100 * seed + k) for k in range(2 * SAMPLES)]


def known_of(task: str) -> Tensor:
    return registry.get(task)().schedule(Grid(5, 2, CONTEXT // 4)).known


def sampled(model: Peer, scene: Scene, task: str, seed: int = 0) -> Scene:
    return model.sample(scene, known_of(task), CONTEXT + HORIZON, SAMPLES, sources(seed))


@pytest.mark.parametrize("name", NAMES)
def test_a_scene_is_validated_with_the_same_noise_in_any_batch(name: str, trained: dict[str, Peer]) -> None:
    found = []
    for size in (1, 3, 100):
        clips = [random_clip(f"{k}", 70 + 30 * k, split="val") for k in range(3)]
        data = FakeData(clips, window_frames=24, val_batch_size=size)
        found.append(Trainer(**QUIET).validate(trained[name], data, verbose=False)[0]["val/loss"])
    assert found == pytest.approx([found[0]] * 3, rel=1e-5)


def test_every_configured_peer_is_here() -> None:
    assert set(NAMES) == set(TASKS)


@pytest.mark.parametrize(("name", "task"), few(CASES))
def test_a_peer_answers_as_a_predictor_by_its_seeds(name: str, task: str, trained: dict[str, Peer]) -> None:
    predictor = trained[name].predictor(task_of(task), CONTEXT, HORIZON, load_body())
    joints = predictor(people(), SAMPLES, sources())
    assert joints.shape == (SAMPLES, 2, HORIZON, 2, 22, 3) and bool(joints.isfinite().all())
    assert torch.equal(joints, predictor(people(), SAMPLES, sources()))
    generated = ~known_of(task)[-1]
    other = predictor(people(), SAMPLES, sources(1))
    assert not torch.equal(joints[..., generated, :, :], other[..., generated, :, :])
    alone = predictor(people().select([1]), SAMPLES, sources()[SAMPLES:])
    torch.testing.assert_close(alone[:, 0], joints[:, 1], atol=1e-4, rtol=0)


@pytest.mark.parametrize(("name", "task"), few(CASES))
def test_what_is_given_comes_back_and_nothing_else_is_read(name: str, task: str, trained: dict[str, Peer]) -> None:
    scene, hidden = people(), people(1)
    keep = known_of(task).repeat_interleave(4, dim=0)[: scene.frames]
    made = sampled(trained[name], scene, task)
    for field in ("body_rot", "T_world_root"):
        given = getattr(scene.repeat(SAMPLES), field)
        assert torch.equal(getattr(made, field)[:, keep], given[:, keep])
    blend = keep[..., None, None]
    other = scene.replace(
        body_rot=torch.where(blend[..., None], scene.body_rot, hidden.body_rot),
        T_world_root=torch.where(blend, scene.T_world_root, hidden.T_world_root),
    )
    assert torch.equal(sampled(trained[name], other, task).T_world_root, made.T_world_root)


def test_an_online_peer_does_not_look_ahead(trained: dict[str, Peer]) -> None:
    """The partner's motion from frame 12 on changes nothing up to there, bodies included, and something after it."""
    scene, later, at = people(), people(1), CONTEXT + 4
    frames = torch.arange(scene.frames) >= at
    moved = torch.zeros(scene.frames, 2, dtype=torch.bool)
    moved[frames, 1] = True
    changed = scene.replace(
        body_rot=torch.where(moved[..., None, None, None], later.body_rot, scene.body_rot),
        T_world_root=torch.where(moved[..., None, None], later.T_world_root, scene.T_world_root),
    )
    assert bool(known_of("motion_control")[:, 1].all())
    made, other = (sampled(trained["peer_ready_to_react"], each, "motion_control") for each in (scene, changed))
    for field in ("body_rot", "T_world_root"):
        ours, theirs = getattr(made, field)[:, :, 0], getattr(other, field)[:, :, 0]
        assert torch.equal(ours[:, : at + 4], theirs[:, : at + 4])  # the step that begins at 12 has seen up to 12
        assert not torch.equal(ours[:, at + 4 :], theirs[:, at + 4 :])


@pytest.mark.parametrize("name", NAMES)
def test_a_peer_says_what_it_cannot_do(name: str, trained: dict[str, Peer]) -> None:
    refused = {"peer_ready_to_react": "partner_inpainting"}.get(name, "joint_future")
    with pytest.raises(ValueError, match=r"partner_inpainting|context frames"):
        trained[name].predictor(task_of(refused), CONTEXT, HORIZON, load_body())
    single = people().replace(present=torch.tensor([[True, False]]).expand(2, 2))
    with pytest.raises(ValueError, match="two"):
        sampled(trained[name], single, TASKS[name][0])


@pytest.mark.parametrize("name", NAMES)
def test_a_peer_comes_back_from_its_checkpoint(name: str, trained: dict[str, Peer], tmp_path: Any) -> None:
    model = trained[name]
    checkpoint: dict[str, Any] = {"state_dict": model.state_dict(), "hyper_parameters": dict(model.hparams)}
    model.on_save_checkpoint(checkpoint)
    torch.save(checkpoint, tmp_path / "peer.ckpt")
    again = type(model).load(tmp_path / "peer.ckpt")
    task = TASKS[name][0]
    made, theirs = (sampled(each, people(), task) for each in (model, again))
    assert torch.equal(made.T_world_root, theirs.T_world_root)


def test_a_peer_is_measured_as_a_model_is_in_a_row_of_its_name(trained: dict[str, Peer]) -> None:
    test = HeldOutScenes(context_frames=CONTEXT, horizon_frames=HORIZON)
    data = FakeData([random_clip(split, 60, split=split) for split in ("train", "test")], test=test)
    evaluator = Evaluator(trained["peer_remos"], task_of("partner_inpainting"), samples=SAMPLES, baselines=False)
    trainer = Trainer(**QUIET)
    trainer.test(evaluator, datamodule=data, verbose=False)
    assert evaluator.results is not None
    assert evaluator.results.rows.keys() == {"ReMoS", "ground truth"}
    scenes = trainer.predict(evaluator, datamodule=data)
    assert scenes[0].frames == CONTEXT + HORIZON
