"""Where in configuration files an option lies of a class within a list, such as a data set of `Mixed` or a callback."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml

from magnet.cli.checkpoint_config import class_named, options_of


def place_of(layers: Sequence[str], field: str, got: str | None = None) -> tuple[str, str] | None:
    """The place of an option, such as data.data[1].init_args.speeds, and the class that it was given to.

    Args:
        layers: YAML or files of it.
        field: the option, perhaps with groups before it.
        got: the value that does not fit it; None: the class has no such option.

    Returns:
        None where no class in a list was given it so, or several were.
    """

    def wrong(spec: dict[str, Any]) -> bool:
        said: Any = spec.get("init_args")
        for name in field.split("."):
            if not isinstance(said, dict) or name not in said:
                return False
            said = said[name]
        return str(said) == got if got is not None else field not in _options(spec["class_path"])

    found = {(f"{place}.init_args.{field}", name) for layer in layers for place, name in _listed(_read(layer), wrong)}
    return found.pop() if len(found) == 1 else None


def _read(layer: str) -> Any:
    try:
        return yaml.safe_load(
            Path(layer).read_text(encoding="utf-8") if "\n" not in layer and Path(layer).is_file() else layer
        )
    except (OSError, ValueError, yaml.YAMLError):
        return None


def _listed(options: Any, wrong: Callable[[dict[str, Any]], bool], place: str = "") -> Iterator[tuple[str, str]]:
    """Places and short names of the classes in lists that are wrong; `init_args` of those around them are left out."""
    if isinstance(options, dict):
        for key, value in options.items():
            inside = place if key == "init_args" and "[" not in place else f"{place}.{key}".lstrip(".")
            yield from _listed(value, wrong, inside)
    elif isinstance(options, list):
        for number, value in enumerate(options):
            here = f"{place}[{number}]"
            if isinstance(value, dict) and isinstance(value.get("class_path"), str) and wrong(value):
                yield here, value["class_path"].rpartition(".")[2]
            yield from _listed(value, wrong, here)


def _options(path: str) -> set[str]:
    try:
        return options_of(class_named(path))
    except (ImportError, ValueError):
        return set()


def with_place(layers: Sequence[str], told: str) -> str:
    """The parser's sentence on a value, `--field: got V, expected ...`, with its place where that is in a list."""
    match = re.match(r"--([\w.]+): got (.*?), expected ", told)
    found = match and place_of(layers, match[1], match[2].strip("'\""))
    return told.replace(f"--{match[1]}", found[0], 1) if match and found else told
