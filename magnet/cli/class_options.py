"""Options belong to the class that they were given to: what layers say of a class that was replaced is left out.

jsonargparse, by intent (its issue 460), keeps equally named values when another layer names another class: a file's
values, but just as much the first class's own defaults, and those of list elements at the same place. So Synthetic's
defaults became every data set's. Here the class that wins is found first; it is the parser's default, and layers reach
the parser without what they say of others.
"""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import yaml

from magnet.cli.class_names import same_class
from magnet.cli.config_files import Layer
from magnet.cli.flags import Options, class_in_flags, spec_of, valued

KEYS = ("model", "data", "task")
"""Options under which one of several classes stands."""


@dataclass(frozen=True)
class Settled:
    """Layers of which none contradicts a later one in what stands where."""

    layers: tuple[Layer, ...]  # lowest first
    classes: dict[str, str]  # the class that wins under each of KEYS, as it was named; those that somebody names
    notes: tuple[str, ...]  # options of files that are left out, a line each class


def settle(layers: Sequence[Layer], flags: Sequence[str]) -> Settled:
    """Find the classes that win, and remove the options of other classes from each layer.

    layers: lowest first; those without a path are not the user's own. flags: the command line, which beats all layers.
    """
    layers = [replace(layer, options=copy.deepcopy(layer.options)) for layer in layers]
    classes, notes = {}, []
    for key in KEYS:
        specs = [spec_of(layer.options.get(key)) for layer in layers]
        named = [class_in_flags(flags, key), *(spec.get("class_path") for spec in reversed(specs) if spec)]
        winner = next((name for name in named if name), None)
        if winner is not None:
            classes[key] = winner
            notes += _only(layers, specs, key, winner)
    for number, layer in enumerate(layers):
        for later in layers[number + 1 :]:
            _replace(layer.options, later.options)
        for name, value in valued(flags):
            if name.removeprefix("--") not in KEYS:
                _replace_at(layer.options, name.removeprefix("--").split("."), value)
    return Settled(tuple(layers), classes, tuple(notes))


def one_class(flags: Sequence[str]) -> list[str]:
    """The flags with the last of several that name a class under one key, and no other."""
    kept = list(flags)
    for key in KEYS:
        names = (f"--{key}", f"--{key}.class_path")
        places = [i for i, flag in enumerate(kept) if flag.partition("=")[0] in names]
        for i in reversed(places[:-1]):
            del kept[i : i + (1 if "=" in kept[i] else 2)]
    return kept


def spelt_out(value: Any, paths: Mapping[str, str], named: bool = True) -> Any:
    """What stands under `data`, with short names that several classes have as dotted paths.

    value: a name, or a class with its options, or a list of these; named: whether a text here is a class's name.
    """
    if isinstance(value, dict):
        return {key: spelt_out(part, paths, key in ("class_path", "data")) for key, part in value.items()}
    if isinstance(value, list):
        return [spelt_out(part, paths, named) for part in value]
    return paths.get(value, value) if named and isinstance(value, str) else value


def spelt_out_flags(flags: Sequence[str], paths: Mapping[str, str]) -> list[str]:
    """The same for `--data NAME`, `--data.class_path NAME` and mappings and lists on the command line."""

    def text(name: str, value: str) -> str:
        leaf = name.rpartition(".")[2].rstrip("+")
        if not re.match(r"--data[.=+]|--data$", name) or leaf not in ("--data", "data", "class_path"):
            return value
        if value[:1] not in ("{", "["):
            return str(spelt_out(value, paths))
        with suppress(yaml.YAMLError):  # the parser says what is wrong with it
            return json.dumps(spelt_out(yaml.safe_load(value), paths))
        return value

    found: list[str] = []
    for before, word in pairwise(["", *flags]):
        name, equals, value = word.partition("=")
        if word.startswith("--"):
            found.append(f"{name}={text(name, value)}" if equals else word)
        else:
            found.append(text(before, word) if "=" not in before else word)
    return found


def _only(layers: list[Layer], specs: list[Options], key: str, winner: str) -> list[str]:
    """Remove options of other classes from all layers; a note for each file.

    Options without a class belong to the class that lower layers name, or else to any.
    """
    notes, owner = [], None
    for layer, spec in zip(layers, specs, strict=True):
        owner = spec.get("class_path") or owner
        if not spec or owner is None or same_class(owner, winner):
            continue
        del layer.options[key]
        lost = sorted(spec.get("init_args") or {})
        if lost and layer.path:
            to, now = owner.rpartition(".")[2], winner.rpartition(".")[2]
            notes.append(f"{key} is {now}: what {layer.path} gives to {to} is left out ({', '.join(lost)})")
    return notes


def _replace(lower: Options, later: Options) -> None:
    """Remove lists, and options of classes, from a layer where a later layer replaces them."""
    for key in [key for key in lower if key in later]:
        old, new = lower[key], later[key]
        if isinstance(old, dict) and isinstance(new, dict):
            if "class_path" in old and "class_path" in new and not same_class(old["class_path"], new["class_path"]):
                del lower[key]
            else:
                _replace(old, new)
        elif isinstance(old, list) or (isinstance(old, dict) and "class_path" in old):
            del lower[key]


def _replace_at(options: Options, path: list[str], value: str) -> None:
    """The same where a flag puts a whole value: `--trainer.callbacks`, `--data.data`."""
    old: Any = options
    within: Any = options
    for name in path:
        if not isinstance(old, dict):
            return
        within = old if name in old else old.get("init_args")
        if not isinstance(within, dict) or name not in within:
            return
        old = within[name]
    named = old.get("class_path") if isinstance(old, dict) else None
    if isinstance(old, list) or (isinstance(named, str) and not value.startswith("{") and not same_class(named, value)):
        del within[path[-1]]
