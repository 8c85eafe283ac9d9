"""Python code that the pages show runs as it stands, one page after another, with one denoising step."""

from __future__ import annotations

import functools
import pkgutil
import re
import shutil
from pathlib import Path

import pytest

import magnet
from magnet.denoiser.core import DenoiserCore
from magnet.sampling.options import SamplerOptions
from tests.cases import some_slow

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
ELSEWHERE = {
    "from magnet.datamodules.cmu import CMU": "needs CMU's recordings",
    "# magnet_duel/__init__.py": "tests/tasks/test_example.py",
    "# tests/test_duel.py": "tests/tasks/test_example.py",
    "# magnet_duel/waltzes.py": "tests/datamodules/test_example.py",
    "import json, math, struct": "tests/agents/test_processes.py",
}
"""How blocks begin that run in another test, or need what is not here."""


def blocks(page: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def model() -> magnet.api.Model:
    return magnet.load("duet", steps=1)


@pytest.fixture(scope="module")
def made(model, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of the files that pages read."""
    folder = tmp_path_factory.mktemp("made")
    duet = model.generate(people=2, frames=64, seed=0)
    duet.save(folder / "dance.npz")
    for slot, letter in enumerate("AB"):
        one = duet.replace(present=duet.present & (duet.present.cumsum(dim=1) == slot + 1))
        Path(one.save(folder / f"take_{letter}.bvh")).rename(folder / f"take_{letter}.bvh")
    return folder


@pytest.fixture
def files(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The files that pages read lie in the working directory."""
    monkeypatch.chdir(shutil.copytree(made, tmp_path / "here"))


@pytest.mark.parametrize(
    "page",
    some_slow([page for page in PAGES if blocks(page)], ROOT / "docs/viewer.md", ROOT / "docs/export.md"),
    ids=lambda page: page.stem,
)
def test_the_python_of_a_page_runs(page: Path, model, files: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(magnet, "load", lambda *_, **__: model)
    monkeypatch.setattr(DenoiserCore, "load", lambda *_: model.denoiser)
    monkeypatch.setattr("magnet.generation.live.SamplerOptions", functools.partial(SamplerOptions, steps=1))
    here: dict[str, object] = {}
    for block in blocks(page):
        if not any(block.startswith(start) for start in ELSEWHERE):
            exec(compile(block, str(page), "exec"), here)


def exists(name: str) -> bool:
    """Whether a dotted name is a module's, or what hangs on one."""
    try:
        pkgutil.resolve_name(name)
    except (ImportError, AttributeError):
        return False
    return True


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_names_that_a_page_tells_are_there(page: Path) -> None:
    names = set(re.findall(r"(?<![\w/.-])magnet(?:\.[A-Za-z]\w*)+", page.read_text(encoding="utf-8")))
    groups = {"magnet.tasks", "magnet.datamodules"}
    files = {name for name in names if name.rpartition(".")[2] in ("py", "git", "yaml")}
    assert not [name for name in sorted(names - groups - files) if not exists(name)]
