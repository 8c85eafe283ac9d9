"""Data sets that `magnet data` knows, by name; their modules are imported when asked for."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from magnet.datamodules.prepared import Prepared
    from magnet.datamodules.reading.recording import Reader


@dataclass(frozen=True)
class Entry:
    """Where a data set's classes are, each as "module:name"."""

    reader: str
    fake: str
    data: str

    def load_reader(self) -> type[Reader]:
        """The subclass of `Reader`."""
        return _load(self.reader)

    def load_fake(self) -> Callable[..., None]:
        """write(out: Path, takes: int = 4, frames: int = 90, seed: int = 0)"""
        return _load(self.fake)

    def load_data(self) -> type[Prepared]:
        """The data set's LightningDataModule."""
        return _load(self.data)


def _entry(module: str, data: str) -> Entry:
    package = "magnet.datamodules"
    return Entry(f"{package}.{module}:{data}Reader", f"{package}.fakes.{module}:write", f"{package}.{module}:{data}")


def _own(module: str, reader: str) -> Entry:
    package = "magnet.datamodules"
    return Entry(
        f"{package}.{module}:{reader}Reader", f"{package}.fakes.{module}:write", f"{package}.prepared:Prepared"
    )


NAMES: dict[str, Entry] = {
    "duobox": _entry("duobox", "DuoBox"),
    "dd100": _entry("dd100", "DD100"),
    "remocap": _entry("remocap", "ReMoCap"),
    "interx": _entry("interx", "InterX"),
    "embody3d": _entry("embody3d", "Embody3D"),
    "interhuman": _entry("interhuman", "InterHuman"),
    "aioz": _entry("aioz", "AIOZ"),
    "hi4d": _entry("hi4d", "Hi4D"),
    "chi3d": _entry("chi3d", "CHI3D"),
    "bvh": _own("bvh", "BVH"),
    "scenes": _own("scenes", "Scenes"),
}
OWN = ("bvh", "scenes")
"""Recordings of a user's own, which any folder of such files may be."""
UNPREPARED = {
    "cmu": (
        "cmu trains without being prepared: the first magnet fit --model Tokenizer --data CMU --data.root FOLDER fits "
        "bodies to its recordings and keeps each in a cache; magnet data check FOLDER does so ahead"
    ),
    "synthetic": "synthetic has no files: magnet fit --model Tokenizer --data Synthetic makes its scenes on the spot",
}
"""Data sets without a reader, and what to do instead."""


def find(name: str) -> Entry:
    """The entry of a name.

    Raises:
        ValueError: no such data set, with the closest one; or one that needs no preparing, with what to do instead.
    """
    if name not in NAMES:
        close = difflib.get_close_matches(name.lower(), NAMES, n=1)
        hint = f"did you mean {close[0]}?" if close else f"there are {', '.join(NAMES)}"
        raise ValueError(UNPREPARED.get(name.lower()) or f"no data set {name!r}; {hint}")
    return NAMES[name]


def _load(path: str) -> Any:
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(module), name)
