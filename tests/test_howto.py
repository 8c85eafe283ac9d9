"""The answers of docs/howto.md: every command runs and prints what the page shows.

python tests/test_howto.py    # writes what the commands print into the page
"""

from __future__ import annotations

import code
import contextlib
import doctest
import io
import os
import re
import shlex
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from magnet import cli
from magnet.datamodules.preparing import progress

PAGE = Path(__file__).parents[1] / "docs" / "howto.md"
BLOCK = re.compile(
    r"(?P<slow><!-- slow -->\n)?```(?P<kind>console|pycon)\n(?P<text>.*?)^```$", re.MULTILINE | re.DOTALL
)
QUESTIONS = 15
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def steps(kind: str, text: str) -> Iterator[tuple[str, str]]:
    """Each command of a block with what it prints."""
    mark = {"console": "$ ", "pycon": ">>> "}[kind]
    for part in re.split(rf"^{re.escape(mark)}", text, flags=re.MULTILINE)[1:]:
        command, _, printed = part.partition("\n")
        yield command, printed


def run(kind: str, command: str, space: dict[str, Any]) -> str:
    """What a command prints, in this process: of the shell's commands only magnet's are known."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        if kind == "pycon":
            console = code.InteractiveConsole(space)
            assert not console.push(command)
        else:
            name, *words = shlex.split(command)
            assert name == "magnet"
            assert cli.main(words) == 0, said.getvalue()
    return said.getvalue()


def checked(slow: bool, folder: Path) -> list[str]:
    """Commands that print something else than the page shows, with both."""
    wrong, space = [], {"__name__": "__main__"}
    for block in BLOCK.finditer(PAGE.read_text()):
        if block["slow"] and not slow:
            continue
        for command, shown in steps(block["kind"], block["text"]):
            got = run(block["kind"], command, space)
            if not doctest.OutputChecker().check_output(shown, got, FLAGS):
                wrong.append(f"{command}\n-- shown:\n{shown}-- printed:\n{got}")
    assert list(folder.iterdir())
    return wrong


@pytest.mark.parametrize("slow", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["quick", "all"])
def test_every_answer_prints_what_the_page_shows(slow: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MAGNET_CMU", raising=False)
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setattr(progress, "SECONDS", 3600.0)  # a slow machine says how far it is, which the page does not show
    if slow:
        for package in ("onnx", "onnxruntime", "onnxscript"):
            pytest.importorskip(package)
    wrong = checked(slow, tmp_path)
    assert not wrong, "\n\n".join(wrong)


def test_every_question_has_a_command_and_what_it_prints() -> None:
    parts = re.split(r"^## (\d+)\. ", PAGE.read_text(), flags=re.MULTILINE)[1:]
    assert [int(number) for number in parts[::2]] == list(range(1, QUESTIONS + 1))
    for number, answer in zip(parts[::2], parts[1::2], strict=True):
        found = [step for block in BLOCK.finditer(answer) for step in steps(block["kind"], block["text"])]
        assert found and any(printed.strip(". \n") for _, printed in found), number


if __name__ == "__main__":
    page = PAGE.read_text()
    where = {"__name__": "__main__"}
    os.environ.pop("MAGNET_CMU", None)
    os.environ["COLUMNS"] = "120"
    progress.SECONDS = 3600.0
    os.chdir(tempfile.mkdtemp())

    def filled(block: re.Match[str]) -> str:
        mark = {"console": "$ ", "pycon": ">>> "}[block["kind"]]
        made = [mark + each + "\n" + run(block["kind"], each, where) for each, _ in steps(block["kind"], block["text"])]
        return f"{block['slow'] or ''}```{block['kind']}\n{''.join(made)}```"

    sys.stdout.write(BLOCK.sub(filled, page))
