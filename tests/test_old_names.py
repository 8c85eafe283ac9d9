"""The released `duet1`, written before names changed, is read in the names of today."""

import json

import pytest

import magnet
from magnet import checkpoints
from magnet.denoiser.module import Denoiser
from magnet.old_names import DENOISER, TOKENIZER, renamed_checkpoint


def test_duet1_is_read_whole_in_the_names_of_today():
    stored = json.loads((checkpoints.FOLDER / "duet1" / "config.json").read_text())
    assert "relation_noise" in stored["hyper_parameters"], "written before names changed"
    checkpoint = checkpoints.read(checkpoints.resolve("duet1"))
    model = Denoiser.load("duet1")
    assert checkpoint["state_dict"].keys() == model.state_dict().keys()
    assert bool(model.normalizer.ready) and bool(model.tokenizer.quantizer.initialized)
    assert renamed_checkpoint(checkpoint) is checkpoint
    data = checkpoint["magnet_config"]["data"]["init_args"]
    for options in (data, *(part["init_args"] for part in data["data"])):
        assert options["test"]["horizon_frames"] == 150 and options["augment"]["mirror"] is True


def test_options_of_other_models_keep_their_names():
    """A class of one's own may have an option that `duet1` had."""
    options = {"width": 8, "hidden": 3, "network": {"width": 64}}
    mine = {"state_dict": {"statistics.mean": 1}, "hyper_parameters": options, "tokenizer_hyper_parameters": None}
    assert renamed_checkpoint(mine) is mine


@pytest.mark.parametrize(("names", "kind"), [(DENOISER, "Denoiser"), (TOKENIZER, "Tokenizer")])
def test_every_new_option_is_one_of_the_models(names: dict[str, str], kind: str):
    made = getattr(magnet, kind)()
    for new in names.values():
        group, _, name = new.partition(".")
        assert name in made.hparams[group], new
