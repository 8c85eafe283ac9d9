"""Which data sets there are: ours, of other packages, and of modules in the working directory."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml

from magnet import cli, plugins
from magnet.datamodules import Synthetic, registry
from magnet.datamodules.prepared import Prepared
from magnet.datamodules.preparing.check import recognise
from magnet.datamodules.reading.recording import Reader, Recording, Take
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
    before = {entry.name for entry in registry.entries()}
    monkeypatch.setattr(plugins, "entry_points", lambda group: points if group == registry.DATA.group else [])
    yield points
    for entry in registry.entries():
        if entry.name not in before:
            registry.unregister(entry.kind)
    monkeypatch.undo()
    registry.discover(again=True)


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory that Python does not know."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place])
    yield tmp_path
    for name in [name for name in sys.modules if name.startswith("mine_of_mine")]:
        del sys.modules[name]


def test_packages_are_listed_and_one_that_fails_hides_no_other(offered: list[Point], tmp_path: Path, capsys) -> None:
    class Strolls(Synthetic):
        """People who stroll."""

    class WalksReader(Reader):
        """Walks."""

        name, title, source, licence = "walks", "Walks of theirs", "https://example.org", "free"

        def found(self) -> list[Take]:
            return []

        def read(self, take: Take) -> Recording:
            raise NotImplementedError

    class Walks(Prepared):
        """People who walk."""

        reader = WalksReader

    offered += [
        Point("Strolls", "theirs:Strolls", Strolls),
        Point("Broken", "theirs:Broken", ImportError("no module named shoes")),
        Point("Model", "theirs:Denoiser", Denoiser),
        Point("walks", "theirs:Strolls", Strolls),
        Point("Walks", "theirs:Walks", Walks),
    ]
    registry.discover(again=True)
    assert cli.main(["data", "list"]) == 0
    said = capsys.readouterr().out
    assert "Strolls  of theirs:Strolls" in said and "People who stroll." in said and "--data Strolls" in said
    assert re.search(r"Broken  of theirs:Broken\n +failed to load +ImportError: no module named shoes", said)
    assert re.search(r"failed to load +TypeError: .*Denoiser.> is no LightningDataModule", said)
    assert "call the entry point Strolls, too" in said
    assert "cmu" in said and "DuoBox" in said
    assert "walks  Walks of theirs" in said and "--data Walks --data.path STORE" in said
    assert cli.main(["data", "fake", "walks", str(tmp_path / "new")]) == 2
    assert (
        "Walks of theirs brings no made-up download; ask for the data at https://example.org" in capsys.readouterr().err
    )
    with pytest.raises(ValueError, match="data set Broken failed to load: ImportError"):
        registry.reader("Broken")


def walks(**parts: Any) -> type[Prepared]:
    """A data set called Walks whose reader has other parts, or lacks those that are None."""
    given: dict[str, Any] = {
        "name": "walks",
        "title": "Walks of theirs",
        "source": "https://example.org",
        "licence": "free",
        "found": lambda self: [],
        "read": lambda self, take: None,
        "__module__": "theirs",
    }
    whole = {name: part for name, part in (given | parts).items() if part is not None}
    return type("Walks", (Prepared,), {"reader": type("WalksReader", (Reader,), whole)})


@pytest.mark.parametrize(
    ("parts", "said"),
    [
        ({"name": None}, "has no name"),
        ({"title": None, "licence": ""}, "has no title and has no licence"),
        ({"source": 3}, "has no source"),
        ({"read": None}, "has no read()"),
        ({"found": None, "read": None}, "has no found() and has no read()"),
        ({"family": "smplh"}, "has the family 'smplh', expected smplx or smpl or positions or any"),
        ({"layout": ("NAME.npz",)}, "has the layout ('NAME.npz',), expected pairs such as"),
        ({"layout": "NAME.npz"}, "has the layout 'NAME.npz', expected pairs such as"),
    ],
)
def test_a_reader_that_lacks_a_part_is_refused_and_named_and_in_nobodys_way(
    parts: dict[str, Any], said: str, offered: list[Point], capsys, tmp_path: Path
) -> None:
    offered.append(Point("Walks", "theirs:Walks", walks(**parts)))
    registry.discover(again=True)
    assert cli.main(["data", "list"]) == 0
    (line,) = (line for line in capsys.readouterr().out.splitlines() if "failed to load" in line)
    assert f"TypeError: reader theirs.WalksReader {said}" in line and "docs/own.md" in line
    (tmp_path / "nothing").mkdir()
    assert cli.main(["data", "check", str(tmp_path / "nothing")]) == 2
    assert "neither a prepared store nor a download that is known" in capsys.readouterr().err


def test_a_reader_that_fails_on_a_folder_hides_no_other(offered: list[Point], capsys, tmp_path: Path) -> None:
    def found(self: Reader) -> list[Take]:
        raise KeyError("theirs")

    offered.append(Point("Walks", "theirs:Walks", walks(found=found)))
    registry.discover(again=True)
    registry.reader("dd100").write_fake(tmp_path, 3, 60)
    assert recognise(tmp_path) == "dd100"


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


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("Broken", "magnet fit: error: data set Broken failed to load: ImportError: no module named shoes (of theirs:"),
        ("Nowhere", "magnet fit: error: no data Nowhere; there are Synthetic, "),
    ],
)
@pytest.mark.parametrize("named_by", ["flag", "file"])
def test_a_data_set_that_is_not_there_is_told_with_the_reason_and_nothing_before_it(
    name: str, said: str, named_by: str, offered: list[Point], here: Path, capsys
) -> None:
    offered.append(Point("Broken", "theirs:Broken", ImportError("no module named shoes")))
    registry.discover(again=True)
    (here / "ours.yaml").write_text(yaml.safe_dump({"data": {"class_path": "Synthetic", "init_args": {"seed": 3}}}))
    (here / "theirs.yaml").write_text(yaml.safe_dump({"data": name}))
    words = ["--data", name] if named_by == "flag" else ["--config", "theirs.yaml"]
    assert cli.main(["fit", "--model", "Tokenizer", "--config", "ours.yaml", *words]) == 2
    told = capsys.readouterr().err
    assert told.replace("theirs.yaml, line 1: data: ", "").startswith(said) and told.count("\n") == 1
    assert ("theirs.yaml, line 1: " in told) == (named_by == "file" and name == "Nowhere")


def test_preparing_says_why_a_reader_is_not_there(offered: list[Point], capsys) -> None:
    offered.append(Point("Walks", "theirs:Walks", walks(title=None)))
    registry.discover(again=True)
    for name, said in {
        "walks": "data set Walks failed to load: TypeError: reader theirs.WalksReader has no title",
        "strolling": "(Walks failed to load: magnet data list says why)",
    }.items():
        assert cli.main(["data", "prepare", name, "--root", ".", "--out", "store"]) == 2
        assert said in capsys.readouterr().err


OURS = "magnet.datamodules.synthetic.Synthetic"
MIXTURE = {"class_path": "Mixed", "init_args": {"data": [{"class_path": "Synthetic"}]}}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--data", "Synthetic"], OURS),
        (["--data=Synthetic", "--data.clip_frames", "70"], OURS),
        (["--data.class_path", "Synthetic"], OURS),
        (["--data", yaml.safe_dump({"class_path": "Synthetic"}, default_flow_style=True).strip()], OURS),
        (["--data", "Mixed", "--data.data", "[Synthetic]"], ["magnet.datamodules.Mixed", OURS]),
        (["--config", "one.yaml"], OURS),
        (["--config", "mixed.yaml"], ["magnet.datamodules.Mixed", OURS]),
        (["--config", "one.yaml", "--data", "mine_of_mine.Synthetic"], "mine_of_mine.Synthetic"),
    ],
)
def test_a_short_name_is_the_registered_class_whatever_a_refused_one_is_called(
    words: list[str], said: str | list[str], offered: list[Point], here: Path, capsys
) -> None:
    (here / "mine_of_mine.py").write_text(MINE.replace("Mine(", "Synthetic("))
    (here / "one.yaml").write_text(yaml.safe_dump({"data": "Synthetic"}))
    (here / "mixed.yaml").write_text(yaml.safe_dump({"data": MIXTURE}))
    registry.import_local("mine_of_mine.Synthetic")
    offered.append(Point("Synthetic", "mine_of_mine:Synthetic", sys.modules["mine_of_mine"].Synthetic))
    registry.discover(again=True)
    assert ["name Synthetic is taken" in str(each.error) for each in registry.failures()] == [True]
    got = printed(capsys, *words)
    paths = [got["class_path"], *(part["class_path"] for part in got["init_args"].get("data", []))]
    assert paths == ([said] if isinstance(said, str) else said)


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
    assert said.startswith("magnet fit: error: --data mine_of_mine.Mine: ") and message in said
    (here / "mine_of_mine.py").unlink()
    sys.modules.pop("mine_of_mine", None)
    assert cli.main(words) == 2
    assert "no module mine_of_mine, neither installed nor in the working directory" in capsys.readouterr().err


# -- ours --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", registry.readers())
def test_a_reader_has_all_its_parts(name: str) -> None:
    kind = registry.reader(name)
    data = registry.classes()[registry.data_of(kind)]
    assert issubclass(kind, Reader) and kind.name == name and kind.fake
    assert kind.source and kind.licence and issubclass(data, Prepared)
    if kind.own:  # any store's module trains on it
        assert data is Prepared
    else:
        assert re.match(r"https?://", kind.source) and data.reader is kind


def test_every_module_of_the_list_registers_something_and_no_name_is_taken_twice() -> None:
    modules = {kind.__module__ for kind in (*registry.classes().values(), *registry.readers().values())}
    assert modules >= {f"magnet.datamodules.{module}" for module in registry.BUILT_IN}
    assert registry.default_path() == "magnet.datamodules.synthetic.Synthetic"
    other = type("Synthetic", (Synthetic,), {})
    with pytest.raises(ValueError, match=r"Synthetic is taken by magnet\.datamodules\.synthetic"):
        registry.register_data("theirs")(other)
    with pytest.raises(TypeError, match="is no LightningDataModule"):
        registry.register_data()(dict)  # type: ignore[type-var]
    with pytest.raises(TypeError, match="is no Reader"):
        registry.register_reader(dict)  # type: ignore[type-var]
    with pytest.raises(ValueError, match=r"reader name dd100 is taken by magnet\.datamodules\.dd100"):
        registry.register_reader(type("Mine", (registry.reader("dd100"),), {}))


def test_a_wrong_name_suggests_the_closest_and_synthetic_needs_no_preparing() -> None:
    assert registry.reader("InterX") is registry.reader("interx")
    for suffix, named in (("fbx", "glb"), ("NPZ", "scenes")):
        with pytest.raises(ValueError, match=f"no data set '{suffix}'; {named} reads such files"):
            registry.reader(suffix)
    with pytest.raises(ValueError, match="no data set 'interXX'; did you mean interx"):
        registry.reader("interXX")
    with pytest.raises(ValueError, match=r"synthetic has no files to prepare: magnet fit .* --data Synthetic trains"):
        registry.reader("synthetic")
