"""Which checkpoint a command starts from."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from magnet.cli.checkpoint_config import Arguments
from magnet.cli.errors import CommandError
from magnet.cli.request import which_checkpoint


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
