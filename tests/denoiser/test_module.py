import copy
from pathlib import Path

import lightning as L
import pytest
import torch
import torch.multiprocessing as mp

import magnet
from magnet import checkpoints
from magnet.datamodules.clip import Clip
from magnet.denoiser.module import Denoiser
from magnet.generation.rollout import generate
from magnet.motion.scene import Scene
from magnet.testing import random_scene, tiny_denoiser, tiny_tokenizer
from tests.cases import few
from tests.datamodules.fakes import FakeData, couples_and_singles, random_clip
from tests.processes import as_by_torchrun, free_port

SIZES = {"network": {"width": 32, "layers": 1, "heads": 2, "mlp_ratio": 2, "level_width": 16}}


def tokenizer_file(tmp_path) -> str:
    """A tokenizer's checkpoint, as its own training would leave it."""
    return save(tiny_tokenizer(), tmp_path / "tokenizer.ckpt")


def save(module: L.LightningModule, path) -> str:
    """A checkpoint as a Trainer writes it."""
    trainer = L.Trainer(logger=False, enable_checkpointing=False, accelerator="cpu")
    trainer.strategy.connect(module)
    trainer.save_checkpoint(path)
    return str(path)


def data() -> FakeData:
    clips = couples_and_singles() + couples_and_singles("val")
    return FakeData(clips, window_frames=32, batch_size=4, max_agents=3, epoch_size=12)


def trainer(steps: int, **options) -> L.Trainer:
    return L.Trainer(
        max_steps=steps,
        accelerator="cpu",
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        **{"enable_checkpointing": False, "limit_val_batches": 1, **options},
    )


def fitted(model: Denoiser, steps: int, ckpt_path: str | None = None, **options) -> L.Trainer:
    run = trainer(steps, **options)
    run.fit(model, datamodule=data(), ckpt_path=ckpt_path, weights_only=True)
    return run


def build(tmp_path, **options) -> Denoiser:
    torch.manual_seed(3)
    fields = {**SIZES, "optimizer": {"warmup_steps": 1}}
    fields |= {
        key: {**fields.get(key, {}), **value} if isinstance(value, dict) else value for key, value in options.items()
    }
    return Denoiser(tokenizer_file(tmp_path), max_agents=3, window=8, **fields)


def same_weights(a: Denoiser, b: Denoiser) -> bool:
    return all(torch.equal(x, b.state_dict()[name]) for name, x in a.state_dict().items())


def test_training_leaves_the_tokenizer_bit_identical(tmp_path):
    model = build(tmp_path)
    before = {name: value.clone() for name, value in model.tokenizer.state_dict().items()}
    fitted(model, 3)
    assert all(torch.equal(value, before[name]) for name, value in model.tokenizer.state_dict().items())


def test_interrupted_training_resumes_to_the_same_weights_bit_for_bit(tmp_path):
    whole = build(tmp_path)
    fitted(whole, 7)
    first = build(tmp_path)
    # The plan is for 7 steps in both; only the interruption differs.
    run = trainer(7)
    stop = StopAfter(4)
    run.callbacks.append(stop)  # type: ignore[attr-defined]
    run.fit(first, datamodule=data())
    run.save_checkpoint(tmp_path / "four.ckpt")
    second = build(tmp_path)
    fitted(second, 7, str(tmp_path / "four.ckpt"))
    assert not same_weights(whole, first)
    assert same_weights(whole, second)


class StopAfter(L.Callback):
    def __init__(self, steps: int) -> None:
        self.steps = steps

    def on_train_batch_end(self, trainer, *args) -> None:
        trainer.should_stop = trainer.global_step >= self.steps


def test_a_checkpoint_is_all_a_user_needs(tmp_path):
    """No tokenizer file beside it: what was trained with comes along."""
    model = build(tmp_path)
    fitted(model, 2).save_checkpoint(tmp_path / "model.ckpt")
    (tmp_path / "tokenizer.ckpt").unlink()
    loaded = Denoiser.load_from_checkpoint(tmp_path / "model.ckpt", weights_only=True)
    assert same_weights(model, loaded)


