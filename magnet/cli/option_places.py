"""Where in configuration files an option stands: file, line and whole key, also of a class within a list.

The parser tells of an option by its class's own name for it, as `batch_size` of `data.init_args.batch_size`.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import yaml

from magnet.cli.class_names import class_named, options_of
from magnet.cli.flags import valued


def place_of(layers: Sequence[str], field: str, got: str | None = None) -> tuple[str, str] | None:
    """The place of an option, such as data.data[1].init_args.speeds, and the class that it was given to.

    None where no class in a list was given it so, or several were. layers: YAML or files of it; got: the value that
    does not fit it, None: the class has no such option.
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


def in_files(
    files: Sequence[str], field: str, got: str | None = None, known: Collection[str] = ()
) -> tuple[str, str] | None:
    """The file and line in which an option stands, and its whole key there, in the last of the files that has it.

    None where no file has it, or where one has several of the name.

    Args:
        files: of YAML, later ones win.
        field: the option, with as many of the groups before it as are known.
        got: the value that does not fit it; None: there is no such option.
        known: options that there are, as `data.batch_size`, which are not meant.
    """
    end = f".{flat_key(field)}"
    for file in reversed(files):
        found = [
            (f"{file}, line {line}", key)
            for key, line, value in _entries(file)
            if f".{flat_key(key)}".endswith(end)
            and flat_key(key) not in known
            and (got is None or got in _texts(value))
        ]
        if found:
            return found[0] if len(found) == 1 else None
    return None


def flat_key(key: str) -> str:
    """An option's key in a file as flags name it: `data.batch_size` for `data.init_args.batch_size`."""
    return re.sub(r"\.init_args(?=[.\[]|$)", "", key)


def as_key(flags: str) -> str:
    """A text in which flags are named, as `--data.batch_size`, with their keys in a file instead."""
    return re.sub(r"--(?!help\b)(?:(model|data)\.)?", lambda match: f"{match[1]}.init_args." if match[1] else "", flags)


def _entries(file: str) -> Iterator[tuple[str, int, yaml.Node]]:
    """Each option in a file: its whole key, the line of that, and what stands behind it."""
    try:
        yield from _within(yaml.compose(Path(file).read_text(encoding="utf-8"), yaml.SafeLoader), "")
    except (OSError, ValueError, yaml.YAMLError):
        return


def _within(node: yaml.Node | None, place: str) -> Iterator[tuple[str, int, yaml.Node]]:
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            here = f"{place}.{key.value}".lstrip(".")
            yield here, key.start_mark.line + 1, value
            yield from _within(value, here)
    elif isinstance(node, yaml.SequenceNode):
        for number, value in enumerate(node.value):
            yield from _within(value, f"{place}[{number}]")


def _texts(value: yaml.Node) -> tuple[str, ...]:
    """How the parser may write a value."""
    read = str(yaml.safe_load(yaml.serialize(value, Dumper=yaml.SafeDumper)))
    if not isinstance(value, yaml.ScalarNode):
        return (read,)
    with suppress(ValueError):  # `1e9` is a word to YAML and a number to the parser
        return (read, value.value, str(float(value.value)))
    return (read, value.value)


def with_place(layers: Sequence[str], files: Sequence[str], flags: Sequence[str], told: str) -> str:
    """The parser's sentence on a value, `--field: got V, expected ...`, with where it stands in a file or a list.

    A value that a flag gives needs no place. layers: YAML or files of it, among which are the user's own files
    """
    match = re.match(r"--([\w.]+): got (.*?), expected ", told)
    if match is None:
        return told
    field, got = match[1], match[2].strip("'\"")
    if any(f".{name.lstrip('-')}".endswith(f".{field}") and value.strip("'\"") == got for name, value in valued(flags)):
        return told
    if found := in_files(files, field, got):
        return told.replace(f"--{field}", ": ".join(found), 1)
    place = place_of(layers, field, got)
    return told.replace(f"--{field}", place[0], 1) if place else told


def no_class(
    files: Sequence[str],
    flags: Sequence[str],
    key: str,
    name: str,
    known: Collection[str],
    paths: Mapping[str, str] | None = None,
) -> str:
    """Says that there is no such class, with its place where a file names it, and what may be meant.

    key: what the class is: model, data or callback
    known: short names that there are; `paths` has the dotted paths of those that are known by no other name
    """
    given = any(value.strip("'\"") == name for _, value in valued(flags))
    found = None if given else in_files(files, "class_path", name) or in_files(files, key, name)
    written = {**(paths or {}), **{each: each for each in known}}
    close = difflib.get_close_matches(name.rpartition(".")[2], written, n=1)
    there = f"there are {', '.join(written.values())}, or give a dotted path of your own"
    hint = f"did you mean {written[close[0]]}?" if close else there
    return f"{': '.join(found)}: no {key} {name}; {hint}" if found else f"no {key} {name}; {hint}"


def of_task(files: Sequence[str], flags: Sequence[str], told: str) -> str:
    """A sentence on a task, its option or a value, such as `no option --task.FIELD`, with its place in a file."""
    given = {name for name, _ in valued(flags)}  # which files do not change
    if unknown := re.match(r"no task named (\w+)", told):
        if given & {"--task", "--task.class_path"}:
            return told
        keys = (("task.class_path", None), ("task", unknown[1]), ("task.name", unknown[1]))
        found = next(filter(None, (in_files(files, key, got) for key, got in keys)), None)
        return f"{': '.join(found)}: {told}" if found else told
    option = re.match(r"no option --(task\.\w+)", told)
    if option is None:
        return with_place((), files, flags, told)
    found = None if f"--{option[1]}" in given else in_files(files, option[1])
    return f"{found[0]}: {as_key(told)}" if found else told
