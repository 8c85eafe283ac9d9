"""A command whose output nobody reads ends quietly, and what it was to write is there."""

from __future__ import annotations

import io
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from magnet.cli import run_progress
from magnet.cli.pipes import CLOSED, output_closed, take_any_letter

ROOT = Path(__file__).parents[2]
SHOWS = """
import importlib, sys
from pathlib import Path
from magnet.cli import outputs
from magnet.evaluation.results import Results
main = importlib.import_module("magnet.cli.main")
main.run = lambda *words: outputs.show_results(Results({"mine": {"fd": 1.0}}), Path("out"), {}) or 0
sys.exit(main.main(["score"]))
"""
LOST = """
import importlib, sys
main = importlib.import_module("magnet.cli.main")
def run(*words):
    raise BrokenPipeError(32, "Broken pipe")
main.run = run
sys.exit(main.main(["agent"]))
"""


def unread(folder: Path, *words: str, both: bool = False) -> tuple[int, str]:
    """Run Python with a stdout, or both outputs, that nobody reads. Returns the exit code and stderr."""
    reads, writes = os.pipe()
    os.close(reads)
    streams = {"stdout": writes, "stderr": writes if both else subprocess.PIPE}
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, *words], cwd=folder, env=environment, text=True, timeout=120, **streams)
    os.close(writes)
    return done.returncode, done.stderr or ""


@pytest.mark.parametrize("words", [("--help",), ("--version",), ("tasks",), ("score", "--help")])
def test_a_closed_pipe_ends_a_command_quietly(words: tuple[str, ...], tmp_path: Path) -> None:
    code, said = unread(tmp_path, "-m", "magnet", *words)
    assert said == ""
    assert code in (CLOSED, 0) if "score" in words else code == CLOSED  # argparse drops help that it cannot write


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
@pytest.mark.parametrize("words", [("--version",), ("tasks",)])
def test_an_output_onto_a_full_disk_is_told_in_a_line(words: tuple[str, ...], tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "magnet", *words]
        options = {"cwd": tmp_path, "env": environment, "text": True, "timeout": 120, "check": False}
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, **options)
    (line,) = done.stderr.splitlines()
    assert "the disk is full: free some space" in line and done.returncode == 2


def test_a_mistake_that_nobody_reads_of_ends_quietly_too(tmp_path: Path) -> None:
    assert unread(tmp_path, "-m", "magnet", "tset", both=True) == (CLOSED, "")


def test_a_table_is_written_before_it_is_printed(tmp_path: Path) -> None:
    assert unread(tmp_path, "-c", SHOWS) == (CLOSED, "")
    assert (tmp_path / "out" / "results.json").exists() and (tmp_path / "out" / "results.csv").exists()


def test_another_broken_pipe_is_an_error(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", LOST], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    assert "Broken pipe" in done.stderr


def test_a_run_goes_on_where_nobody_reads_its_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    reads, writes = os.pipe()
    os.close(reads)
    with os.fdopen(writes, "w") as unread_output:
        monkeypatch.setattr(sys, "stdout", unread_output)
        lines = run_progress.ProgressLines(seconds=0.0)
        for done in (1, 2, 3):
            lines.tell("test: denoising step", done, 3)
        print("the table", flush=True)
        assert not output_closed()  # it leads nowhere now


def test_a_table_is_written_where_no_output_is_open(tmp_path: Path) -> None:
    closed = f"exec {shlex.quote(sys.executable)} -c {shlex.quote(SHOWS)} >&- 2>&- <&-"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    assert subprocess.run(["sh", "-c", closed], cwd=tmp_path, env=environment, timeout=120).returncode == 0
    assert (tmp_path / "out" / "results.json").exists()


def test_letters_that_a_stream_does_not_know_are_question_marks() -> None:
    narrow, wide = (io.TextIOWrapper(io.BytesIO(), encoding=name) for name in ("cp1252", "utf-8"))
    take_any_letter(narrow, wide, None)
    for stream in (narrow, wide):
        stream.write("FD \u2193 \u00e9 \udcff")  # the last is a byte in a file's name that is no UTF-8
        stream.flush()
    assert narrow.buffer.getvalue() == b"FD ? \xe9 ?"
    assert wide.buffer.getvalue() == "FD \u2193 \u00e9 ?".encode()
