"""Answers that need no model, kept from one call to the next: importing Torch and Lightning takes seconds.

What is kept belongs to the code that it was made from: this package, Lightning, the parser and all plug-ins. Where any
of it has changed, everything is made anew; of the package outside the commands and the registries, what functions do
inside says nothing here and may change. `make setup` makes all there are (`python -m magnet.cli.all_answers`), and a
wheel brings those of the code in it, for each Python that they were made with (`make wheel`).
"""

from __future__ import annotations

import ast
import contextlib
import functools
import hashlib
import importlib.util
import json
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from importlib.metadata import EntryPoint, entry_points, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

PLUGINS = ("magnet.tasks", "magnet.datamodules")
VARIABLE = "MAGNET_TASKS"
WIDTHS = (80, 100, 120)
"""Columns that answers are written for: the most that fit into the terminal."""
KEPT = 4
"""Files of answers: of as many versions or copies of the code."""
OUTLINES = "outlines.json"
"""Digests of files' outlines by those of their code: to read 47,000 lines takes a second."""
OURS = Path(__file__).parents[1]
"""Where this package's code lies."""
FRESH = "torch" not in sys.modules
"""Whether this process began with the command; in others what takes long is imported, and registries may be changed."""


def width() -> int:
    """Columns of an answer."""
    columns = shutil.get_terminal_size().columns
    return max((wide for wide in WIDTHS if wide <= columns), default=WIDTHS[0])


def recall(name: str) -> Any:
    """What came with the package or was kept under a name; None where nothing was, or where the code has changed."""
    if not FRESH:
        return None
    brought = any((OURS / "cli").glob("answers-*.json"))  # else there is no need to read all code for its digest
    found = _read(shipped()).get(name) if brought else None
    return _read(place()).get(name) if found is None else found


def keep(answers: dict[str, Any]) -> None:
    """Keep answers, plain values by name, where there is a place to; that there is none is no error."""
    path = place()
    if path is None or not FRESH:
        return
    with contextlib.suppress(OSError):
        _write(path, _read(path) | answers)
        for old in sorted(path.parent.glob("answers-*.json"), key=lambda file: file.stat().st_mtime)[:-KEPT]:
            old.unlink()


def kept(name: str, make: Callable[[], str]) -> str:
    """A text that was kept, or that is made now and kept."""
    name = f"{name} {width()}"
    text = recall(name)
    if text is None:
        with columns(width()):
            text = make()
        keep({name: text})
    return str(text)


def show(name: str, draw: Callable[[Console], bool]) -> None:
    """Print what `draw` puts on a console, or what it put there the last time; it says whether that may be kept."""
    from rich.console import Console

    console = Console(highlight=False, width=width())
    name = f"{name} {console.color_system} {console.encoding} {console.width}"
    text = recall(name)
    if text is None:
        with console.capture() as capture:
            may = draw(console)
        text = capture.get()
        if may:
            keep({name: text})
    sys.stdout.write(text)


@contextlib.contextmanager
def columns(number: int) -> Iterator[None]:
    """Set the width of the terminal for whatever is drawn."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = str(number)
    try:
        yield
    finally:
        if before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = before


def place() -> Path | None:
    """The file of all answers of this code; None where the code cannot be told, as with tasks out of a variable."""
    if os.environ.get(VARIABLE):
        return None
    return folder() / f"answers-{code_digest()}.json"


@functools.cache
def shipped() -> Path | None:
    """The file inside the package of all answers of exactly this code; None where plug-ins may change them."""
    if os.environ.get(VARIABLE) or any(entry_points(group=group) for group in PLUGINS):
        return None
    digest = _packages()
    digest.update("python {}.{}".format(*sys.version_info).encode())
    for file in sorted(OURS.rglob("*.py")):
        digest.update(f"{file.relative_to(OURS)}\n".encode())
        digest.update(file.read_bytes())
    return OURS / "cli" / f"answers-{digest.hexdigest()}.json"


def folder() -> Path:
    """Where everything is kept."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "magnet"


@functools.cache
def code_digest() -> str:
    """Of all code that answers depend on: ours and plug-ins' by their files, packages by their versions."""
    digest = _packages()
    folders = {OURS}
    for group in PLUGINS:
        for point in entry_points(group=group):
            digest.update(f"{point.group} {point.name} {point.value}\n".encode())
            folders |= _home(point)
    before, now = _read(folder() / OUTLINES), {}
    for home in sorted(folders):
        for file in sorted(home.rglob("*.py")) if home.is_dir() else [home]:
            code = file.read_bytes()
            if home == OURS and file.parent.name != "cli" and file.name != "registry.py":
                key = hashlib.blake2b(code, digest_size=12).hexdigest()
                now[key] = before.get(key) or hashlib.blake2b(outline(code).encode(), digest_size=12).hexdigest()
                code = now[key].encode()
            digest.update(f"{file.relative_to(home)}\n".encode())
            digest.update(code)
    if now.keys() != before.keys():
        with contextlib.suppress(OSError):
            _write(folder() / OUTLINES, now)
    return digest.hexdigest()


def outline(code: bytes) -> str:
    """A module's code less what its functions do: their bodies but for docstrings."""
    module = ast.parse(code)
    for node in ast.walk(module):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = node.body[:1] if ast.get_docstring(node, clean=False) is not None else []
    return ast.dump(module)


def _packages() -> hashlib.blake2b:
    """Begins a digest with the versions of the packages that answers depend on."""
    digest = hashlib.blake2b(digest_size=12)
    for package in ("lightning", "jsonargparse"):
        digest.update(f"{package} {version(package)}\n".encode())
    return digest


def _home(point: EntryPoint) -> set[Path]:
    """Where a plug-in's code lies; nothing is imported to find out."""
    spec = importlib.util.find_spec(point.module.partition(".")[0])
    if spec is None:
        return set()
    if spec.submodule_search_locations:
        return {Path(folder) for folder in spec.submodule_search_locations}
    return {Path(spec.origin)} if spec.origin else set()


def _read(path: Path | None) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8")) if path is not None else {}
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _write(path: Path, values: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(f".{os.getpid()}.part")
    part.write_text(json.dumps(values), encoding="utf-8")
    part.replace(path)
