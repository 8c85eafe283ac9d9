"""The package of `examples/magnet-duel`, installed as a stranger's would be."""

import importlib
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


def test_an_installed_task_is_listed_with_where_it_comes_from(installed: Path, tmp_path: Path):
    listed = run("magnet", "tasks", installed=installed, cwd=tmp_path)
    assert "magnet-duel 0.1.0" in listed
    assert "--task.ending" in listed and "P(A_t:L-1 | A_0:t-1, A_L, B_0:L, ...)" in listed


def test_its_fields_are_options_as_ours_are(installed: Path, tmp_path: Path):
    command = ("magnet", "test", "--task", "duel", "--task.target", "1", "--task.ending", "2", "--print_config")
    config = run(*command, installed=installed, cwd=tmp_path)
    assert "target: 1" in config and "ending: 2" in config


def test_its_data_set_is_listed_and_its_fields_are_options(installed: Path, tmp_path: Path):
    listed = run("magnet", "data", "list", installed=installed, cwd=tmp_path)
    assert "Strolls  of magnet-duel 0.1.0" in listed and "--data Strolls" in listed
    command = ("magnet", "fit", "--model", "Tokenizer", "--data", "Strolls", "--data.takes", "3", "--print_config")
    config = run(*command, installed=installed, cwd=tmp_path)
    assert "magnet_duel.strolls.Strolls" in config and "takes: 3" in config


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
