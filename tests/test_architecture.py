"""The rooms of the package: imports point down, as docs/architecture.md draws them, and nothing imports in a circle."""

from __future__ import annotations

import ast
import functools
import re
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[1]
DRAWING = ROOT / "docs" / "architecture.md"
GROUND = "ground"


def modules(package: Path) -> dict[str, Path]:
    """Every module of a package by its dotted name."""
    found = {}
    for path in sorted(package.rglob("*.py")):
        parts = path.relative_to(package.parent).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports(module: str, path: Path, known: dict[str, Path]) -> Iterator[str]:
    """Modules of ours that a module imports, wherever in it: in functions and under TYPE_CHECKING too."""
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in known)
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            if base in known:
                whole = {f"{base}.{alias.name}" for alias in node.names}
                yield from whole & known.keys() or {base}


@functools.cache
def arrows(package: Path) -> dict[str, set[str]]:
    """Which modules each module imports."""
    known = modules(package)
    return {module: set(imports(module, path, known)) - {module} for module, path in known.items()}


def drawn() -> tuple[set[str], dict[str, set[str]]]:
    """Files that are the ground, and each room with the rooms that it may use, from top to bottom, as drawn."""
    block = re.search(r"```text\n(.*?)```", DRAWING.read_text(), re.DOTALL)
    assert block, "docs/architecture.md shows no drawing"
    rooms = {}
    for line in block[1].splitlines():
        room, arrow, below = line.partition("->")
        assert arrow, line
        rooms[room.strip()] = set(below.split())
    ground = re.search(r"The ground is ([^.]*)\.\n", DRAWING.read_text().replace("`", ""))
    assert ground, "docs/architecture.md does not say what the ground is"
    return set(re.findall(r"[\w.]+", ground[1].replace(" and ", " "))), rooms


def room_of(module: str, ground: set[str]) -> str:
    """The room that a module lies in: the folder or file under the package; the package itself is `magnet`."""
    name = module.split(".")[1] if "." in module else "magnet"
    return GROUND if name in ground else "cli" if name == "__main__" else name


def between_rooms() -> dict[str, dict[str, set[str]]]:
    """Every arrow between two rooms, with the modules that draw it."""
    ground, rooms = drawn()
    found: dict[str, dict[str, set[str]]] = {room: {} for room in rooms}
    for module, others in arrows(ROOT / "magnet").items():
        room = room_of(module, ground)
        assert room in rooms, f"{module} lies in no room of docs/architecture.md"
        for other in others:
            below = room_of(other, ground)
            if below != room:
                found[room].setdefault(below, set()).add(f"{module} imports {other}")
    return found


def test_the_drawing_shows_every_arrow_of_the_code_and_no_other() -> None:
    _, rooms = drawn()
    for room, below in between_rooms().items():
        more = {each: sorted(why) for each, why in below.items() if each not in rooms[room]}
        assert not more, f"{room}: the code draws arrows that docs/architecture.md does not: {more}"
        assert below.keys() == rooms[room], f"{room}: drawn, but not in the code: {rooms[room] - below.keys()}"


def test_every_arrow_points_down() -> None:
    _, rooms = drawn()
    order = list(rooms)
    for room, below in between_rooms().items():
        for each, why in below.items():
            assert order.index(room) < order.index(each), f"{room} -> {each} points up: {sorted(why)}"


def test_no_module_imports_in_a_circle() -> None:
    try:
        TopologicalSorter(arrows(ROOT / "magnet")).prepare()
    except CycleError as error:
        raise AssertionError(f"a circle: {' -> '.join(error.args[1])}") from None


def test_imports_are_found_wherever_they_stand(tmp_path: Path) -> None:
    """The law above sees what it must: imports that are late, for types alone, relative, or of a whole module."""
    package = tmp_path / "house"
    (package / "room").mkdir(parents=True)
    for name in ("__init__", "cellar", "room/__init__", "room/chair"):
        (package / f"{name}.py").write_text("")
    (package / "roof.py").write_text(
        "from typing import TYPE_CHECKING\nimport os\nif TYPE_CHECKING:\n    from house.cellar import wine\n"
        "def late():\n    from house.room import chair\n"
    )
    (package / "room" / "table.py").write_text("from . import chair\nfrom ..cellar import wine\nimport house.roof\n")
    found = arrows(package)
    assert found["house.roof"] == {"house.cellar", "house.room.chair"}
    assert found["house.room.table"] == {"house.room.chair", "house.cellar", "house.roof"}
    assert not found["house.room.chair"]


if __name__ == "__main__":
    names, layers = drawn()
    seen = between_rooms()
    for layer in layers:
        print(f"{layer:<12} -> {' '.join(sorted(seen[layer], key=list(layers).index))}".rstrip())
