"""Answers that need no model, kept from one call to the next: importing Torch and Lightning takes seconds.

Kept answers belong to exactly the code that made them: this package, Lightning, the parser, Python and all plug-ins.
Where any of it has changed, everything is made anew. `make setup` makes all there are (`python -m
magnet.cli.all_answers`), and a wheel brings those of its own code, for each Python that made them (`make wheel`).
"""

from __future__ import annotations

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
    found = _read(shipped()).get(name)
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
    cache = folder()
    return None if cache is None or os.environ.get(VARIABLE) else cache / f"answers-{code_digest()}.json"


def shipped() -> Path | None:
    """The file of all answers of this code inside the package, where it is found while no plug-in changes them."""
    return None if os.environ.get(VARIABLE) else OURS / "cli" / f"answers-{code_digest()}.json"


def folder() -> Path | None:
    """Where everything is kept; None for a user without a home, such as one that a container knows by number alone."""
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "magnet"
    except RuntimeError:
        return None


@functools.cache
def code_digest() -> str:
    """Of all code that answers depend on: ours and plug-ins' by their files, packages and Python by their versions."""
    digest = hashlib.blake2b("python {}.{}\n".format(*sys.version_info).encode(), digest_size=12)
    for package in ("lightning", "jsonargparse"):
        digest.update(f"{package} {version(package)}\n".encode())
    folders = {OURS}
    for group in PLUGINS:
        for point in entry_points(group=group):
            of = f" {point.dist.name} {point.dist.version}" if point.dist else ""
            digest.update(f"{point.group} {point.name} {point.value}{of}\n".encode())
            folders |= _home(point)
    for home in sorted(folders):
        for file in sorted(home.rglob("*.py")) if home.is_dir() else [home]:
            digest.update(f"{file.relative_to(home)}\n".encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()


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
