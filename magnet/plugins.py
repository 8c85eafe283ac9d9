"""Classes that are known by name: ours, and those of installed packages, found through an entry-point group."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import sys
import threading
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from magnet.errors import Stopped

VERSIONS: dict[str, str] = {}
"""Of the installed packages whose entry points have been loaded in this process, by the package's name."""


def same_definition(kind: type, other: type) -> bool:
    """Whether two classes are of the same place in a program, which may have run twice."""
    return (kind.__module__, kind.__qualname__) == (other.__module__, other.__qualname__)


@dataclass(frozen=True)
class Registered:
    """A class and where it came from.

    Args:
        name: by which options name it.
        kind: the class.
        origin: "magnet", or the package that brings it and its version.
    """

    name: str
    kind: type
    origin: str


@dataclass(frozen=True)
class Failed:
    """A plug-in that is not there.

    Args:
        name: of its entry point.
        error: what it raised.
        origin: the package that brings it and its version, or the entry point's value.
    """

    name: str
    error: BaseException
    origin: str


class Registry:
    """Classes of one sort by name. Plug-ins that fail to load are kept in `failed`, and hide no other.

    Args:
        what: the sort, for messages, such as "task".
        group: entry-point group of other packages.
        modules: ours; importing them registers their classes.
        check: called with a name and a class; raises TypeError or ValueError where they do not fit the sort.
    """

    def __init__(self, what: str, group: str, modules: Sequence[str], check: Callable[[str, type], None]) -> None:
        self.what, self.group, self.modules, self.check = what, group, modules, check
        self.known: dict[str, Registered] = {}
        self.failed: list[Failed] = []
        self.discovered = False
        self._lock = threading.RLock()  # a plug-in may ask for what there is while it is loaded itself

    def add(self, name: str, kind: type, origin: str) -> None:
        """Make a class known, in place of itself as it was, where its definition runs again (a notebook's cell).

        Raises:
            TypeError: it is not of the sort.
            ValueError: the name is taken by another class.
        """
        self.check(name, kind)
        known = self.known.get(name)
        if known is not None and not same_definition(kind, known.kind):
            raise ValueError(f"{self.what} name {name} is taken by {known.kind.__module__}.{known.kind.__qualname__}")
        self.known[name] = Registered(name, kind, origin)

    def discover(self, again: bool = False, others: Callable[[], None] = lambda: None) -> None:
        """Load all classes, once, then `others`; other threads wait for it. One that was interrupted begins anew."""
        with self._lock:
            if self.discovered and not again:
                return
            self.discovered = True
            try:
                self._load_all()
                others()
            except BaseException:
                self.discovered = False
                raise

    def _load_all(self) -> None:
        self.failed.clear()
        for module in self.modules:
            importlib.import_module(module)
        for point in entry_points(group=self.group):
            origin = f"{point.dist.name} {point.dist.version}" if point.dist else point.value
            names = self.load(point.name, point.load, origin)
            if names and point.dist:
                VERSIONS[point.dist.name] = point.dist.version
            if names and point.name not in names:
                self._warn(point.name, origin, f"names a class that is registered already: use {' or '.join(names)}")
        for each in self.failed:
            if (known := self.known.get(each.name)) is not None:  # which is what the name gives, without a word
                why = f"is not used, {each.name} is of {known.origin}: {told(each.error)}"
                self._warn(each.name, each.origin, why)

    def _warn(self, name: str, origin: str, what: str) -> None:
        warnings.warn(f"entry point {name} of {self.group} ({origin}) {what}", stacklevel=4)

    def load(self, name: str, load: Callable[[], type], origin: str) -> list[str]:
        """Load a plug-in. Its class may have registered itself with a decorator, which does not know the origin.

        Returns:
            The names under which it is known; none where it failed.
        """
        names: list[str] = []

        def loaded() -> None:
            kind = load()
            self.check(name, kind)
            own = [entry.name for entry in self.known.values() if entry.kind is kind] or [name]
            for each in own:
                self.add(each, kind, origin)
            names.extend(own)

        if (error := attempted(loaded)) is not None:
            self.fail(name, error, origin)
        return names

    def fail(self, name: str, error: BaseException, origin: str) -> None:
        """Note why a plug-in is not there, and which package brings it."""
        self.failed.append(Failed(name, error, origin))

    def require_loaded(self, name: str) -> None:
        """Say why a plug-in is not there.

        Raises:
            ValueError: a plug-in of that name, in letters of any case, failed to load, or several did.
        """
        found = [each for each in self.failed if each.name.lower() == name.lower()]
        if found:
            why = "; ".join(f"{told(each.error)} (of {each.origin})" for each in found)
            raise ValueError(f"{self.what} {found[0].name} failed to load: {why}") from found[0].error


def subclasses(base: type) -> list[type]:
    """A class and all that are made of it, each once and behind those that it is made of."""
    found: list[Any] = [base]
    for kind in found:
        found += [each for each in kind.__subclasses__() if each not in found]
    return found


def summary(kind: type) -> str:
    """The first paragraph of what a class says of itself, in one line."""
    return (inspect.getdoc(kind) or "").split("\n\n")[0].replace("\n", " ")


def attempted(call: Callable[[], object]) -> BaseException | None:
    """Run a stranger's code, which may raise anything, even SystemExit. -> what it raised

    Only what stops the whole process goes on: an interrupt, or the signal that ends a command.
    """
    try:
        call()
    except (KeyboardInterrupt, Stopped):
        raise
    except BaseException as error:
        return error
    return None


def told(error: BaseException) -> str:
    """An error's kind and text in one line."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def look_here(module: str) -> bool:
    """Let a module be imported from the working directory, too, if Python finds it nowhere else.

    The command `magnet` does not look there by itself, as `python -m magnet` does.

    Returns:
        Whether there is such a module at all.
    """
    top = module.partition(".")[0]
    if top in sys.modules or importlib.util.find_spec(top) is not None:
        return True
    here = Path.cwd()
    if not ((here / f"{top}.py").is_file() or (here / top).is_dir()):
        return False
    if str(here) not in sys.path:
        sys.path.append(str(here))  # last: nothing here takes the place of a package
        importlib.invalidate_caches()
    return True
