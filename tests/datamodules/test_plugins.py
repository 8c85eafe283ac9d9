"""Data sets of other packages, and of modules in the working directory."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml

from magnet import cli
from magnet.datamodules import Synthetic, plugins
from magnet.denoiser.module import Denoiser

MINE = """
from magnet.datamodules import MotionDataModule

class Mine(MotionDataModule):
    '''Mine.

    Args:
        takes: how many.
    '''

    def __init__(self, takes: int = 3, max_agents: int = 2) -> None:
        super().__init__(max_agents=max_agents)
"""


@dataclass(frozen=True)
class Point:
    """An installed package's entry point."""

    name: str
    value: str
    held: Any
    dist: None = None

    def load(self) -> Any:
        if isinstance(self.held, Exception):
            raise self.held
        return self.held


@pytest.fixture
def offered(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Point]]:
    points: list[Point] = []
    monkeypatch.setattr(plugins, "entry_points", lambda group: points if group == plugins.GROUP else [])
    plugins.discover.cache_clear()
    yield points
    plugins.discover.cache_clear()


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory that Python does not know."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place])
    yield tmp_path
    for name in [name for name in sys.modules if name.startswith("mine_of_mine")]:
        del sys.modules[name]


def test_packages_are_listed_and_one_that_fails_hides_no_other(offered: list[Point], capsys) -> None:
    class Strolls(Synthetic):
        """People who stroll."""

    offered += [
        Point("Strolls", "theirs:Strolls", Strolls),
        Point("Broken", "theirs:Broken", ImportError("no module named shoes")),
        Point("Model", "theirs:Denoiser", Denoiser),
        Point("walks", "theirs:Strolls", Strolls),
    ]
    assert cli.main(["data", "list"]) == 0
    said = capsys.readouterr().out
    assert "Strolls  of theirs:Strolls" in said and "People who stroll." in said and "--data Strolls" in said
    assert re.search(r"failed to load +ImportError: no module named shoes", said)
    assert re.search(r"failed to load +TypeError: theirs:Denoiser is no LightningDataModule", said)
    assert "call the entry point Strolls, too" in said
    assert "cmu" in said and "DuoBox" in said


def printed(capsys, *words: str) -> dict[str, Any]:
    assert cli.main(["fit", "--model", "Tokenizer", *words, "--print_config"]) == 0
    return yaml.safe_load(capsys.readouterr().out)["data"]


def test_a_class_of_a_module_in_the_working_directory_is_found(here: Path, capsys) -> None:
    (here / "mine_of_mine.py").write_text(MINE)
    assert printed(capsys, "--data", "mine_of_mine.Mine", "--data.takes", "5") == {
        "class_path": "mine_of_mine.Mine",
        "init_args": {"takes": 5, "max_agents": 2},
    }
    assert sys.path[-1] == str(here)


def test_a_file_may_name_it_too_also_within_a_mixture(here: Path, capsys) -> None:
    (here / "mine_of_mine").mkdir()
    (here / "mine_of_mine/sets.py").write_text(MINE)
    parts = [{"class_path": "mine_of_mine.sets.Mine"}, {"class_path": "Synthetic"}]
    (here / "mixed.yaml").write_text(yaml.safe_dump({"data": {"class_path": "Mixed", "init_args": {"data": parts}}}))
    found = printed(capsys, "--config", "mixed.yaml")["init_args"]["data"]
    assert found[0] == {"class_path": "mine_of_mine.sets.Mine", "init_args": {"takes": 3, "max_agents": 2}}


def test_nothing_of_the_working_directory_takes_the_place_of_a_package(here: Path, capsys) -> None:
    (here / "yaml.py").write_text("raise RuntimeError('not this one')")
    (here / "mine_of_mine.py").write_text(f"import yaml\nyaml.safe_load\n{MINE}")
    assert printed(capsys, "--data", "mine_of_mine.Mine")["class_path"] == "mine_of_mine.Mine"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("import shoes_of_mine", "mine_of_mine cannot be imported: ModuleNotFoundError: No module"),
        ("def", "mine_of_mine cannot be imported: SyntaxError"),
        (MINE.replace("class Mine", "class Yours"), "mine_of_mine.py has no Mine; its data sets are Yours"),
    ],
)
def test_a_module_that_is_wrong_is_told_from_one_that_is_not_there(text: str, message: str, here: Path, capsys) -> None:
    (here / "mine_of_mine.py").write_text(text)
    words = ["fit", "--model", "Tokenizer", "--data", "mine_of_mine.Mine"]
    assert cli.main(words) == 2
    said = capsys.readouterr().err
    assert said.startswith("magnet: error: --data mine_of_mine.Mine: ") and message in said
    (here / "mine_of_mine.py").unlink()
    sys.modules.pop("mine_of_mine", None)
    assert cli.main(words) == 2
    assert "no module mine_of_mine, neither installed nor in the working directory" in capsys.readouterr().err
