"""Configuration files as layers of options: what a file extends, and presets that stand for a sampler's options."""

from __future__ import annotations

import dataclasses
import difflib
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from magnet.cli.errors import CommandError

EXTENDS = "extends"
"""Key under which a file names the files that it changes, relative to itself."""


@dataclass(frozen=True)
class Layer:
    """Options from one file."""

    path: str
    options: dict[str, Any]

    def text(self) -> str:
        """The file's path, or its options as YAML where they are not what the file says."""
        try:
            expanded = with_presets(self.options)
        except CommandError as error:
            raise CommandError(f"{self.path}: {error}" if self.path else str(error)) from error
        if Path(self.path).is_file() and read_yaml(self.path) == expanded:
            return self.path
        return yaml.safe_dump(expanded)


def read_layers(file: str, within: tuple[Path, ...] = ()) -> list[Layer]:
    """A configuration file behind those that it extends, in the order in which later ones win."""
    options = dict(read_yaml(file))
    here = Path(file).resolve()
    if here in within:
        raise CommandError(f"{file} extends itself, by way of {' and '.join(path.name for path in within)}")
    named = options.pop(EXTENDS, [])
    named = [named] if isinstance(named, str) else named
    if not isinstance(named, list) or not all(isinstance(name, str) for name in named):
        raise CommandError(f"{file}: {EXTENDS} is {named!r}, expected a file or a list of files")
    before = [layer for name in named for layer in read_layers(str(Path(file).parent / name), (*within, here))]
    require_classes(file, options)
    return [*before, Layer(file, options)]


def read_yaml(file: str) -> dict[str, Any]:
    """The options in a file."""
    path = Path(file)
    if not path.is_file():
        near = sorted(str(p) for p in path.parent.glob("[!.]*.yaml")) if path.parent.is_dir() else []
        close = difflib.get_close_matches(path.stem, [Path(p).stem for p in near], n=1)
        if close:
            hint = f"; did you mean {path.with_name(close[0])}.yaml?"
        elif near:
            hint = f"; there are {', '.join(near)}"
        else:
            clone = "; configs/ is in a clone of the repository: run it there, or name the file's path in it"
            hint = clone if path.parent.name == "configs" else ""
        raise CommandError(f"no configuration file {file or '(none named)'}{hint}")
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise CommandError(f"{file} is no YAML: {' '.join(str(error).split())}") from error
    if not isinstance(content, dict):
        raise CommandError(f"{file} holds {type(content).__name__}, expected options such as `model:` and `data:`")
    return content


def require_classes(file: str, options: object, place: str = "") -> None:
    """Refuse a class that is not named by a word, and options of one that are no options."""
    groups = options.items() if isinstance(options, dict) else enumerate(options) if isinstance(options, list) else ()
    for key, value in groups:
        where = f"{place}[{key}]" if isinstance(key, int) else f"{place}.{key}".lstrip(".")
        if isinstance(options, dict) and key == "class_path" and not isinstance(value, str):
            raise CommandError(f"{file}: {where} is {value!r}, expected the name of a class")
        if isinstance(options, dict) and key == "init_args" and not isinstance(value, dict | None):
            raise CommandError(f"{file}: {where} is {value!r}, expected options such as `seed: 1`")
        require_classes(file, value, where)


def with_presets(options: dict[str, Any]) -> dict[str, Any]:
    """Options with `sampler: NAME`, or `preset: NAME` among the sampler's, replaced by the preset's values."""
    sampler = options.get("sampler")
    if isinstance(sampler, str) and is_preset(sampler):
        return {**options, "sampler": sampler_preset(sampler)}
    if isinstance(sampler, dict) and "preset" in sampler:
        fields = {key: value for key, value in sampler.items() if key != "preset"}
        return {**options, "sampler": merged(sampler_preset(str(sampler["preset"])), fields)}
    return options


def is_preset(word: str) -> bool:
    """Whether a value of `--sampler` is meant as a preset's name, and not as a file or as options."""
    return re.fullmatch(r"[\w-]+", word) is not None


def sampler_preset(name: str) -> dict[str, Any]:
    """Every sampler option as a preset has it."""
    from magnet.sampling.options import SamplerOptions

    try:
        return dataclasses.asdict(SamplerOptions.preset(name))
    except ValueError as error:
        raise CommandError(str(error)) from error


def merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """One set of options over another, group by group."""
    both = {**below, **above}
    for key in below.keys() & above.keys():
        if isinstance(below[key], dict) and isinstance(above[key], dict):
            both[key] = merged(below[key], above[key])
    return both
