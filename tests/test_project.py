"""The project around the code: what the files at the root promise."""

from __future__ import annotations

import os
import re
import subprocess
import tomllib
from pathlib import Path

from magnet import __version__

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
SOURCES = sorted(
    path
    for pattern in (
        "*.md",
        "*.toml",
        "*.cff",
        "Makefile",
        ".ci/*",
        "configs/**/*",
        "docs/**/*",
        "scripts/**/*",
        "magnet/**/*",
    )
    for path in ROOT.glob(pattern)
    if path.suffix in (".md", ".toml", ".cff", ".yaml", ".py", "") and path.is_file()
)


def named(requirement: str) -> str:
    return re.split(r"[\s\[<>=!~;]", requirement, maxsplit=1)[0].lower()


def test_every_direct_dependency_is_pinned_once_and_without_a_build_tag() -> None:
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    pins = [named(line) for line in lines]
    assert all(re.fullmatch(r"[\w.-]+==[\w.]+", line) for line in lines)
    assert len(pins) == len(set(pins))
    extras = PROJECT["project"]["optional-dependencies"]
    wanted = PROJECT["project"]["dependencies"] + [line for name in extras if name != "bake" for line in extras[name]]
    assert {named(line) for line in wanted} - {"magnet-motion"} <= set(pins)


def test_licensed_extras_are_not_needed_to_run() -> None:
    core = {named(line) for line in PROJECT["project"]["dependencies"]}
    assert not core & {"smplx", "wandb", "anny"}


def test_the_extra_all_holds_every_optional_feature() -> None:
    extras = PROJECT["project"]["optional-dependencies"]
    (everything,) = extras["all"]
    assert set(re.findall(r"\w+", everything.partition("[")[2])) == set(extras) - {"all", "dev", "docs", "bake"}


def test_the_version_is_told_alike_everywhere() -> None:
    assert f"\nversion: {__version__}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"## {__version__}" in (ROOT / "CHANGELOG.md").read_text()


def test_make_explains_every_target() -> None:
    text = (ROOT / "Makefile").read_text()
    targets = re.search(r"^\.PHONY: (.*)$", text, re.M)
    assert targets
    shown = subprocess.run(["make", "-C", ROOT, "help"], capture_output=True, text=True, timeout=30, check=True).stdout
    for target in targets[1].split():
        assert re.search(rf"make {target} +\S", shown), target


def test_make_says_which_python_it_needs(tmp_path: Path) -> None:
    words = ["make", "-C", str(ROOT), "setup", "PYTHON=python2.0", f"VENV={tmp_path / 'venv'}"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert done.returncode != 0
    assert "magnet needs Python 3.11, 3.12 or 3.13" in done.stderr
    assert not (tmp_path / "venv").exists()


def test_the_check_of_changes_runs_the_tests() -> None:
    script = ROOT / ".ci" / "run"
    assert os.access(script, os.X_OK)
    assert {"make check", "make test", "make test-slow", "make docs"} <= set(script.read_text().splitlines())


def test_no_file_knows_the_machine_that_it_was_written_on() -> None:
    places = re.compile(r"(?<![\w.<>-])/(?:work|tmp|root|home|opt)/[\w.-]+")
    found = {str(path.relative_to(ROOT)): places.findall(path.read_text(encoding="utf-8")) for path in SOURCES}
    assert len(found) > 200
    assert not {path: names for path, names in found.items() if names}


def test_each_change_goes_to_one_room_of_three_files_at_most() -> None:
    """CONTRIBUTING's table: every place is there, and what is made is made where it says."""
    table = (ROOT / "CONTRIBUTING.md").read_text().partition("| change |")[2].partition("\n\n")[0]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[2:]]
    assert len(rows) == 15 and sum(bool(made) for _, _, made in rows) >= 5
    for change, where, made in rows:
        places = re.findall(r"`((?:magnet|configs|examples|tests)/[\w/.-]*)`", where)
        assert all((ROOT / place).exists() for place in [*places, *re.findall(r"`(.+?)`", made)]), change
        rooms = {place.split("/")[1] for place in places}
        assert len(places) <= 3 and len(rooms) <= 1 + (change == "SMPL-X's hands"), change
