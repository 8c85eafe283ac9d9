"""`magnet doctor` names what is there, what is missing, and what to do about each thing that is."""

from __future__ import annotations

import re
import sys
import tomllib
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path

import pytest

from magnet import checkpoints, cli, plugins
from magnet.cli import doctor
from magnet.datamodules.registry import DATA
from magnet.export import fbx
from magnet.extras import installing
from magnet.metrics.registry import METRICS
from magnet.tasks.registry import TASKS

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def named(requirement: str) -> str:
    return re.split(r"[\s\[<>=!~;]", requirement, maxsplit=1)[0]


def test_every_extra_is_told_with_what_it_needs() -> None:
    extras = {name: lines for name, lines in PROJECT["optional-dependencies"].items() if name in doctor.EXTRAS}
    assert set(PROJECT["optional-dependencies"]) - set(extras) == {"all", "dev"}
    assert {name: tuple(map(named, lines)) for name, lines in extras.items()} == {
        name: extra.needs for name, extra in doctor.EXTRAS.items()
    }
    assert set(doctor.CORE) <= {named(line) for line in PROJECT["dependencies"]}


def test_what_is_missing_comes_with_advice(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MAGNET_CMU", raising=False)
    there = doctor.version_of
    monkeypatch.setattr(doctor, "version_of", lambda name: None if name in ("viser", "av") else there(name))
    assert cli.main(["doctor"]) == 0
    said = capsys.readouterr().out
    above, _, advice = said.partition("\nwhat to do\n")
    missing = re.findall(r"^  -  +(\S+)", above, re.MULTILINE)
    assert {"view", "video", "CMU"} <= set(missing)
    advised = re.findall(r"^  (\S+)", advice, re.MULTILINE)
    assert set(missing) - {"gpu"} == set(advised)
    assert installing("view") in advice and "export MAGNET_CMU" in advice
    assert re.search(r"ok +model duet +.*every hash right", above)


def test_what_writes_fbx_is_named_with_its_place_or_with_advice(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "bpy", None)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv(fbx.VARIABLE, raising=False)
    assert [(one.state, one.advice.partition(",")[0]) for one in doctor.blender()] == [("missing", "pip install bpy")]
    monkeypatch.setenv(fbx.VARIABLE, str(tmp_path / "python"))
    assert cli.main(["doctor"]) == 1
    said = capsys.readouterr().out
    assert re.search(rf"WRONG +blender +{fbx.VARIABLE} is .*python, which is no program", said)
    monkeypatch.setenv(fbx.VARIABLE, sys.executable)
    assert [one.state for one in doctor.blender()] == ["ok"]


def test_what_is_wrong_ends_with_an_error(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MAGNET_CMU", str(tmp_path))
    (tmp_path / "weights" / "bad").mkdir(parents=True)
    (tmp_path / "weights" / "bad" / "config.json").write_text("{}")
    monkeypatch.setattr(checkpoints, "FOLDER", tmp_path / "weights")
    monkeypatch.setattr(doctor, "version_of", lambda name: "2.6.3" if name == "lightning" else "1.0")
    assert cli.main(["doctor"]) == 1
    said = capsys.readouterr().out
    assert re.search(r"WRONG +model bad +.*damaged", said)
    assert re.search(r"WRONG +CMU +.*holds no \.amc", said)
    assert re.search(r"WRONG +lightning +2\.6\.3", said) and "held malware" in said


def test_what_packages_add_is_listed_and_what_failed_has_its_reason(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "theirs_for_doctor.py").write_text(
        "from dataclasses import dataclass\n"
        "from magnet.tasks.joint import JointFuture\n"
        "@dataclass(frozen=True)\n"
        "class Good(JointFuture): 'Theirs.'\n"
        "class Bad(Good):\n"
        "    def schedule(self): pass\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    points = [
        EntryPoint("theirs_good", "theirs_for_doctor:Good", "magnet.tasks"),
        EntryPoint("theirs_bad", "theirs_for_doctor:Bad", "magnet.tasks"),
        EntryPoint("TheirShoes", "theirs_for_doctor:Shoes", "magnet.datamodules"),
        EntryPoint("their_number", "shoes_of_mine:Number", "magnet.metrics"),
        EntryPoint("their_slip", "theirs_for_doctor:Good", "magnet.task"),
    ]
    for registry in (TASKS, DATA, METRICS):
        registry.discover()  # ours register once, and the tests after this one need them too
    monkeypatch.setattr(plugins, "entry_points", lambda **group: EntryPoints(points).select(**group))
    for registry in (TASKS, DATA, METRICS):
        monkeypatch.setattr(registry, "known", dict(registry.known))
        monkeypatch.setattr(registry, "failed", [])
        monkeypatch.setattr(registry, "discovered", False)
    assert cli.main(["doctor"]) == 1
    said = capsys.readouterr().out
    assert re.search(r"ok +task theirs_good +of theirs_for_doctor:Good", said)
    assert re.search(r"WRONG +task theirs_bad +of theirs_for_doctor:Bad: task theirs_bad: schedule\(grid\) fails", said)
    assert re.search(r"WRONG +data set TheirShoes +of .*: failed to load: AttributeError: .*'Shoes'", said)
    assert re.search(r"WRONG +metric their_number +of .*: failed to load: ModuleNotFoundError: .*shoes_of_mine", said)
    assert re.search(r"WRONG +their_slip +of .*: nothing reads entry points magnet.task$", said, re.MULTILINE)
    assert re.search(r"their_slip +name the group magnet.tasks in the pyproject.toml", said)
    assert "mend or uninstall shoes_of_mine:Number; everything else works without it" in said
