"""The tour notebook runs as it stands, with fewer frames and steps."""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path
from typing import Any

import pytest

TOUR = Path(__file__).parents[1] / "examples" / "tour.ipynb"
FEWER = {"FRAMES": 48, "STEPS": 2}


def cells(kind: str) -> list[str]:
    return ["".join(cell["source"]) for cell in json.loads(TOUR.read_text())["cells"] if cell["cell_type"] == kind]


def run(source: str, space: dict[str, Any]) -> Any:
    """Run a cell; what its last expression gives, as a notebook would show it."""
    tree = ast.parse(source)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, str(TOUR), "exec"), space)
    return None if last is None else eval(compile(ast.Expression(last.value), str(TOUR), "eval"), space)


@pytest.mark.slow
def test_the_tour_runs_from_top_to_bottom(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.chdir(tmp_path)
    space: dict[str, Any] = {}
    shown = []
    for source in cells("code"):
        for name, value in FEWER.items():
            source = re.sub(rf"^{name} = \d+", f"{name} = {value}", source, flags=re.MULTILINE)
        shown.append(run(source, space))
    assert (space["FRAMES"], space["STEPS"]) == (48, 2)
    players = [player for player in shown if hasattr(player, "_repr_html_")]
    assert len(players) == 5 and all("<iframe" in player._repr_html_() for player in players)
    assert space["group"].present.sum() == 4 and space["company"].present.sum() == 2
    said = re.search(r"differ by at most ([\d.]+) mm", capsys.readouterr().out)
    assert said and float(said[1]) < 1
    assert {path.suffix for path in (tmp_path / "tour").iterdir()} >= {".npz", ".glb", ".bvh", ".csv", ".html", ".png"}


def test_the_tour_is_kept_without_outputs_and_shows_every_method():
    notebook = json.loads(TOUR.read_text())
    assert all(not cell.get("outputs") and cell.get("execution_count") is None for cell in notebook["cells"])
    code = "\n".join(cells("code"))
    for method in (
        ".generate(",
        ".continue_(",
        ".inpaint(",
        ".react(",
        ".predict(",
        ".show(",
        ".save(",
        "magnet.read(",
    ):
        assert method in code
    assert "docs/export.md" in "\n".join(cells("markdown"))
