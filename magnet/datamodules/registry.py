"""Which data sets exist: ours, and those of installed packages (entry-point group `magnet.datamodules`)."""

from __future__ import annotations

import difflib
import importlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar, get_args

from lightning.pytorch import LightningDataModule

from magnet.datamodules.reading.recording import Family, Reader
from magnet.plugins import Failed, Registered, Registry, attempted, look_here, same_definition, subclasses, told

BUILT_IN = (
    "synthetic",
    "cmu",
    "mixed",
    "reshaped",
    "solo_pairs",
    "prepared",
    "duobox",
    "dd100",
    "remocap",
    "interx",
    "embody3d",
    "interhuman",
    "aioz",
    "hi4d",
    "chi3d",
    "bvh",
    "glb",
    "scenes",
)
"""Our modules, in the order in which they are listed; the first one's data set is the default."""

D = TypeVar("D", bound=type[LightningDataModule])
R = TypeVar("R", bound=type[Reader])


def _check(name: str, data: type) -> None:
    if not _is_data(data):
        raise TypeError(f"{data!r} is no LightningDataModule; see docs/own.md")
    if data.__name__ != name:
        raise ValueError(f"it names the class {data.__name__}: call the entry point {data.__name__}, too")
    if (kind := reader_of(data)) is not None:
        _check_reader(kind)


def _check_reader(kind: type) -> None:
    if not (isinstance(kind, type) and issubclass(kind, Reader)):
        raise TypeError(f"{kind!r} is no Reader; see docs/own.md")
    if wrong := _wrong_parts(kind):
        raise TypeError(f"reader {kind.__module__}.{kind.__qualname__} {' and '.join(wrong)}; see docs/own.md")
    for known in _known_readers():
        if known.name == kind.name and not same_definition(kind, known):
            raise ValueError(f"reader name {kind.name} is taken by {known.__module__}.{known.__qualname__}")


def _wrong_parts(kind: type[Reader]) -> list[str]:
    """What a reader lacks that the list of data sets shows, or that preparing calls."""
    texts = {name: getattr(kind, name, None) for name in ("name", "title", "source", "licence")}
    wrong = [f"has no {name}" for name, text in texts.items() if not (isinstance(text, str) and text)]
    wrong += [f"has no {method}()" for method in sorted(kind.__abstractmethods__)]
    if kind.family not in get_args(Family):
        wrong.append(f"has the family {kind.family!r}, expected {' or '.join(get_args(Family))}")
    if not (isinstance(kind.layout, tuple | list) and all(_is_place(place) for place in kind.layout)):
        wrong.append(f"has the layout {kind.layout!r}, expected pairs such as ((PATTERN, WHAT IT IS),)")
    return wrong


def _is_place(value: object) -> bool:
    return isinstance(value, tuple | list) and len(value) == 2 and all(isinstance(part, str) for part in value)


DATA = Registry("data set", "magnet.datamodules", [f"magnet.datamodules.{module}" for module in BUILT_IN], _check)
_readers: list[type[Reader]] = []  # of no data set of their own
_combining: set[type] = set()  # that train on other data sets


def register_data(origin: str = "magnet", combines: bool = False) -> Callable[[D], D]:
    """Class decorator that registers a LightningDataModule by its name, and its `reader` if it has one.

    Raises:
        TypeError: no LightningDataModule, or its reader lacks a part.
        ValueError: the name is taken by another class.
    """

    def register(data: D) -> D:
        DATA.add(data.__name__, data, origin)
        if combines:
            _combining.add(data)
        return data

    return register


def register_reader(kind: R) -> R:
    """Class decorator that registers a reader of downloads for `magnet data` by its `name`.

    Raises:
        TypeError: no Reader, or one that lacks a part; names it.
        ValueError: the name is taken by another class.
    """
    _check_reader(kind)
    _readers.append(kind)
    return kind


def reader_of(data: type) -> type[Reader] | None:
    """The reader of a data set's download; None: there is nothing to prepare."""
    return getattr(data, "reader", None)


def _known_readers() -> list[type[Reader]]:
    own = [reader_of(entry.kind) for entry in DATA.known.values()]
    return [*_readers, *(kind for kind in own if kind is not None)]


def unregister(data: type[LightningDataModule]) -> None:
    """Remove a data set and its reader, such as one that a test has registered."""
    del DATA.known[data.__name__]


def discover(again: bool = False) -> None:
    """Load all data sets, once."""
    DATA.discover(again)


