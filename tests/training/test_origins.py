"""Where weights come from: recorded as a training begins, and carried by its checkpoints."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from magnet import checkpoints, cli
from magnet.denoiser.module import Denoiser
from magnet.testing import tiny_denoiser, tiny_tokenizer
from magnet.tokenizer.module import Tokenizer
from magnet.training import origins
from tests.denoiser.test_module import build, fitted, save

FLAGS = ("--data.people=[2]", "--data.train_clips=4", "--data.val_clips=1", "--data.batch_size=2")
FLAGS += ("--data.epoch_size=2", "--trainer.accelerator=cpu", "--trainer.enable_progress_bar=false")
FLAGS += ("--trainer.limit_val_batches=0",)


def origin(path: Path) -> dict:
    return checkpoints.read(path)[origins.KEY]


@pytest.fixture
def first(tmp_path: Path) -> Path:
    """A denoiser that started from a tokenizer."""
    model = tiny_denoiser(max_agents=3, window=16)
    model.origin = {origins.STARTED: [{"name": "narrow.ckpt", "sha256": "a"}], "data": [{"class_path": "Mine"}]}
    return Path(save(model, tmp_path / "first.ckpt"))


def test_the_command_records_what_a_training_started_from_and_all_data_that_it_saw(
    first: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["fit", "--model", "Denoiser", "--data", "Synthetic", *FLAGS, "--out", "run"]
    assert cli.main([*words, "--model.start_from", str(first), "--trainer.max_steps", "1"]) == 0
    said = origin(last := Path("run/checkpoints/last.ckpt"))
    source, behind = said[origins.STARTED]
    assert source == {"name": "first.ckpt", "sha256": checkpoints.file_hash(first), "data": [{"class_path": "Mine"}]}
    assert behind == {"name": "narrow.ckpt", "sha256": "a"} and said["body"] == "open-1"
    assert [each["class_path"].rpartition(".")[2] for each in said["data"]] == ["Synthetic"]
    first.unlink()  # what was recorded stays
    go_on = ["--ckpt_path", str(last), "--data.couplings", "[mirror]", "--trainer.max_steps", "2"]
    assert cli.main([*words, *go_on]) == 0
    again = origin(last)
    assert again[origins.STARTED] == said[origins.STARTED] and again["data"][:1] == said["data"]
    assert [each["init_args"]["couplings"] for each in again["data"][1:]] == [["mirror"]]


def test_a_trainer_alone_records_it_too(tmp_path: Path) -> None:
    model = build(tmp_path)
    fitted(model, 1).save_checkpoint(tmp_path / "one.ckpt")
    (source,) = origin(tmp_path / "one.ckpt")[origins.STARTED]
    assert (source["name"], source["sha256"]) == (
        "tokenizer.ckpt",
        checkpoints.file_hash(tmp_path / "tokenizer.ckpt"),
    )
    loaded = Denoiser.load(tmp_path / "one.ckpt")  # and then trained
    assert [each["name"] for each in loaded.origin[origins.STARTED]] == ["one.ckpt", "tokenizer.ckpt"]
    alone = Tokenizer.load(tmp_path / "one.ckpt")
    assert [each["name"] for each in alone.origin[origins.STARTED]] == ["one.ckpt", "tokenizer.ckpt"]


def test_a_tokenizer_records_what_it_started_from(tmp_path: Path) -> None:
    save(tiny_tokenizer(), tmp_path / "t.ckpt")
    fields = {name: tiny_tokenizer().hparams[name] for name in ("network", "quantizer")}
    for start, names in ((None, []), (str(tmp_path / "t.ckpt"), ["t.ckpt"])):
        model = Tokenizer(**fields, start_from=start)
        fitted(model, 1).save_checkpoint(tmp_path / "made.ckpt")
        said = origin(tmp_path / "made.ckpt")
        assert [each["name"] for each in said[origins.STARTED]] == names and said["body"] == "open-1"
        again = Tokenizer(**fields)  # which goes on, and did not start anew
        fitted(again, 2, str(tmp_path / "made.ckpt")).save_checkpoint(tmp_path / "again.ckpt")
        assert origin(tmp_path / "again.ckpt") == said


def test_a_checkpoint_that_records_nothing_goes_on_without_saying_more_than_is_known(tmp_path: Path) -> None:
    fitted(build(tmp_path), 1).save_checkpoint(tmp_path / "one.ckpt")
    old = checkpoints.read(tmp_path / "one.ckpt")
    del old[origins.KEY]
    checkpoints.save(old, tmp_path / "old.ckpt")
    fitted(build(tmp_path), 2, str(tmp_path / "old.ckpt")).save_checkpoint(tmp_path / "two.ckpt")
    assert origins.KEY not in checkpoints.read(tmp_path / "two.ckpt")
    assert origins.started_from(checkpoints.read(tmp_path / "two.ckpt")) == [{"name": "tokenizer.ckpt"}]


def test_a_released_model_passes_on_what_it_says_of_itself(first: Path, tmp_path: Path) -> None:
    said = {"trained on": "duets", "licence": "CC0", "acknowledgement": "Thanks."}
    about = {**said, origins.STARTED: [{"name": "a"}, "of another form", {}]}
    folder = checkpoints.write(checkpoints.read(first), tmp_path / "mine", about)
    own, behind = origins.sources(folder)
    digest = json.loads((folder / "config.json").read_text())["sha256"]
    assert own == {
        "name": "mine",
        "sha256": digest,
        "trained on": "duets",
        "licence": "CC0",
        "acknowledgement": "Thanks.",
    }
    assert behind == {"name": "a"}
    assert origins.begun(folder, "raw", None, folder)[origins.STARTED] == [own, behind]  # each once
    assert origins.sources("no_such_file.ckpt") == [{"name": "no_such_file.ckpt"}]


def test_a_model_of_a_hub_keeps_its_name_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoints, "from_hub", lambda name: checkpoints.FOLDER / "duet")
    name = "hub:somebody/model@v1"
    assert origins.sources(name)[0] == {**origins.sources("duet")[0], "name": name}
