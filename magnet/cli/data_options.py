"""Options of `magnet data prepare` and `check`: a reader's own, and what together they ask for."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

from jsonargparse import ArgumentError, ArgumentParser

from magnet.cli.errors import wrong_value
from magnet.cli.flags import closest
from magnet.datamodules import registry
from magnet.datamodules.preparing.canonicalize import CanonicalizeOptions
from magnet.datamodules.preparing.convert import PrepareJob, families_of
from magnet.datamodules.preparing.genders import find_bodies
from magnet.datamodules.reading.recording import Reader


def reader_parser(kind: type[Reader]) -> ArgumentParser:
    """Options of a data set's reader, from its constructor."""
    options = ArgumentParser(prog="magnet data prepare", exit_on_error=False, add_help=False)
    options.add_class_arguments(kind, "reader", skip={"root"})
    return options


def reader_options(kind: type[Reader], words: Sequence[str]) -> dict[str, Any]:
    """What was given of them."""
    options = reader_parser(kind)
    known = [f for a in options._actions for f in a.option_strings if f.startswith("--reader.")]
    for word in words:
        name = word.partition("=")[0]
        if word.startswith("--reader.") and not any(name == each or name.startswith(f"{each}.") for each in known):
            hint = closest(name, known) or f"; its options are {', '.join(known) or 'none'}"
            raise ValueError(f"{kind.title}: no option {name}{hint}")
    try:
        config = options.parse_args(list(words)).as_dict().get("reader", {})
    except ArgumentError as error:
        said = wrong_value(str(error)) or str(error)
        raise ValueError(f"{kind.title}: {said}; its options are {', '.join(known) or 'none'}") from error
    flags = {word.split("=")[0].removeprefix("--reader.") for word in words if word.startswith("--reader.")}
    return {name: value for name, value in config.items() if name in flags}


def job_of(given: argparse.Namespace, name: str, root: str) -> PrepareJob:
    """What is to be prepared or checked, and how. Without --body, the body is the neutral one of --bodies."""
    options = reader_options(registry.reader(name), given.reader_options)
    if given.body == "open" and given.bodies:
        families = families_of(registry.reader(name))
        given.body = str(find_bodies(given.bodies, families).get("neutral", "open"))
    up: Any = f"+{given.up}" if given.up in ("x", "y", "z") else given.up  # as `magnet export` takes it
    steps = CanonicalizeOptions(min_frames=given.min_frames, up=up, trust_fps=given.trust_fps)
    return PrepareJob(name, root, options, given.body, steps, tuple(given.bodies))


def reader_help(name: str) -> str:
    """Options of a data set's own; nothing where there is no such data set."""
    kind = registry.readers().get(name)
    return "" if kind is None else f"\noptions of {kind.title}:\n\n{reader_parser(kind).format_help()}"