def test_without_a_tokenizer_the_error_says_what_to_do(tmp_path):
    with pytest.raises(ValueError, match=r"has no tokenizer: --model\.tokenizer is 'absent\.ckpt'"):
        fitted(Denoiser("absent.ckpt", max_agents=3, window=8, **SIZES), 1)


def test_without_a_data_module_somebody_has_to_say_how_tokens_are_normalized(tmp_path):
    model, scenes = build(tmp_path), list(data().statistics_batches(2))
    loader = torch.utils.data.DataLoader(scenes, batch_size=None)
    with pytest.raises(ValueError, match=r"give Trainer\.fit a data module, or .* model\.fit_normalizer"):
        model.losses(scenes[0], torch.Generator())
    with pytest.raises(ValueError, match=r"give Trainer\.fit a data module"):
        trainer(1).fit(model, loader)
    model.fit_normalizer(*model.tokenize(scenes[0]))
    before = copy.deepcopy(model)
    trainer(1).fit(model, loader, loader)
    assert not same_weights(model, before)


def test_a_batch_can_be_tokenized_in_compiled_code(tmp_path):
    """Lightning's own `device` cannot be."""
    model, scene = build(tmp_path), next(data().statistics_batches(1))
    tokens, there = torch.compile(model.tokenize, backend="eager")(scene)
    expected, counts = model.tokenize(scene)
    torch.testing.assert_close(tokens, expected)
    assert torch.equal(there, counts)


def test_statistics_make_training_tokens_standard(tmp_path):
    model = build(tmp_path)
    fitted(model, 1)
    tokens, there = zip(*(model.tokenize(scene) for scene in data().statistics_batches()), strict=True)
    normal = model.normalizer.normalize(torch.cat(tokens))
    _, deltas, pairs = model.layout.unpack(normal)
    there = torch.cat(there)
    _, delta_std, pairwise_std = model.layout.unpack(model.normalizer.std)
    for values, std in ((deltas[there[..., 0]], delta_std), (pairs[there[..., 1:]], pairwise_std)):
        values, std = values.reshape(-1, 9), std.reshape(-1, 9)[0]
        assert values.mean(0).abs().max() < 1e-3
        floored = std <= 0.0101
        assert (values.std(0)[~floored] - 1).abs().max() < 1e-3
        assert (values.std(0)[floored] <= 1.001).all()
        assert (~floored).sum() >= 3


def test_what_a_gap_in_the_recording_says_is_learnt_by_nobody():
    """Neither the gap, nor the step out of it, which is in the first delta of the token behind."""
    model, scene = tiny_denoiser(), random_scene(2, 32, 2, torch.Generator().manual_seed(2))
    valid = torch.ones(2, 32, dtype=torch.bool)
    valid[1, 10:16] = False  # tokens 2 and 3
    behind = scene.T_world_root.clone()
    behind[1, 16:, :, 0, 3] += 5.0  # whoever was lost is found elsewhere
    plain, there = model.tokenize(scene)
    tokens, counted = model.tokenize(scene.replace(valid=valid, T_world_root=behind))
    assert counted[1, :, 0, 0].tolist() == [True, True, False, False, False, True, True, True]
    _, deltas, _ = model.layout.unpack(tokens - plain)
    assert (deltas[1].abs().amax(dim=(1, 2, 3)) > 1).tolist() == [False] * 4 + [True] + [False] * 3
    assert torch.equal(counted[0], there[0]) and counted[1, :2].equal(there[1, :2])


@pytest.mark.parametrize(
    "options", few([{}, {"noise": {"distribution": "mixture"}, "self_forcing": {"share": 1.0}}], 1), ids=str
)
def test_what_is_not_valid_is_not_shown_either(options):
    """The same losses whatever a gap holds, and frames behind the end of a clip that is shorter than the window."""
    model, generator = tiny_denoiser(**options).train(), torch.Generator().manual_seed(2)
    scene, other = (random_scene(4, 32, 3, generator) for _ in range(2))
    valid = torch.ones(4, 32, dtype=torch.bool)
    valid[:2, 10:16] = valid[2:, 20:] = False
    masked = scene.replace(valid=valid)
    spoiled = masked.with_poses(~valid[..., None], other.body_rot, 3 * other.T_world_root)
    for seed in range(4):
        plain, same = (model.losses(each, torch.Generator().manual_seed(seed)) for each in (masked, spoiled))
        assert all(torch.equal(value, same[name]) for name, value in plain.items())


