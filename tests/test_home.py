"""What the project looks like from outside: wheel, workflows, image and hooks keep what they promise."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from magnet.evaluation.scoring import TRUTH

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
PYTHONS = {line.rpartition(":: ")[2] for line in PROJECT["classifiers"] if "Python :: 3." in line}
EXTRAS = set(PROJECT["optional-dependencies"])


def jobs(workflow: Path) -> dict[str, Any]:
    return yaml.safe_load(workflow.read_text(encoding="utf-8"))["jobs"]


def lines(workflow: Path) -> list[str]:
    """What a workflow runs."""
    return [step["run"] for job in jobs(workflow).values() for step in job["steps"] if "run" in step]


def test_the_tests_run_with_every_python_that_is_named() -> None:
    job = jobs(ROOT / ".github/workflows/test.yml")["test"]
    assert set(job["strategy"]["matrix"]["python"]) == PYTHONS == {"3.11", "3.12", "3.13"}


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.stem)
def test_a_workflow_runs_what_is_there(workflow: Path) -> None:
    makefile = (ROOT / "Makefile").read_text()
    targets = set(re.findall(r"^([\w-]+):.*##", makefile, re.MULTILINE))
    said = "\n".join(lines(workflow))
    assert set(re.findall(r"\bmake ([\w-]+)", said)) <= targets
    assert {name for names in re.findall(r"\.\[([\w,]+)\]", said) for name in names.split(",")} <= EXTRAS
    installs = [line for line in said.splitlines() if "pip install" in line]
    assert installs and all("--torch-backend cpu" in line for line in installs)
    uses = [step["uses"] for job in jobs(workflow).values() for step in job["steps"] if "uses" in step]
    assert uses and all(re.fullmatch(r"[\w-]+/[\w-]+@v\d+", name) for name in uses)
    assert all("timeout-minutes" in job for job in jobs(workflow).values())


def test_the_image_copies_what_is_there_and_is_sent_no_more() -> None:
    dockerfile = (ROOT / "Dockerfile").read_text()
    copied = {name for words in re.findall(r"^COPY (.*) \S+$", dockerfile, re.MULTILINE) for name in words.split()}
    assert copied and all((ROOT / name).exists() for name in copied)
    sent = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    assert sent == copied
    extras = re.search(r"^ARG EXTRAS=(.*)$", dockerfile, re.MULTILINE)
    assert extras and set(extras[1].split(",")) <= EXTRAS


def test_hooks_before_commits_keep_recordings_out() -> None:
    hooks = {
        hook["id"]: hook
        for repo in yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
        for hook in repo["hooks"]
    }
    assert {"ruff", "ruff-format", "mypy", "no-recordings"} <= set(hooks)
    refused = re.compile(hooks["no-recordings"]["files"])
    for name in ("a/60_01.amc", "x.bvh", "SMPLX_NEUTRAL.npz", "b/SMPL_MALE.pkl", "out/films/a.npz"):
        assert refused.search(name), name
    assert not [name for name in tracked(".") if refused.search(name)]


def test_no_array_of_the_repository_is_recorded_motion() -> None:
    """Neither a row of a recording beside samples of it, nor a scene of which a model was given frames."""
    found = []
    for name in sorted(name for name in tracked(".") if name.endswith(".npz")):
        with np.load(ROOT / name) as arrays:
            words = [str(word) for key in arrays.files if arrays[key].dtype.kind == "U" for word in arrays[key].flat]
            if any(TRUTH in word for word in words) or ("given" in arrays.files and arrays["given"].any()):
                found.append(name)
    assert not found
    assert "docs/evidence/films/" in (ROOT / ".gitignore").read_text()


def tracked(folder: str) -> set[str]:
    """Files under a folder that are part of the repository."""
    words = ["git", "ls-files", folder]
    return set(subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=30, check=True).stdout.split())


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel built of what this tree tracks, and of the answers that are made for it."""
    pytest.importorskip("build")
    pytest.importorskip("hatchling")
    out = tmp_path_factory.mktemp("wheel")
    tree = tmp_path_factory.mktemp("tree")
    for name in [*tracked("magnet"), "pyproject.toml", "README.md", "LICENSE", ".gitignore"]:
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, tree / name)
    for words in ("magnet.cli.all_answers --ship", f"build --wheel --no-isolation --outdir {out}"):
        run = [sys.executable, "-m", *words.split()]
        environment = os.environ | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"}
        done = subprocess.run(run, capture_output=True, text=True, timeout=300, cwd=tree, env=environment)
        assert done.returncode == 0, done.stderr
    (built,) = out.glob("*.whl")
    return built


@pytest.mark.slow
def test_the_wheel_holds_all_of_the_package_but_earlier_models_and_nothing_else(wheel: Path) -> None:
    package = {name for name in tracked("magnet") if not name.startswith("magnet/weights/duet1/")}
    names = set(zipfile.ZipFile(wheel).namelist())
    held = {name for name in names if not name.split("/")[0].endswith(".dist-info")}
    (answers,) = held - package
    assert re.fullmatch(r"magnet/cli/answers-[0-9a-f]{24}\.json", answers)
    assert held - {answers} == package
    assert {"magnet/body/open_body.npz", "magnet/body/OPEN_BODY.md", "magnet/py.typed"} <= held
    assert {"magnet/weights/duet/config.json", "magnet/weights/duet/weights-01.safetensors"} <= held
    assert not [name for name in held if re.search(r"(^|/)tests?/|\.(amc|asf|bvh|pkl|ckpt|glb|mp4)$", name)]
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert wheel.stat().st_size < 50e6


@pytest.mark.slow
@pytest.mark.skipif(bool(entry_points(group="magnet.tasks")), reason="plug-ins are installed")
def test_the_wheel_answers_its_first_help_without_importing_torch(wheel: Path, tmp_path: Path) -> None:
    shutil.unpack_archive(wheel, tmp_path / "site", "zip")
    code = "import sys; from magnet.cli import main; main(sys.argv[1:]); print('torch' in sys.modules)"
    environment = os.environ | {"PYTHONPATH": str(tmp_path / "site"), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    for words in ("fit --help", "data list"):
        run = [sys.executable, "-c", code, *words.split()]
        done = subprocess.run(run, capture_output=True, text=True, timeout=120, cwd=tmp_path, env=environment)
        assert len(done.stdout) > 1000 and done.stdout.endswith("False\n"), done.stderr


@pytest.mark.slow
def test_the_wheel_alone_makes_a_scene(wheel: Path, tmp_path: Path) -> None:
    shutil.unpack_archive(wheel, tmp_path / "site", "zip")
    code = (
        "import magnet; print(magnet.__file__); "
        "scene = magnet.load('duet', steps=2).generate(people=2, frames=12, seed=1); print(scene.save('duet.glb'))"
    )
    run = [sys.executable, "-c", code]
    environment = {"PYTHONPATH": str(tmp_path / "site"), "PATH": "", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(run, capture_output=True, text=True, timeout=120, cwd=tmp_path, env=environment)
    assert done.returncode == 0, done.stderr
    assert str(tmp_path / "site") in done.stdout and (tmp_path / "duet.glb").stat().st_size > 100_000
