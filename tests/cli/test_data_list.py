"""What `magnet data list` says of files is where readers look for them."""

from __future__ import annotations

import re
from fnmatch import fnmatchcase
from pathlib import Path

import pytest
from rich.console import Console

from magnet import cli
from magnet.cli.data_list import draw_list
from magnet.datamodules import registry
from tests.cases import few


def globs(pattern: str) -> list[str]:
    """A pattern as globs: {a,b} is either, words in capitals are anything."""
    if match := re.search(r"\{([^}]*)\}", pattern):
        return [
            glob
            for one in match[1].split(",")
            for glob in globs(pattern[: match.start()] + one + pattern[match.end() :])
        ]
    return [re.sub(r"XX|(?<![A-Za-z])[A-Z]{2,}(?![A-Za-z0-9])", "*", pattern)]


def test_patterns_are_globs() -> None:
    assert globs("{a,b}/sXX/CAPTURE/P1.npz") == ["a/s*/*/P1.npz", "b/s*/*/P1.npz"]


@pytest.mark.parametrize("name", few(registry.readers(), 4))
def test_a_download_lies_as_it_is_listed(name: str, tmp_path: Path) -> None:
    reader = registry.reader(name)
    registry.reader(name).write_fake(tmp_path, 4, 12)
    files = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()}
    listed = {glob for pattern, _ in reader.layout for glob in globs(pattern)}
    assert listed
    for glob in listed:
        assert any(fnmatchcase(file, glob) for file in files), glob
    for take in reader(tmp_path).found():
        for path in take.files:
            file = path.relative_to(tmp_path).as_posix()
            assert any(fnmatchcase(file, glob) for glob in listed), file


@pytest.mark.parametrize(("name", "title"), [("Synthetic", "Synthetic"), ("synthetic", "Synthetic"), ("CMU", "cmu")])
def test_one_is_told_of_by_the_name_of_its_files_or_of_its_class(name: str, title: str) -> None:
    console = Console(record=True, width=120)
    assert draw_list(console, name)
    assert console.export_text().startswith(f"{title}  ")


@pytest.mark.parametrize(("name", "body"), [("bvh", ""), ("cmu", ""), ("dd100", " --body dl/body.npz")])
def test_a_made_up_download_is_prepared_with_the_body_that_the_list_says(name, body, tmp_path, monkeypatch, capsys):
    """Files of one's own with the open one, so that the shipped model goes on with their store."""
    monkeypatch.chdir(tmp_path)
    assert cli.main(["data", "fake", name, "dl", "--takes", "1", "--frames", "12"]) == 0
    assert f"magnet data prepare {name} --root dl --out STORE{body}\n" in capsys.readouterr().out


def test_the_body_is_that_of_a_data_sets_shape_numbers() -> None:
    """InterHuman's are SMPL-H's, Hi4D's SMPL's."""
    for name, bodies, site in (("interhuman", "SMPLH", "mano.is.tue"), ("hi4d", "SMPL", "smpl.is.tue")):
        console = Console(record=True, width=200)
        draw_list(console, name)
        text = console.export_text()
        assert f"--bodies {bodies}\n" in text and site in text