def test_a_few_scenes_can_be_learnt(tmp_path):
    model = build(tmp_path, optimizer={"learning_rate": 3e-3}, network={"width": 64})
    fitted(model, 1)
    batch = next(iter(data().train_dataloader()))
    generator = torch.Generator().manual_seed(0)
    optimizer = torch.optim.AdamW(model.transformer.parameters(), lr=3e-3)
    losses = []
    for _ in range(80):
        loss = model.losses(batch, generator)["loss"]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert sum(losses[-20:]) < 0.7 * sum(losses[:20])


@pytest.mark.parametrize(
    "ablation",
    few(
        [
            {"network": {"pairwise": False}},
            {"network": {"rope": "none"}},
            {"network": {"agent_embedding": False}},
            {"noise": {"distribution": "per_timestep"}},
            {"noise": {"distribution": "per_sequence"}},
            {"noise": {"distribution": "mixture"}},
            {"noise": {"pairwise": "token"}},
            {"network": {"rope": "heads"}},
            {"network": {"causal_block": 2}},
            {"target": "continuous"},
            {"target": "continuous", "self_forcing": {"share": 1.0}, "noise": {"distribution": "mixture"}},
            {"loss": {"weighting": "min_snr"}},
        ],
        4,
    ),
    ids=str,
)
def test_every_ablation_trains_and_samples(tmp_path, ablation):
    from magnet.sampling.options import SamplerOptions
    from magnet.tasks.joint import JointFuture

    model = build(tmp_path, **ablation)
    fitted(model, 1)
    scene = random_scene(1, 16, 2, torch.Generator().manual_seed(0))
    whole = generate(model.eval(), scene, JointFuture(), 16, 8, options=SamplerOptions(steps=2))
    assert whole.T_world_root.isfinite().all()


def test_without_a_vq_vae_the_poses_themselves_are_tokens(tmp_path):
    from magnet.sampling.options import SamplerOptions
    from magnet.tasks.joint import JointFuture

    torch.manual_seed(0)
    model = Denoiser("raw", max_agents=3, window=8, **SIZES)
    assert model.layout.latent == 540
    run = fitted(model, 1)
    scene = random_scene(1, 16, 2, torch.Generator().manual_seed(0))
    whole = generate(model.eval(), scene, JointFuture(), 16, 8, options=SamplerOptions(steps=2))
    assert whole.T_world_root.isfinite().all()
    run.save_checkpoint(tmp_path / "raw.ckpt")
    assert same_weights(model, Denoiser.load_from_checkpoint(tmp_path / "raw.ckpt", weights_only=True))


def test_what_is_validated_does_not_depend_on_who_shares_a_batch(tmp_path, monkeypatch):
    """Windows at the end of a clip are filled up, and scenes are of one person or two: means weigh by what counts."""

    def losses(self: Denoiser, scene: Scene, generator: torch.Generator) -> dict[str, torch.Tensor]:
        counts = scene.present[:, None] & scene.valid[..., None]
        return {"loss": scene.T_world_root[..., 1, 3][counts].mean()}

    monkeypatch.setattr(Denoiser, "losses", losses)
    model, found = build(tmp_path), []
    for size in (1, 4, 100):
        given = FakeData(couples_and_singles("val"), window_frames=32, max_agents=3, val_batch_size=size)
        found.append(trainer(1, limit_val_batches=None).validate(model, given, verbose=False)[0]["val/loss"])
    assert found == pytest.approx([found[0]] * 3, rel=1e-5)


def validated(size: int, clips: list[Clip] | None = None, **where) -> float:
    """The loss over windows, by default of couples, in batches of `size`."""
    clips = clips or [random_clip(f"couple{i}", 100, split="val") for i in range(3)]
    given = FakeData(clips, window_frames=32, max_agents=2, val_batch_size=size)
    model = tiny_denoiser(window=8)
    return trainer(1, limit_val_batches=None, **where).validate(model, given, verbose=False)[0]["val/loss"]


