"""What adds an optional package: the released one by its name, a clone that is installed as it lies by its folder."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pytest

from magnet import extras
from magnet.cli.doctor import EXTRAS
from magnet.extras import PACKAGE, installing

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]


class Installed:
    def __init__(self, said: str | None) -> None:
        self.said = said

    def read_text(self, name: str) -> str | None:
        assert name == "direct_url.json"
        return self.said


@pytest.mark.parametrize("said", [None, "", "{", json.dumps({"url": "file:///a/b.whl", "archive_info": {}})])
def test_a_released_package_is_named(said: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extras, "distribution", lambda name: Installed(said))
    assert installing("usd") == 'pip install "magnet-motion[usd]"'


def test_nothing_installed_is_as_a_released_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extras, "PACKAGE", "no-such-package-here")
    assert installing("usd") == 'pip install "no-such-package-here[usd]"'


def test_a_clone_is_named_by_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "my clones" / "magnet"
    said = json.dumps({"url": folder.as_uri(), "dir_info": {"editable": True}})
    monkeypatch.setattr(extras, "distribution", lambda name: Installed(said))
    assert installing("view") == f'pip install -e "{folder}[view]"'


def test_every_extra_that_is_advised_exists() -> None:
    assert PROJECT["name"] == PACKAGE
    assert EXTRAS.keys() <= PROJECT["optional-dependencies"].keys()
