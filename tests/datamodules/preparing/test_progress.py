"""Where no terminal shows a bar, a line says now and then how far work is."""

from __future__ import annotations

from pathlib import Path

import pytest

from magnet import cli
from magnet.datamodules.preparing import progress


def test_a_line_says_what_is_done_and_the_seconds_left(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    said = progress.Lines(15.0)
    said.tell("walk1", 0, 200)
    now = 15.0
    assert said.line() == "0 % done after 15 s; walk1"
    now = 20.0
    said.tell("walk1", 50, 200)
    now = 30.0
    assert said.line() == "25 % done, about 50 s left; walk1"
    now = 81.0  # the next take is slower than those before
    assert said.line() == "25 % done, little left; walk1"
    said.tell("next", 10, 40)  # another file, of which a part was there
    now = 91.0
    assert said.line() == "25 % done after 10 s; next"
    said.tell("next", 30, None)
    assert said.line() == "at work for 0 s; next"


@pytest.mark.parametrize("command", [["prepare", "bvh", "--root", "dl", "store"], ["check", "dl", "--picture", "none"]])
def test_commands_say_how_far_they_are_where_no_terminal_is(
    command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(progress, "SECONDS", 0.02)
    assert cli.main(["data", "fake", "bvh", "dl", "--takes", "4", "--frames", "90"]) == 0
    assert cli.main(["data", *command, "--workers", "1"]) == 0
    said = capsys.readouterr()
    assert any(" % done" in line for line in said.err.splitlines()) and " % done" not in said.out


def test_work_that_is_over_says_nothing_more(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "SECONDS", 0.001)
    with pytest.raises(KeyboardInterrupt), progress.progress_bar():
        progress.time.sleep(0.01)  # nothing is told yet, and so nothing said
        raise KeyboardInterrupt
    assert capsys.readouterr().err == ""
