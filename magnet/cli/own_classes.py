"""Classes of a user's own: those that a dotted path names, which may lie in the working directory."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Any

import yaml

from magnet.cli.arguments import Arguments
from magnet.cli.class_names import chosen, class_paths
from magnet.cli.errors import CommandError
from magnet.cli.flags import valued
from magnet.plugins import look_here

TAKES_CLASSES = (
    r"--(?:trainer\.(?:accelerator|callbacks|logger|plugins|profiler|strategy)|optimizer|lr_scheduler|data\.data)"
    r"(?:\.class_path)?\+?"
)
"""Flags whose value may be a class's path, or a list of them; `--model` and `--data` are known to `Arguments`."""
DOTTED = r"[^\W\d]\w*(?:\.[^\W\d]\w*)+"


def import_named(given: Arguments) -> None:
    """Import the classes that a user names by a dotted path, also out of the working directory."""
    from magnet.datamodules.registry import import_local

    named = [(f"--{key}", given.class_of(key), key == "data") for key in ("model", "data")]
    for layer in given.layers:
        for key, part in layer.options.items():
            classes = class_paths(part) if key != "task" else ()  # tasks have names of their own
            named += [(layer.path or "a file", path, key == "data") for path in classes]
    named += [(flag, path, False) for flag, path in in_flags(given.flags) if look_here(path) and not chosen(path)]
    for where, path, data in named:
        if path and "." in path:
            try:
                import_local(path, data)
            except ValueError as error:
                raise CommandError(f"{where} {error}") from error


def in_flags(flags: Sequence[str]) -> Iterator[tuple[str, str]]:
    """The dotted paths of classes that flags name, alone, in lists, or as `class_path` of a mapping; after the flag."""
    for name, text in valued(flags):
        value: Any = text
        if text[:1] in ("{", "["):
            with suppress(yaml.YAMLError):  # the parser says what is wrong with it
                value = yaml.safe_load(text)
        said = list(class_paths(value))
        if re.fullmatch(TAKES_CLASSES, name) or name.endswith(".class_path"):
            said += value if isinstance(value, list) else [value]
        yield from ((name, path) for path in said if isinstance(path, str) and re.fullmatch(DOTTED, path))
