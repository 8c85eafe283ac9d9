"""Which data sets exist: ours, and those of installed packages (entry-point group `magnet.datamodules`)."""

from __future__ import annotations

import difflib
import importlib
import importlib.util
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, TypeVar

from lightning.pytorch import LightningDataModule

from magnet.datamodules.reading.recording import Reader

GROUP = "magnet.datamodules"
BUILT_IN = (
    "synthetic",
    "cmu",
    "mixed",
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
    "scenes",
)
"""Our modules, in the order in which they are listed; the first one's data set is the default."""

D = TypeVar("D", bound=type[LightningDataModule])
R = TypeVar("R", bound=type[Reader])


@dataclass(frozen=True)
class RegisteredData:
    """A data set and where it came from.

    Args:
        name: the class's own, which `--data` takes, such as "InterX".
        data: the LightningDataModule.
        origin: "magnet", or the package that brings it and its version.
        combines: it is no data set of its own, but trains on others.
    """

    name: str
    data: type[LightningDataModule]
    origin: str
    combines: bool = False

    @property
    def reader(self) -> type[Reader] | None:
        """How its download is read; None: there is nothing to prepare."""
        return getattr(self.data, "reader", None)


_data: dict[str, RegisteredData] = {}
_readers: dict[str, type[Reader]] = {}
_failures: dict[str, Exception] = {}
_discovered = False


def register_data(origin: str = "magnet", combines: bool = False) -> Callable[[D], D]:
    """Class decorator that makes a LightningDataModule known by its name, and the `reader` that it may have.

    Raises:
        TypeError: no LightningDataModule.
        ValueError: the name is taken by another class.
    """

    def register(data: D) -> D:
        _add(data, origin, combines)
        return data

    return register


def register_reader(kind: R) -> R:
    """Class decorator that makes a reader of downloads known to `magnet data` by its `name`.

    Raises:
        TypeError: no Reader.
        ValueError: the name is taken by another class.
    """
    if not (isinstance(kind, type) and issubclass(kind, Reader)):
        raise TypeError(f"{kind!r} is no Reader; see docs/own.md")
    known = _readers.get(kind.name)
    if known is not None and known is not kind:
        raise ValueError(f"reader name {kind.name} is taken by {known.__module__}.{known.__qualname__}")
    _readers[kind.name] = kind
    return kind


def _add(data: type[LightningDataModule], origin: str, combines: bool = False) -> None:
    if not (isinstance(data, type) and issubclass(data, LightningDataModule)):
        raise TypeError(f"{data!r} is no LightningDataModule; see docs/own.md")
    known = _data.get(data.__name__)
    if known is not None and known.data is not data:
        raise ValueError(f"data set name {data.__name__} is taken by {known.data.__module__}.{data.__name__}")
    entry = RegisteredData(data.__name__, data, origin, combines)
    if entry.reader is not None:
        register_reader(entry.reader)
    _data[entry.name] = entry


def unregister(data: type[LightningDataModule]) -> None:
    """Take a data set and its reader back, such as one that a test has registered."""
    entry = _data.pop(data.__name__)
    if entry.reader is not None:
        del _readers[entry.reader.name]


def discover(again: bool = False) -> None:
    """Load all data sets once. A plug-in that fails is kept in `failures` and hides no other."""
    global _discovered
    if _discovered and not again:
        return
    _discovered = True
    _failures.clear()
    for module in BUILT_IN:
        importlib.import_module(f"magnet.datamodules.{module}")
    for point in entry_points(group=GROUP):
        origin = f"{point.dist.name} {point.dist.version}" if point.dist else point.value
        try:
            _load(point.load(), point.name, origin)
        except Exception as error:  # a stranger's import may raise anything
            _failures[point.name] = error


def _load(data: Any, name: str, origin: str) -> None:
    """A plug-in's class; it may have registered itself with the decorator, which does not know where from."""
    if isinstance(data, type) and data.__name__ != name and issubclass(data, LightningDataModule):
        raise ValueError(f"it names the class {data.__name__}: call the entry point {data.__name__}, too")
    known = _data.get(name)
    if known is not None and known.data is data:
        _data[name] = replace(known, origin=origin)
    else:
        _add(data, origin)


def entries() -> list[RegisteredData]:
    """All data sets, ours first."""
    discover()
    return sorted(_data.values(), key=lambda entry: _rank(entry.data))


def _rank(kind: type) -> int:
    """Ours in the order of `BUILT_IN`, whatever was imported first; others after them."""
    ours = [f"magnet.datamodules.{module}" for module in BUILT_IN]
    return ours.index(kind.__module__) if kind.__module__ in ours else len(ours)


def classes() -> dict[str, type[LightningDataModule]]:
    """Every data set's class by its name; the first is the default."""
    return {entry.name: entry.data for entry in entries()}


def default_path() -> str:
    """Dotted path of the data set that is taken where none is named."""
    data = next(iter(classes().values()))
    return f"{data.__module__}.{data.__name__}"


def failures() -> dict[str, Exception]:
    """Plug-ins that could not be loaded, with the error of each."""
    discover()
    return dict(_failures)


def readers() -> dict[str, type[Reader]]:
    """Every reader of downloads by its name, ours first."""
    discover()
    return dict(sorted(_readers.items(), key=lambda item: _rank(item[1])))


def reader(name: str) -> type[Reader]:
    """The reader of a name.

    Raises:
        ValueError: no such data set, with the closest one; or one that needs no preparing, with what to do instead.
    """
    known = readers()
    if name in known:
        return known[name]
    for entry in entries():
        if entry.name.lower() == name.lower() and entry.reader is None:
            raise ValueError(f"{name} has no files to prepare: {fit_command(entry.name)} trains on it")
    if name in _failures:
        raise ValueError(f"data set {name} failed to load: {_failures[name]!r}") from _failures[name]
    close = difflib.get_close_matches(name.lower(), known, n=1)
    hint = f"did you mean {close[0]}?" if close else f"there are {', '.join(known)}"
    raise ValueError(f"no data set {name!r}; {hint}")


def data_of(kind: type[Reader]) -> str:
    """Name of the data set that trains on a reader's stores; `Prepared`, which trains on any, where it has none."""
    return next((entry.name for entry in entries() if entry.reader is kind), "Prepared")


def fit_command(data: str) -> str:
    """The command that trains on a data set."""
    return f"magnet fit --model Tokenizer --data {data}"


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
