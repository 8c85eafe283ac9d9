"""A file of another kind than was asked for is named by what it holds, and a run's folder stands for its best one."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

import magnet
from magnet import checkpoints, cli
from magnet.cli import request
from magnet.cli.arguments import Arguments
from magnet.denoiser.module import Denoiser
from magnet.testing import tiny_denoiser
from magnet.tokenizer.module import Tokenizer


@pytest.fixture
def tokenizer(tmp_path: Path) -> Path:
    made, path = tiny_denoiser().tokenizer, tmp_path / "run" / "checkpoints" / "last.ckpt"
    checkpoints.save({"state_dict": made.state_dict(), "hyper_parameters": dict(made.hparams)}, path)
    return path


@pytest.fixture
def denoiser(tmp_path: Path) -> Path:
    made, path = tiny_denoiser(), tmp_path / "other" / "checkpoints" / "best.ckpt"
    checkpoint = {"state_dict": made.state_dict(), "hyper_parameters": dict(made.hparams)}
    made.on_save_checkpoint(checkpoint)
    checkpoints.save(checkpoint, path)
    return path


def test_a_tokenizer_where_a_denoiser_is_asked_for(
    tokenizer: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    held = "not a denoiser's checkpoint, it holds a tokenizer"
    with pytest.raises(ValueError, match=f"last.ckpt: {held}"):
        magnet.load(tokenizer)
    assert cli.main(["fit", "--model", "Denoiser", "--model.start_from", str(tokenizer)]) == 2
    error = capsys.readouterr().err
    assert held in error and "given with --model.tokenizer" in error and len(error.splitlines()) == 1


def test_a_denoiser_where_a_tokenizer_is_trained_on(denoiser: Path) -> None:
    checkpoint = checkpoints.read(denoiser)
    with pytest.raises(ValueError, match=r"it holds a denoiser; --model\.start_from"):
        Tokenizer().on_load_checkpoint(checkpoint)
    assert isinstance(Tokenizer.load(denoiser), torch.nn.Module)


def test_a_bare_state_dict_is_called_one(tmp_path: Path, tokenizer: Path) -> None:
    path = tmp_path / "weights.pt"
    torch.save(checkpoints.read(tokenizer)["state_dict"], path)
    for load in (magnet.load, Tokenizer.load):
        with pytest.raises(ValueError, match=r"weights\.pt: not .*, it holds a bare state_dict.*`magnet fit") as error:
            load(path)
        assert "\n" not in str(error.value)


def test_a_runs_folder_stands_for_its_best_checkpoint_and_else_the_last(tokenizer: Path, denoiser: Path) -> None:
    assert isinstance(magnet.load(denoiser.parents[1]).denoiser, torch.nn.Module)
    assert isinstance(Tokenizer.load(tokenizer.parents[1]), torch.nn.Module)
    assert checkpoints.resolve(str(denoiser.parents[1])) == denoiser
    with pytest.raises(ValueError, match=r"give one of its files, such as best\.ckpt"):
        magnet.load(denoiser.parent)
    with pytest.raises(ValueError, match="there is no checkpoint in it"):
        (denoiser.parent / "empty").mkdir()
        Denoiser.load(denoiser.parent / "empty")


def test_a_training_goes_on_from_the_end_of_a_runs_folder(denoiser: Path) -> None:
    last = denoiser.with_name("last.ckpt")
    last.write_bytes(denoiser.read_bytes())
    folder = str(denoiser.parents[1])
    for command, file in (("fit", last), ("test", denoiser)):
        given = Arguments.split(["--ckpt_path", folder])
        assert request.which_checkpoint(command, given, Path("runs"), command) == file
