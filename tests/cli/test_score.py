"""`magnet score`: what it says where it cannot score."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from magnet import cli


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "nothing to score: name files"),
        (("none.npz",), "none.npz: no such file"),
        (("--inputs", "in.npz", "--task", "dance"), "task: got 'dance', expected one of joint_future"),
        (("a.npz",), "a.npz: lacks benchmark, task, method, fps, scenes; it has joints"),
        (("--inputs", "in.npz", "--root", "nowhere"), "nowhere: no such folder"),
    ],
)
def test_what_cannot_be_scored_is_said_in_a_line(
    words: tuple[str, ...], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    np.savez("a.npz", joints=np.zeros(3))
    assert cli.main(("score", *words)) == 2
    error = capsys.readouterr().err
    assert said in error
    assert "Traceback" not in error
