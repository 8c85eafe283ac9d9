"""Training that starts from another denoiser, by path or by a shipped model's name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from magnet import checkpoints, cli
from magnet.denoiser.module import Denoiser
from magnet.denoiser.starting import tokenizer_of
from magnet.denoiser.statistics import pairwise_ground
from magnet.testing import random_scene, tiny_denoiser
from magnet.tokenizer.checkpoint import shaping
from magnet.tokenizer.module import RawPose, Tokenizer


def saved(model: Denoiser, path: Path) -> Path:
    checkpoint = {"state_dict": model.state_dict(), "hyper_parameters": dict(model.hparams)}
    model.on_save_checkpoint(checkpoint)
    torch.save(checkpoint, path)
    return path


def equal(a: torch.nn.Module, b: torch.nn.Module) -> bool:
    mine, theirs = a.state_dict(), b.state_dict()
    return mine.keys() == theirs.keys() and all(torch.equal(mine[name], theirs[name]) for name in mine)


def test_without_a_tokenizer_that_of_the_start_is_kept_and_how_tokens_are_normalised(tmp_path: Path) -> None:
    first = tiny_denoiser(seed=1)
    path = saved(first, tmp_path / "first.ckpt")
    sizes = {name: first.hparams[name] for name in ("max_agents", "window", "network")}
    second = Denoiser(start_from=str(path), **sizes)
    assert equal(second.tokenizer, first.tokenizer) and not second.normalizer.ready
    assert not any(weight.requires_grad for weight in second.tokenizer.parameters())
    second.take_over(path)
    assert equal(second.transformer, first.transformer) and equal(second.normalizer, first.normalizer)


@pytest.mark.parametrize("has", [True, False])
def test_a_posterior_is_taken_over_where_there_is_one(tmp_path: Path, has: bool) -> None:
    first = tiny_denoiser(network={"pairwise_posterior": has})
    with torch.no_grad():
        for weight in first.posterior.parameters() if has else ():
            weight += 0.1
    path = saved(first, tmp_path / "first.ckpt")
    second = tiny_denoiser(network={"pairwise_posterior": True})
    fresh = {name: value.clone() for name, value in second.posterior.state_dict().items()}
    second.take_over(path)
    expected = first.posterior.state_dict() if has else fresh
    assert fresh and all(torch.equal(value, expected[name]) for name, value in second.posterior.state_dict().items())
    assert has != all(torch.equal(value, fresh[name]) for name, value in second.posterior.state_dict().items())


def test_with_another_tokenizer_tokens_are_normalised_anew(tmp_path: Path) -> None:
    path = saved(tiny_denoiser(seed=1), tmp_path / "first.ckpt")
    second = tiny_denoiser(seed=2)
    before = second.normalizer.mean.clone()
    second.take_over(path)
    assert torch.equal(second.normalizer.mean, before)


def answered(model: Denoiser) -> torch.Tensor:
    """What a model makes of the same motion, in metres."""
    generator = torch.Generator().manual_seed(3)
    scene = random_scene(2, 32, 3, generator)
    tokens, levels = model.tokenize(scene)[0], torch.randint(0, 1001, (2, 8, 3), generator=generator)
    with torch.no_grad():
        made = model.denoise(model.normalizer.normalize(tokens), levels, scene.present)
    return model.normalizer.denormalize(made)


def test_with_another_scale_of_pairs_or_a_condition_it_begins_as_the_same_model(tmp_path: Path) -> None:
    first = tiny_denoiser(seed=1)
    with torch.no_grad():
        for weight in first.transformer.parameters():  # biases and norms too
            weight.normal_(std=0.1)
    path = saved(first, tmp_path / "first.ckpt")
    for other in ({"noise": {"pairwise_metres": 0.5}}, {"network": {"cond_dim": 4}}, {}):
        second = tiny_denoiser(seed=1, **other)
        second.take_over(path)
        torch.testing.assert_close(answered(second), answered(first), rtol=1e-4, atol=1e-4)
        ground = pairwise_ground(first.layout)
        expected = torch.where(ground, 0.5, first.normalizer.std) if "noise" in other else first.normalizer.std
        assert torch.equal(second.normalizer.std, expected)


def test_a_denoiser_of_raw_poses_is_started_from_as_well(tmp_path: Path) -> None:
    first = tiny_denoiser()
    first.build(RawPose())
    next(first.tokenizer.buffers()).fill_(0.5)
    found = tokenizer_of(saved(first, tmp_path / "raw.ckpt"))
    assert isinstance(found, RawPose) and equal(found, first.tokenizer)


def test_a_tokenizers_checkpoint_is_no_start(tmp_path: Path) -> None:
    tokenizer = tiny_denoiser().tokenizer
    torch.save({"state_dict": tokenizer.state_dict(), "hyper_parameters": dict(tokenizer.hparams)}, tmp_path / "t.ckpt")
    with pytest.raises(
        ValueError, match=r"t\.ckpt: not a denoiser's checkpoint, it holds a tokenizer; .*--model\.tokenizer"
    ):
        tokenizer_of(tmp_path / "t.ckpt")


@pytest.mark.parametrize("name", checkpoints.names())
def test_a_shipped_models_tokenizer_is_known_by_its_name(name: str) -> None:
    shipped = Denoiser.load(name)
    assert equal(Tokenizer.load(name), shipped.tokenizer) and equal(tokenizer_of(name), shipped.tokenizer)
    assert equal(Denoiser(tokenizer=name).tokenizer, shipped.tokenizer)


# -- on the command line -----------------------------------------------------------------------


def printed(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    assert cli.main(["fit", *words, "--print_config"]) == 0
    return yaml.safe_load(capsys.readouterr().out)


@pytest.mark.parametrize("name", checkpoints.names())
def test_a_start_brings_its_sizes_and_losses_and_the_user_says_otherwise(name: str, capsys) -> None:
    stored = checkpoints.read(checkpoints.resolve(name))["hyper_parameters"]
    got = printed(capsys, "--model.start_from", name, "--model.network.dropout", "0.3")
    model, data = got["model"]["init_args"], got["data"]["init_args"]
    for group in ("network", "noise", "loss", "self_forcing"):
        taken = {key: value for key, value in stored[group].items() if key != "dropout"}
        assert taken and taken == {key: model[group][key] for key in taken}, group
    assert (model["start_from"], model["tokenizer"], model["network"]["dropout"]) == (name, None, 0.3)
    assert model["optimizer"]["learning_rate"] == 2e-4, "how fast it learns is no part of what is taken over"
    assert (data["max_agents"], data["window_frames"]) == (stored["max_agents"], 4 * stored["window"])


@pytest.mark.parametrize("name", checkpoints.names())
def test_a_tokenizer_starts_from_that_inside_a_shipped_model(name: str, capsys) -> None:
    stored = checkpoints.read(checkpoints.resolve(name))["tokenizer_hyper_parameters"]
    model = printed(capsys, "--model", "Tokenizer", "--model.start_from", name)["model"]["init_args"]
    assert shaping(stored) and shaping(stored).items() <= shaping(model).items()
    assert (model["start_from"], model["decoder_only"]) == (name, False)


def test_the_configuration_for_fine_tuning_starts_from_the_shipped_model(capsys) -> None:
    config = Path(__file__).parents[2] / "configs/finetune.yaml"
    got = printed(capsys, "--config", str(config), "--data.path", "store")
    assert got["data"]["class_path"].endswith(".Prepared") and got["data"]["init_args"]["max_agents"] == 4
    assert got["model"]["init_args"]["network"]["width"] == Denoiser.load("duet").network.width


def test_a_start_that_is_not_there_is_said_before_anything_is_made(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["fit", "--model", "Denoiser", "--model.start_from", "duett"]) == 2
    assert "--model.start_from duett: no checkpoint duett" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_training_goes_on_from_the_start_with_its_tokenizer_untouched(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    first = tiny_denoiser(max_agents=2, window=4)
    saved(first, tmp_path / "first.ckpt")
    data = ("--data.train_clips", "2", "--data.val_clips", "1", "--data.people", "[2]", "--data.batch_size", "2")
    few = ("--data.epoch_size", "2", "--trainer.max_steps", "1", "--trainer.limit_val_batches", "0")
    rest = (
        "--model.optimizer.learning_rate",
        "0.0",
        "--model.optimizer.weight_decay",
        "0.0",
        "--out",
        "run",
        "--trainer.accelerator",
        "cpu",
    )
    assert cli.main(["fit", "--model.start_from", "first.ckpt", *data, *few, *rest]) == 0
    second = Denoiser.load("run/checkpoints/last.ckpt")
    for part in ("tokenizer", "normalizer", "transformer"):
        assert equal(getattr(second, part), getattr(first, part)), part
    (tmp_path / "first.ckpt").unlink()  # a checkpoint is all that is needed later
    assert equal(Denoiser.load("run/checkpoints/last.ckpt").tokenizer, first.tokenizer)
