"""`magnet report` in a folder where another one works, and in one that cannot be written to."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import pytest

from magnet import cli
from magnet.cli import folder_lock
from magnet.files import alone
from magnet.report import measure

REPORT = ["report", "3", "--shipped", "--budget", "tiny", "--out", "out"]


def test_a_second_report_in_a_folder_is_refused_while_the_first_one_works(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two that begin the same training would each remove the other's folder."""
    monkeypatch.chdir(tmp_path)
    Path("out").mkdir()
    with alone(Path("out") / folder_lock.LOCK, "taken"):
        assert cli.main(REPORT) == 2
        assert "another report is working in out; wait for it, or choose another --out" in capsys.readouterr().err
        assert cli.main([*REPORT, "--page_only"]) == 0


def test_a_report_ends_where_the_disk_is_full_and_does_not_measure_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    measured = []

    def run(cell: Any, *_: Any) -> dict[str, Any]:
        measured.append(cell)
        return {"rows": {}}

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(measure, "run", run)
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        assert cli.main(REPORT) == 2
    assert "the disk is full" in capsys.readouterr().err
    assert len(measured) == 1 and not list(tmp_path.rglob("*.json"))
    assert not (tmp_path / "out" / folder_lock.LOCK).exists()


def test_a_report_says_before_it_measures_that_nothing_can_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(measure, "run", lambda *_: pytest.fail("measured"))
    Path("out").touch()
    assert cli.main(REPORT) == 2
    assert "is a file, expected a folder" in capsys.readouterr().err
