"""Classes by their names, short or dotted: which one is meant, which options it takes, and may it be imported."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterable
from typing import Any

from magnet.plugins import subclasses


def same_class(one: str, other: str) -> bool:
    """Whether two names, short or dotted, mean one class; nothing is imported to find out."""
    if one == other:
        return True
    if "." in one and "." in other:
        parts = [path.rpartition(".") for path in (one, other)]
        here, there = (getattr(sys.modules.get(module), name, None) for module, _, name in parts)
        return here is not None and here is there
    return one.rpartition(".")[2] == other.rpartition(".")[2]


def class_named(path: str) -> type | None:
    """The class of a dotted path, or of the short name of one that is imported."""
    module, _, name = path.rpartition(".")
    if module:
        return getattr(importlib.import_module(module), name, None)
    from lightning.pytorch import LightningDataModule

    return next((kind for kind in subclasses(LightningDataModule) if kind.__name__ == path), None)


def options_of(kind: type | None) -> set[str]:
    """Names of all options of a class, inherited ones included."""
    if kind is None:
        return set()
    from lightning.pytorch.cli import LightningArgumentParser

    parser = LightningArgumentParser()
    return {name.split(".")[1] for name in parser.add_class_arguments(kind, "it", fail_untyped=False)}


def chosen(name: str) -> bool:
    """Whether a class is ours, Lightning's or torch's, or of a module that is imported already."""
    module = name.rpartition(".")[0]
    return module.partition(".")[0] in ("magnet", "lightning", "torch") or module in sys.modules


def class_paths(value: Any) -> Iterable[str]:
    if isinstance(value, dict):
        if isinstance(value.get("class_path"), str):
            yield value["class_path"]
        for part in value.values():
            yield from class_paths(part)
    elif isinstance(value, list):
        for part in value:
            yield from class_paths(part)
