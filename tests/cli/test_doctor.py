"""`magnet doctor` names what is there, what is missing, and what to do about each thing that is."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from magnet import checkpoints, cli
from magnet.cli import doctor

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
    assert 'pip install "magnet-motion[view]"' in advice and "export MAGNET_CMU" in advice
    assert re.search(r"ok +model duet +.*every hash right", above)


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
