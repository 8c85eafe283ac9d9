"""Data sets of others: of installed packages (entry-point group `magnet.datamodules`), or in the working directory."""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path

from lightning.pytorch import LightningDataModule

GROUP = "magnet.datamodules"


@dataclass(frozen=True)
class Plugin:
    """A data set and the package that brings it."""

    name: str
    data: type[LightningDataModule]
    origin: str


@dataclass(frozen=True)
class Found:
    """What installed packages offer; one that fails hides no other."""

    plugins: tuple[Plugin, ...]
    failures: dict[str, Exception]


@cache
def discover() -> Found:
    """Load every entry point of the group, once.

    A name is the class's own, for that is what `--data` takes; anything else is a failure.
    """
    found: list[Plugin] = []
    failures: dict[str, Exception] = {}
    for point in entry_points(group=GROUP):
        try:
            kind = point.load()
            if not (isinstance(kind, type) and issubclass(kind, LightningDataModule)):
                raise TypeError(f"{point.value} is no LightningDataModule; see docs/own.md")
            if kind.__name__ != point.name:
                raise ValueError(f"it names the class {kind.__name__}: call the entry point {kind.__name__}, too")
        except Exception as error:  # a stranger's import may raise anything
            failures[point.name] = error
            continue
        origin = f"{point.dist.name} {point.dist.version}" if point.dist else point.value
        found.append(Plugin(point.name, kind, origin))
    return Found(tuple(found), failures)


def import_local(path: str) -> None:
    """Make `module.Class` known where the module lies in the working directory and Python finds it nowhere else.

    Raises:
        ValueError: there is no such module, or it cannot be imported, or has no such class; says what there is.
    """
    module, _, name = path.rpartition(".")
    top = module.partition(".")[0]
    if not top or module in sys.modules:
        return
    if importlib.util.find_spec(top) is None:
        here = Path.cwd()
        if not ((here / f"{top}.py").is_file() or (here / top).is_dir()):
            raise ValueError(f"{path}: no module {top}, neither installed nor in the working directory {here}")
        if str(here) not in sys.path:
            sys.path.append(str(here))  # last: nothing here takes the place of a package
            importlib.invalidate_caches()
    try:
        kind = importlib.import_module(module)
    except Exception as error:  # a stranger's import may raise anything
        raise ValueError(f"{path}: {module} cannot be imported: {type(error).__name__}: {error}") from error
    if not hasattr(kind, name):
        has = [key for key, value in vars(kind).items() if _is_data(value) and value.__module__ == module]
        file = os.path.relpath(kind.__file__) if kind.__file__ else module
        raise ValueError(f"{path}: {file} has no {name}; its data sets are {', '.join(has) or 'none'}")


def _is_data(value: object) -> bool:
    return isinstance(value, type) and issubclass(value, LightningDataModule)
