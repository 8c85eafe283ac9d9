"""The package of `examples/magnet-duel`, installed as a stranger's would be."""

import importlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from magnet.testing import task_laws

EXAMPLE = Path(__file__).parents[2] / "examples" / "magnet-duel"


def run(*command: str, installed: Path, cwd: Path) -> str:
    paths = os.pathsep.join(filter(None, [str(installed), os.environ.get("PYTHONPATH", "")]))
    environment = {**os.environ, "PYTHONPATH": paths, "COLUMNS": "200", "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        [sys.executable, "-m", *command], capture_output=True, text=True, timeout=120, env=environment, cwd=cwd
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the package in it, built from a copy so that the repository stays as it is."""
    pytest.importorskip("setuptools", minversion="70.1", reason="builds the example without the network")
    pytest.importorskip("pip")
    where = tmp_path_factory.mktemp("example")
    shutil.copytree(EXAMPLE, where / "source", ignore=shutil.ignore_patterns("build", "*.egg-info", "__pycache__"))
    pip = (
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--no-build-isolation",
        "--no-index",
        "--disable-pip-version-check",
    )
    run(*pip, "--target", str(where / "installed"), str(where / "source"), installed=where, cwd=where)
    return where / "installed"


COMMANDS = {
    "tasks": ("tasks",),
    "test": ("test", "--task", "duel", "--task.target", "1", "--task.ending", "2", "--print_config"),
    "data list": ("data", "list"),
    "fit": ("fit", "--model", "Tokenizer", "--data", "Strolls", "--data.takes", "3", "--print_config"),
}
ONE_AFTER_ANOTHER = """
import contextlib, io, json, sys
from magnet import cli

said = {}
for name, words in json.loads(sys.argv[1]).items():
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.suppress(SystemExit):
        cli.main(words)
    said[name] = out.getvalue()
print(json.dumps(said))
"""


@pytest.fixture(scope="module")
def said(installed: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What commands print where the package is installed, by their names; in one process, which takes seconds."""
    where = tmp_path_factory.mktemp("said")
    (where / "commands.py").write_text(ONE_AFTER_ANOTHER)
    return json.loads(run("commands", json.dumps(COMMANDS), installed=installed, cwd=where))


@pytest.mark.slow
def test_an_installed_task_is_listed_with_where_it_comes_from(said: dict[str, str]):
    assert "magnet-duel 0.1.0" in said["tasks"]
    assert "--task.ending" in said["tasks"] and "P(A_t:L-1 | A_0:t-1, A_L, B_0:L, ...)" in said["tasks"]


@pytest.mark.slow
def test_its_fields_are_options_as_ours_are(said: dict[str, str]):
    assert "target: 1" in said["test"] and "ending: 2" in said["test"]


@pytest.mark.slow
def test_its_data_set_is_listed_and_its_fields_are_options(said: dict[str, str]):
    assert "Strolls  of magnet-duel 0.1.0" in said["data list"] and "--data Strolls" in said["data list"]
    assert "magnet_duel.strolls.Strolls" in said["fit"] and "takes: 3" in said["fit"]


@pytest.mark.slow
def test_its_own_tests_pass(installed: Path, tmp_path: Path):
    tests = shutil.copytree(EXAMPLE / "tests", tmp_path / "tests")
    said = run("pytest", "-q", "-p", "no:cacheprovider", str(tests), installed=installed, cwd=tmp_path)
    assert " passed" in said and "failed" not in said


def test_an_uninstalled_task_is_named_by_a_variable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("MAGNET_TASKS", "magnet_duel:Duel")
    listed = run("magnet", "tasks", installed=EXAMPLE, cwd=tmp_path)
    assert "MAGNET_TASKS=magnet_duel:Duel" in listed and "duel" in listed


def test_the_task_in_the_docs_obeys_the_laws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """As it stands on the author's page."""
    page = (EXAMPLE.parents[1] / "docs" / "tasks.md").read_text()
    blocks = [part.split("```")[0] for part in page.split("```python\n")[1:]]
    (tmp_path / "duel_of_the_docs.py").write_text(next(block for block in blocks if "class Duel" in block))
    monkeypatch.syspath_prepend(tmp_path)
    duel = importlib.import_module("duel_of_the_docs").Duel
    assert all(grid.agents > 1 for grid in task_laws(duel()))
    assert task_laws(duel(target=1))
