"""Options of `magnet data prepare` and `check`: a reader's own, and what together they ask for."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from magnet.datamodules.preparing.convert import PrepareJob
    from magnet.datamodules.reading.recording import Reader


def besides_reader_options(words: Sequence[str]) -> list[str]:
    """Words that belong to no `--reader.OPTION VALUE` or `--reader.OPTION=VALUE`."""
    found, takes_values = [], False
    for word in words:
        if word.startswith("--"):
            takes_values = word.startswith("--reader.") and "=" not in word
        if not takes_values and not word.startswith("--reader."):
            found.append(word)
    return found


def reader_parser(kind: type[Reader]) -> Any:
    """Options of a data set's reader, from its constructor."""
    from jsonargparse import ArgumentParser

    options = ArgumentParser(prog="magnet data prepare", exit_on_error=False, add_help=False)
    options.add_class_arguments(kind, "reader", skip={"root"})
    return options


def reader_options(kind: type[Reader], words: Sequence[str]) -> dict[str, Any]:
    """What was given of them.

    Raises:
        ValueError: an option that the reader has not, or a value that does not fit.
    """
    from jsonargparse import ArgumentError

    from magnet.cli.errors import wrong_value
    from magnet.cli.flags import closest

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
    from magnet.datamodules import registry
    from magnet.datamodules.preparing.canonicalize import CanonicalizeOptions
    from magnet.datamodules.preparing.convert import PrepareJob, families_of
    from magnet.datamodules.preparing.genders import find_bodies

    options = reader_options(registry.reader(name), given.reader_options)
    if given.body == "open" and given.bodies:
        families = families_of(registry.reader(name))
        given.body = str(find_bodies(given.bodies, families).get("neutral", "open"))
    up: Any = f"+{given.up}" if given.up in ("x", "y", "z") else given.up  # as `magnet export` takes it
    steps = CanonicalizeOptions(min_frames=given.min_frames, up=up, trust_fps=given.trust_fps)
    return PrepareJob(name, root, options, given.body, steps, tuple(given.bodies))