def one_of_two(rank: int, port: int, folder: str) -> None:
    as_by_torchrun(rank, 2, port)
    torch.save(validated(2, devices=2, strategy="ddp"), Path(folder, f"{rank}.pt"))


def test_a_scene_is_validated_with_the_same_noise_in_any_batch():
    for clips in (None, couples_and_singles("val")):  # a batch's pairs do not weigh as its people do
        assert [validated(size, clips) for size in (2, 5, 100)] == pytest.approx([validated(1, clips)] * 3, rel=1e-5)


@pytest.mark.slow
def test_a_scene_is_validated_with_the_same_noise_in_any_process(tmp_path):
    mp.spawn(one_of_two, args=(free_port(), str(tmp_path)), nprocs=2)
    assert [torch.load(tmp_path / f"{rank}.pt") for rank in range(2)] == pytest.approx([validated(3)] * 2, rel=1e-5)


class Mine(Denoiser):
    """A class of somebody's own, with one more option and, where it is `wide`, one more weight."""

    def __init__(self, *args, extra: float = 0.5, wide: bool = False, **kwargs) -> None:
        super().__init__(*args, **kwargs)
        self.save_hyperparameters("extra", "wide")
        if wide:
            self.more = torch.nn.Parameter(torch.zeros(1))


@pytest.mark.parametrize("wide", [False, True])
def test_a_class_of_ones_own_is_loaded_with_its_options_and_as_a_plain_denoiser_not_unsaid(wide, tmp_path):
    made = Mine("raw", 2, window=8, extra=0.9, wide=wide, noise={"shift": 5.0}, **SIZES)
    path = save(made, tmp_path / "mine.ckpt")
    checkpoint = checkpoints.read(path) | {"magnet_config": {"model": {"class_path": f"{__name__}.Mine"}}}
    checkpoints.save(checkpoint, Path(path))
    own = Mine.load(path)
    assert (own.hparams["extra"], own.noise.shift, own.network.layers) == (0.9, 5.0, 1) and same_weights(own, made)
    if wide:
        with pytest.raises(ValueError, match=r"such as more; it was trained as .*\.Mine: load it with Mine\.load"):
            Denoiser.load(path)
    else:
        with pytest.warns(UserWarning, match=r"trained as .*\.Mine, and is a plain Denoiser here: .*Mine\.load\(path"):
            assert magnet.load(path).denoiser.noise.shift == 5.0
        checkpoints.save(checkpoint | {"magnet_config": {"model": {"class_path": "mine.Denoiser"}}}, Path(path))
        with pytest.warns(UserWarning, match="trained as mine.Denoiser, and is a plain Denoiser here"):
            Denoiser.load(path)


def test_absent_agents_cost_nothing(generator):
    model = tiny_denoiser()
    scene = random_scene(2, 32, 3, generator, present=torch.tensor([[True, True, False]] * 2))

    def loss(of: Scene) -> torch.Tensor:
        return model.losses(of, torch.Generator().manual_seed(0))["loss"]

    moved = scene.replace(T_world_root=scene.T_world_root.clone())
    moved.T_world_root[:, :, 2, :3, 3] += 5.0
    assert torch.equal(loss(scene), loss(moved))
    gradients = []
    for filler in (0.0, torch.nan):
        filled = scene.replace(**{name: each.clone() for name, each in scene.tensors().items()})
        for each in (filled.T_world_root[:, :, 2], filled.body_rot[:, :, 2], filled.betas[:, 2]):
            each.fill_(filler)
        weights = list(model.transformer.parameters())
        gradients.append(torch.autograd.grad(loss(filled), weights, materialize_grads=True))
    assert all(each.isfinite().all() for each in gradients[1])
    assert all(torch.equal(*each) for each in zip(*gradients, strict=True))


def test_a_model_that_could_not_be_sampled_is_not_trained(tmp_path) -> None:
    with pytest.raises(ValueError, match=r"sampling\.stride 99: is more token steps than the window of \d+ has"):
        fitted(build(tmp_path, sampling={"stride": 99}), 1)
