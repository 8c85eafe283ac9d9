"""Checkpoints and configurations of earlier versions are read as this version would have written them."""

import json

import pytest
import torch
import yaml

from magnet import checkpoints
from magnet.cli.arguments import Arguments
from magnet.cli.config_files import read_layers
from magnet.denoiser.module import Denoiser
from magnet.old_names import (
    OPTIONS,
    STATE,
    renamed_checkpoint,
    renamed_config,
    renamed_flags,
    renamed_options,
    renamed_state,
)

OLD = """
model:
  class_path: Denoiser
  init_args:
    target: quantised
    relation_noise: token
    relation_weight: 2.0
trainer:
  callbacks:
    - class_path: magnet.denoiser.averaging.WeightEMA
      init_args:
        decay: 0.9
"""


def test_the_shipped_weights_load_whole_although_they_have_the_old_names():
    stored = json.loads((checkpoints.FOLDER / "duet1" / "config.json").read_text())
    assert "relation_noise" in stored["hyper_parameters"], "written before names changed"
    checkpoint = checkpoints.read(checkpoints.resolve("duet1"))
    model = Denoiser.load("duet1")
    assert checkpoint["state_dict"].keys() == model.state_dict().keys()
    assert bool(model.normalizer.ready) and bool(model.tokenizer.quantizer.initialized)


def test_a_checkpoint_is_renamed_once_and_not_changed_in_place():
    old = {
        "state_dict": {"statistics.count": torch.tensor(7), "transformer.leave.bias": torch.ones(2)},
        "current_model_state": {"tokenizer.codebook.started": torch.tensor(True)},
        "hyper_parameters": {"relations": False, "width": 8},
        "tokenizer_hyper_parameters": {"std_floor": 0.01},
    }
    new = renamed_checkpoint(old)
    assert new["state_dict"].keys() == {"normalizer.ready", "transformer.out_proj.bias"}
    assert new["state_dict"]["normalizer.ready"].dtype == torch.bool and bool(new["state_dict"]["normalizer.ready"])
    assert new["current_model_state"].keys() == {"tokenizer.quantizer.initialized"}
    assert "statistics.count" in old["state_dict"] and "relations" in old["hyper_parameters"]
    again = renamed_checkpoint(new)
    assert again["state_dict"].keys() == new["state_dict"].keys()
    assert again["hyper_parameters"] == new["hyper_parameters"]


def test_an_old_file_is_read_and_told_about_in_one_line(tmp_path, capsys):
    (tmp_path / "old.yaml").write_text(OLD)
    (layer,) = read_layers(str(tmp_path / "old.yaml"))
    assert layer.options == renamed_config(yaml.safe_load(OLD))[0] != yaml.safe_load(OLD)
    assert layer.options["trainer"]["callbacks"][0]["class_path"] == "magnet.training.ema.WeightEMA"
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1 and "old.yaml" in said[0] and "model.relation_noise is now model.noise.pairwise" in said[0]


@pytest.mark.parametrize("kind", sorted(OPTIONS))
def test_no_new_name_is_an_old_one(kind):
    for old, new in OPTIONS[kind].items():
        assert new is None or new not in OPTIONS[kind], f"{old} would be renamed twice"
        *groups, name = old.split(".")
        said = {name: 1}
        for group in groups:
            said = {group: said}
        once, changed = renamed_options(kind, said)
        assert changed == {old: new}
        assert renamed_options(kind, once) == (once, {})


def test_what_is_said_under_the_new_name_beats_the_old_one():
    said = {"relations": True, "network": {"pairwise": False}}
    assert renamed_options("Denoiser", said)[0] == {"network": {"pairwise": False}}


def test_weights_of_no_old_name_stay():
    state = {"transformer.blocks.0.qkv.weight": torch.ones(1), "step": torch.ones(1)}
    assert renamed_state(state) == state and STATE


def test_old_flags_become_new_ones():
    flags = ["--model.width", "8", "--model.init_args.level_shift=3", "--model.std_floor", "0.1", "--data.width", "8"]
    new, changed = renamed_flags(flags)
    assert new == ["--model.network.width", "8", "--model.noise.shift=3", "--data.width", "8"]
    assert changed["--model.width"] == "--model.network.width" and changed["--model.std_floor"] is None


@pytest.mark.parametrize(
    ("model", "now"),
    [
        (["--model", "mine.Net"], "--model.width"),
        (["--model.class_path=mine.Net"], "--model.width"),
        (["--config", "net.yaml"], "--model.width"),
        (["--model", "magnet.tokenizer.module.Tokenizer"], "--model.width"),
        (["--model", "Denoiser"], "--model.network.width"),
        ([], "--model.network.width"),
    ],
    ids=lambda words: " ".join(words) if isinstance(words, list) else words,
)
def test_a_flag_is_renamed_only_for_the_model_that_had_the_option(model, now, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "net.yaml").write_text("model: mine.Net\n")
    given = Arguments.split([*model, "--model.width=64"])
    assert given.flags[-1] == f"{now}=64"


@pytest.mark.parametrize("kind", ["Denoiser", "Tokenizer"])
def test_every_new_option_is_one_of_the_models(kind):
    import magnet

    made = getattr(magnet, kind)()
    for new in filter(None, OPTIONS[kind].values()):
        group, _, name = new.partition(".")
        assert not name or name in made.hparams[group], new
