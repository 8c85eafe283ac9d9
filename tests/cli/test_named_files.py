"""What is said of files that are not there, and of paths with spaces that were not put in quotes."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from magnet import checkpoints, cli
from magnet.cli.errors import explain
from magnet.cli.named_files import unquoted

QUOTES = '; my dance.npz is there: a path with spaces needs quotes, "my dance.npz"'


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with scenes and other files whose names have spaces."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my").mkdir()
    for name in ("one.npz", "my dance.npz", "my/first dance.npz"):
        shutil.copy(checkpoints.FOLDER / "duet/scenes/duet.npz", tmp_path / name)
    (tmp_path / "our own.ckpt").touch()
    return tmp_path


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("predict my dance.npz --out o.glb", f"dance.npz: no such file{QUOTES}"),
        ("export my dance.npz o.glb", f"dance.npz: no such file{QUOTES}"),
        ("refine my dance.npz o.npz", f"dance.npz: no such file{QUOTES}"),
        ("view my dance.npz --html o.html", f"dance.npz: no such file{QUOTES}"),
        ("view my/first dance.npz --html o.html", "my/first dance.npz is there: a path with spaces needs quotes"),
        ("predict one.npz --body our own.ckpt --out o.glb", 'a path with spaces needs quotes, "our own.ckpt"'),
        ("test --ckpt_path our own.ckpt", 'our own.ckpt is there: a path with spaces needs quotes, "our own.ckpt"'),
        ("test --ckpt_path=our own.ckpt", 'our own.ckpt is there: a path with spaces needs quotes, "our own.ckpt"'),
        ("test my dance.npz", f"got my, expected an option; options are written --NAME VALUE{QUOTES}"),
        ("export our own.npz o.glb", "our: no such file; a path with spaces needs quotes"),
        ("predict our own.npz --out o.glb", "our: no such file; a path with spaces needs quotes"),
        ("predict one.npz two.npz --out o.glb", "two.npz: no such file"),
        ("predict dance --out o.glb", "dance: no such file; the name of a file to read ends in .npz, "),
        (
            "predict one.npz --out my o.glb",
            '--out my: has no suffix, which says what is written; a path with spaces needs quotes, --out "my o.glb"',
        ),
    ],
)
def test_a_file_that_is_not_there_is_named_and_quotes_where_they_lack(
    words: str, message: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(words.split()) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert message in line and line.count("needs quotes") == ("quotes" in message)
    assert not list(folder.glob("o.*"))


def test_words_that_are_files_themselves_need_no_quotes(folder: Path) -> None:
    (folder / "one.npz my dance.npz").touch()
    assert unquoted(["one.npz", "my dance.npz"]) == "" == unquoted(["--out", "none.npz", "--trim", "my"])
    assert unquoted(["one.npz", "my", "dance.npz", "--trim"]) != ""


def test_words_that_together_are_longer_than_a_name_may_be_do_not_hide_a_mistake(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    takes = [f"{'take' * 20}{number}.npz" for number in range(4)]
    assert cli.main(["predict", *takes, "--out", "o.glb"]) == 2
    assert f"{takes[0]}: no such file" in capsys.readouterr().err
    assert cli.main(["export", "x" * 300, "o.glb"]) == 2
    assert "File name too long" in capsys.readouterr().err


def test_a_name_that_no_file_of_text_takes_is_shown_where_it_stands() -> None:
    """As of archives that were packed on Windows: bytes that are no UTF-8."""
    with pytest.raises(UnicodeEncodeError) as error:
        '"take": "\udc81bung_A", "split": "train"'.encode()
    said = explain(error.value) or ""
    assert said.startswith("the name of a file or folder is not UTF-8, here in ") and r"\udc81bung_A" in said
