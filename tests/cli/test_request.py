"""Which checkpoint a command starts from, and whether it can do the task."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch

from magnet import cli
from magnet.cli.arguments import Arguments
from magnet.cli.errors import CommandError
from magnet.cli.request import which_checkpoint
from magnet.testing import tiny_tokenizer
from magnet.testing.models import TINY_TOKENIZER


def finished(runs: Path, name: str) -> Path:
    path = runs / name / "checkpoints" / "last.ckpt"
    path.parent.mkdir(parents=True)
    path.touch()
    return path


def older(path: Path) -> Path:
    os.utime(path, (0, 0))
    return path


def test_a_fit_goes_on_with_its_own_last_run_and_a_test_takes_anybodys(tmp_path: Path) -> None:
    ours, newer = older(finished(tmp_path, "mine/a")), finished(tmp_path, "other/b")
    last = Arguments.split(["--ckpt_path", "last"])
    assert which_checkpoint("fit", last, tmp_path, "mine") == ours
    assert which_checkpoint("test", last, tmp_path, "mine") == newer
    there = Arguments.split(["--ckpt_path", "last", "--out", str(tmp_path / "other")])
    assert which_checkpoint("fit", there, tmp_path, "mine") == newer
    with pytest.raises(CommandError, match=r"no run with a checkpoints/last\.ckpt in .*third"):
        which_checkpoint("fit", last, tmp_path, "third")


def test_a_job_that_slurm_starts_again_goes_on_with_the_newest_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that was put off for another, or whose node failed, has none that Lightning leaves when time is up."""
    given, run = Arguments.split(["--out", str(tmp_path / "run")]), tmp_path / "run"
    monkeypatch.setenv("SLURM_RESTART_COUNT", "1")
    assert which_checkpoint("fit", given, tmp_path, "run") is None
    last = finished(tmp_path, "run")
    assert which_checkpoint("fit", given, tmp_path, "run") == last
    (left := run / "hpc_ckpt_1.ckpt").touch()
    older(last)
    assert which_checkpoint("fit", given, tmp_path, "run") == left
    older(left)
    last.touch()
    assert which_checkpoint("fit", given, tmp_path, "run") == last
    monkeypatch.delenv("SLURM_RESTART_COUNT")
    assert which_checkpoint("fit", given, tmp_path, "run") is None


def test_where_no_run_has_the_checkpoint_those_that_are_there_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    runs, last = Path("runs"), Arguments.split(["--ckpt_path", "last"])

    def told(command: str, given: Arguments) -> str:
        with pytest.raises(CommandError) as error:
            which_checkpoint(command, given, runs, command)
        return str(error.value)

    none = "--ckpt_path last: no run with a checkpoints/last.ckpt in"
    assert told("test", last) == f"{none} runs or runs/test; name a file"
    old, new = older(finished(runs, "finetune/a")), finished(runs, "finetune/b")
    assert told("fit", last) == f"{none} runs/fit; name a file; the newest are {new}, {old}"
    (best := finished(Path(), "mine").with_name("best.ckpt")).with_name("last.ckpt").rename(best)
    mine = Arguments.split(["--ckpt_path", "last", "--out", "mine"])
    assert told("fit", mine) == f"{none} mine; name a file; the newest is mine/checkpoints/best.ckpt"


@pytest.fixture
def codes(toy: Path) -> Path:
    """A tokenizer's checkpoint in the working folder."""
    kept = {"class_path": "magnet.tokenizer.module.Tokenizer", "init_args": TINY_TOKENIZER}
    torch.save({"state_dict": tiny_tokenizer().state_dict(), "magnet_config": {"model": kept}}, toy / "codes.ckpt")
    return Path("codes.ckpt")


@pytest.mark.parametrize("words", ["test --task joint_future", "predict --task=joint_future"])
def test_a_task_of_a_tokenizer_is_refused_in_a_line(
    words: str, toy: Path, codes: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([*words.split(), "--ckpt_path", str(codes), "--out", "out", "--trainer.accelerator", "cpu"]) == 2
    told = capsys.readouterr().err.splitlines()[-1]
    assert told == (
        f"magnet {words.split()[0]}: error: --task joint_future: codes.ckpt holds a tokenizer, and tasks need a "
        "denoiser: name one with --ckpt_path, or leave --task out"
    )
    assert not (toy / "out").exists()


@pytest.mark.parametrize(
    "words",
    ["--samples 3", "--sampler.steps=2", "--sampler paper", "--baselines false", "--interval take", "--seed 3"],
)
@pytest.mark.parametrize("command", ["test", "predict"])
def test_options_of_sampling_of_a_tokenizer_are_refused_in_a_line(
    command: str, words: str, toy: Path, codes: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cpu = ("--trainer.accelerator", "cpu", "--out", "out")
    assert cli.main([command, *words.split(), "--ckpt_path", str(codes), *cpu]) == 2
    option = words.replace("=", " ").split()[0]
    assert capsys.readouterr().err.splitlines()[-1] == (
        f"magnet {command}: error: {option}: codes.ckpt holds a tokenizer, which samples nothing and has no use for "
        f"it: name a denoiser with --ckpt_path, or leave {option} out"
    )
    assert not (toy / "out").exists()


def test_a_task_of_a_file_does_not_hinder_the_test_of_a_model_without_tasks(toy: Path) -> None:
    """The configuration of every run of `magnet test` has one."""
    cpu = ("--trainer.accelerator", "cpu", "--trainer.enable_progress_bar", "false")
    fit = ("--model", "ToyModel", "--data", "ToyData", "--trainer.max_steps", "1")
    assert cli.main(["fit", *fit, "--out", "trained", *cpu]) == 0
    (toy / "again.yaml").write_text("task: {name: joint_future}\n")
    assert cli.main(["test", "--config", "again.yaml", "--ckpt_path", "trained", "--out", "out", *cpu]) == 0
