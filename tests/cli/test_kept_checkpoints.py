"""Which checkpoint `last` or `best` is, told by each command that is asked for one of them."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from magnet import cli
from magnet.cli import score
from magnet.denoiser.core import DenoiserCore
from magnet.evaluation.benchmark import Benchmark
from magnet.testing import random_scene


class Loaded(Exception):
    """In place of loading a model."""


def score_example(*words: str) -> None:
    """`magnet score --example`, without its recordings."""
    given = score.parser().parse_args(["--example", "out.npz", *words])
    score.example(given, Benchmark.read(), None)  # type: ignore[arg-type]


COMMANDS = {
    "score": (score_example, "--method"),
    "predict": (lambda *words: cli.main(["predict", "a.npz", "--out", "b.npz", *words]), "--ckpt_path"),
    "view --live": (lambda *words: cli.main(["view", "--live", "--port", "0", *words]), "--ckpt_path"),
    "view --record": (
        lambda *words: cli.main(["view", "a.npz", "--record", "b.npz", "--context", "8", "--port", "0", *words]),
        "--ckpt_path",
    ),
}


@pytest.mark.parametrize("name", ["last", "best"])
@pytest.mark.parametrize("command", COMMANDS)
def test_the_checkpoint_that_is_meant_is_told_before_it_is_loaded(
    command: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if command.startswith("view"):
        pytest.importorskip("viser")
    monkeypatch.chdir(tmp_path)
    random_scene(1, 16, 2, torch.Generator().manual_seed(0)).save("a.npz")
    meant = Path("runs/mine/a/checkpoints", f"{name}.ckpt")
    meant.parent.mkdir(parents=True)
    meant.touch()
    asked: list[Path] = []

    def load(path: Path) -> None:
        asked.append(path)
        raise Loaded

    monkeypatch.setattr(DenoiserCore, "load", load)
    call, option = COMMANDS[command]
    with pytest.raises(Loaded):
        call(option, name)
    assert capsys.readouterr().err.count(f"magnet: {option} {name} is {meant}\n") == len(asked) == 1
    with pytest.raises(Loaded):
        call(option, str(meant))
    assert "magnet: " not in capsys.readouterr().err and asked == [meant, meant], "a file is itself"


def test_where_there_is_none_the_option_that_asked_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(
        cli.errors.CommandError, match=r"^--method last: no run with a checkpoints/last\.ckpt in runs; name"
    ):
        score_example("--method", "last")
