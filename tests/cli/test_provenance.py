"""Where results come from."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from magnet import plugins
from magnet.cli.provenance import PACKAGES, git_state, machine, provenance


def test_machine_facts_are_json_ready() -> None:
    facts = machine()
    assert facts["cores"] >= 1 and facts["torch"] == torch.__version__
    json.dumps(facts)


def test_provenance_names_every_package_and_is_json_ready() -> None:
    said = provenance()
    assert list(said["packages"]) == list(PACKAGES) and all(said["packages"].values())
    json.dumps(said)


def test_provenance_names_the_packages_whose_plug_ins_were_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    def point(package: str, load: object) -> SimpleNamespace:
        return SimpleNamespace(name=package, value="", load=load, dist=SimpleNamespace(name=package, version="1.2"))

    points = [point("their-tasks", lambda: int), point("broken", lambda: 1 / 0)]
    monkeypatch.setattr(plugins, "VERSIONS", {})
    monkeypatch.setattr(plugins, "entry_points", lambda group: points)
    assert provenance()["plug-ins"] == {}
    plugins.Registry("thing", "some.things", (), lambda name, kind: None).discover()
    assert provenance()["plug-ins"] == {"their-tasks": "1.2"}


def test_the_commit_is_that_of_the_source_tree_and_of_no_repository_around_it(tmp_path: Path) -> None:
    def git(*words: str) -> str:
        identity = ["-c", "user.name=a", "-c", "user.email=a@b"]
        return subprocess.run(
            ["git", "-C", str(tmp_path), *identity, *words], check=True, capture_output=True, text=True
        ).stdout.strip()

    package = tmp_path / "package"
    package.mkdir()
    (package / "__init__.py").touch()
    assert git_state(package) is None
    git("init", "-q")
    assert git_state(package) is None, "installed into somebody else's repository"
    git("add", ".")
    git("commit", "-qm", "first")
    assert git_state(package) == {"commit": git("rev-parse", "HEAD"), "changed": False}
    (package / "__init__.py").write_text("changed = True")
    assert git_state(package) == {"commit": git("rev-parse", "HEAD"), "changed": True}