def entries() -> list[Registered]:
    """All data sets, ours first."""
    discover()
    return sorted(DATA.known.values(), key=lambda entry: _rank(entry.kind))


def unprepared() -> list[Registered]:
    """Data sets that train without being prepared and combine no others, ours first."""
    return [entry for entry in entries() if reader_of(entry.kind) is None and entry.kind not in _combining]


def _rank(kind: type) -> int:
    """Ours in the order of `BUILT_IN`, whatever was imported first; others after them."""
    return DATA.modules.index(kind.__module__) if kind.__module__ in DATA.modules else len(DATA.modules)


def classes() -> dict[str, type[LightningDataModule]]:
    """Every data set's class by its name; the first is the default."""
    return {entry.name: entry.kind for entry in entries()}


def doubtful() -> dict[str, str]:
    """Dotted paths of data sets whose short name another class has, too, such as one that was refused for it.

    A refused class is imported all the same, and a parser that looks through subclasses finds both.
    """
    found = subclasses(LightningDataModule)
    return {
        name: f"{kind.__module__}.{kind.__qualname__}"
        for name, kind in classes().items()
        if any(other.__name__ == name and other is not kind for other in found)
    }


def default_path() -> str:
    """Dotted path of the data set that is taken where none is named."""
    data = next(iter(classes().values()))
    return f"{data.__module__}.{data.__name__}"


def failures() -> list[Failed]:
    """Plug-ins that could not be loaded, with the error of each."""
    discover()
    return list(DATA.failed)


def readers() -> dict[str, type[Reader]]:
    """Every reader of downloads by its name, ours first."""
    discover()
    return {kind.name: kind for kind in sorted(_known_readers(), key=_rank)}


def reader(name: str) -> type[Reader]:
    """The reader of a name: its own, or that of the data set that trains on its stores, in letters of any case.

    Raises:
        ValueError: no such data set, with the closest one; or one that needs no preparing, with what to do instead.
    """
    known = readers()
    if name in known:
        return known[name]
    for entry in entries():
        if entry.name.lower() == name.lower():
            kind = reader_of(entry.kind)
            if kind is not None:
                return kind
            raise ValueError(f"{name} has no files to prepare: {fit_command(entry.name)} trains on it")
    DATA.require_loaded(name)
    close = difflib.get_close_matches(name.lower(), known, n=1)
    by_suffix = [one for one, kind in known.items() if f".{name.lower()}" in getattr(kind, "suffixes", ())]
    hint = f"did you mean {close[0]}?" if close else f"there are {', '.join(known)}"
    hint = f"{' and '.join(by_suffix)} reads such files" if by_suffix else hint
    names = dict.fromkeys(each.name for each in DATA.failed)
    failed = f" ({', '.join(names)} failed to load: magnet data list says why)" if names else ""
    raise ValueError(f"no data set {name!r}; {hint}{failed}")


def data_of(kind: type[Reader]) -> str:
    """Name of the data set that trains on a reader's stores; `Prepared`, which trains on any, where it has none."""
    return next((entry.name for entry in entries() if reader_of(entry.kind) is kind), "Prepared")


def fit_command(data: str) -> str:
    """The command that trains on a data set."""
    return f"magnet fit --model Tokenizer --data {data}"


def import_local(path: str, data: bool = True) -> None:
    """Import the module of `module.Class`, also from the working directory if Python finds it nowhere else.

    data: whether a data set is meant, and not a model or a callback.

    Raises:
        ValueError: there is no such module, or it cannot be imported, or has no such class; says what there is.
    """
    module, _, name = path.rpartition(".")
    top = module.partition(".")[0]
    if not top or module in sys.modules:
        return
    if not look_here(module):
        raise ValueError(f"{path}: no module {top}, neither installed nor in the working directory {Path.cwd()}")
    if (error := attempted(lambda: importlib.import_module(module))) is not None:
        raise ValueError(f"{path}: {module} cannot be imported: {told(error)}") from error
    kind = sys.modules[module]
    if not hasattr(kind, name):
        has = [key for key, value in vars(kind).items() if _is_data(value) and value.__module__ == module]
        file = os.path.relpath(kind.__file__) if kind.__file__ else module
        close = [] if data else difflib.get_close_matches(name, vars(kind), n=1)
        may_be = f"; did you mean {module}.{close[0]}?" if close else ""
        raise ValueError(
            f"{path}: {file} has no {name}" + (f"; its data sets are {', '.join(has) or 'none'}" if data else may_be)
        )


def _is_data(value: object) -> bool:
    return isinstance(value, type) and issubclass(value, LightningDataModule)
