"""Reads flags and suggests what an unknown one may mean, without importing Torch or Lightning."""

from __future__ import annotations

import argparse
import difflib
import itertools
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NoReturn

import yaml

from magnet.cli.named_files import unquoted
from magnet.sampling.presets import PRESETS

Options = dict[str, Any]
NO_WORDS = {"true", "false", "yes", "no", "y", "n", "on", "off", "null", "none", "nan", "inf", "infinity"}
"""What YAML or Python may read as something else than a word."""
CLASS_WORDS = ("help", "class_path", "init_args", "dict_kwargs")


def valued(flags: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Each flag's name and value."""
    for argument, after in pairwise([*flags, ""]):
        name, equals, value = argument.partition("=")
        if name.startswith("--"):
            yield name, value if equals else after


def taken_out(arguments: Sequence[str], named: str) -> tuple[list[list[str]], list[str]]:
    """Flags that begin as a pattern says, as `--task.`, each with its value; and all other words."""
    taken: list[list[str]] = []
    others: list[str] = []
    rest = iter(arguments)
    for word in rest:
        if re.match(named, word):
            taken.append([word] if "=" in word else [word, *itertools.islice(rest, 1)])
        else:
            others.append(word)
    return taken, others


def spec_of(value: Any) -> Options:
    """A class and its options from what stands under a key: a mapping, or the class's name alone."""
    if isinstance(value, str):
        return {"class_path": value}
    return value if isinstance(value, dict) else {}


def flat(options: Options, within: str = "") -> Options:
    """Options of groups as flags name them, `group.option`."""
    found: Options = {}
    for key, value in options.items():
        found |= flat(value, f"{within}{key}.") if isinstance(value, dict) else {f"{within}{key}": value}
    return found


def class_in_flags(flags: Sequence[str], key: str) -> str | None:
    """The class that the last flag to name one names under a key; by a mapping or in a file, too."""
    named = [value for name, value in valued(flags) if name in (f"--{key}", f"--{key}.class_path")]
    value: Any = named[-1] if named else None
    if value and (value.startswith("{") or value.endswith((".yaml", ".yml"))):
        try:
            text = value if value.startswith("{") else Path(value).read_text(encoding="utf-8")
            return spec_of(yaml.safe_load(text)).get("class_path")
        except (OSError, yaml.YAMLError):
            return None  # the parser says what is wrong with it
    return None if value in ("", "null") else value


def refused(command: str, said: str, topic: str = "") -> str:
    """A mistake in a command line, as it is printed; topic: the part of the command's help that tells more."""
    stop = "" if said.endswith("?") else "."
    return f"magnet {command}: error: {said}{stop} See magnet {command} --help {topic}".rstrip()


def plainly(message: str) -> str:
    """argparse's sentence on the value of an option in our own words; any other as it is.

    >>> plainly("argument --unit: invalid choice: 'mm' (choose from 'm', 'cm')")
    '--unit: got mm, expected m or cm'
    """
    match = re.fullmatch(r"argument (?:-\w/)?(--[\w.]+): (.*)", message)
    if match is None:
        return message
    flag, said = match.groups()
    if number := re.fullmatch(r"invalid (int|float) value: '(.*)'", said):
        return f"{flag}: got {number[2]}, expected {'a whole number' if number[1] == 'int' else 'a number'}"
    if choice := re.fullmatch(r"invalid choice: '?(.*?)'? \(choose from (.*)\)", said):
        return f"{flag}: got {choice[1]}, expected {' or '.join(choice[2].replace(chr(39), '').split(', '))}"
    if count := re.fullmatch(r"expected (one|at least one|\d+) arguments?", said):
        what = "one value" if count[1] == "one" else f"{count[1]} value{'s' * (count[1].isdigit())}"
        return f"{flag}: expected {what} behind it"
    return f"{flag}: {said}"


class PlainParser(argparse.ArgumentParser):
    """The parser of a command without a Trainer: nothing abbreviated, and a mistake in one line with what may be meant.

    Args:
        command: its name behind `magnet`.
        description: what it does, printed as it is written.
        epilog: examples, printed as they are written.
        add_help: whether it has --help.
    """

    def __init__(self, command: str, description: str | None, epilog: str | None = None, add_help: bool = True) -> None:
        super().__init__(
            f"magnet {command}",
            description=description,
            epilog=epilog,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
            add_help=add_help,
        )
        self.command = command
        self.elsewhere: dict[str, str] = {}  # options of other commands, and what is to be done instead
        self.topic = ""  # of the command's help that is about this form of it
        self.given: list[str] = []

    def parse_known_intermixed_args(self, args: Any = None, namespace: Any = None) -> Any:
        self.given = []
        for word in sys.argv[1:] if args is None else args:
            if word in ("-x", "-y", "-z") and self.given and self.given[-1].startswith("--"):
                word = f"{self.given.pop()}={word}"  # an axis, which argparse would take for an option
            self.given.append(word)
        return super().parse_known_intermixed_args(self.given, namespace)

    def closest(self, name: str) -> str:
        """A hint at which of its options may be meant."""
        return closest(name, list(self._option_string_actions))

    def error(self, message: str) -> NoReturn:
        unknown = re.search(r"unrecognized arguments: (-\S+)", message)
        name = unknown[1].partition("=")[0] if unknown else ""
        hint = self.closest(name) if unknown else ""
        hint = f"; {elsewhere}" if (elsewhere := self.elsewhere.get(name.partition(".")[0])) else hint
        message = f"no option {name}" if unknown else plainly(message)  # as the commands with a Trainer say it
        said = self.given
        several = [flag for each in self._actions if each.nargs == "+" for flag in each.option_strings if flag in said]
        if message.endswith("required: OUT") and several:
            hint = f"; files stand first, then options, for {several[0]} takes all words behind it"
        print(refused(self.command, message + hint + unquoted(said), self.topic), file=sys.stderr)
        sys.exit(2)


OTHER_NAMES = {
    "seconds": "frames",
    "duration": "frames",
    "length": "frames",
    "output": "out",
    "checkpoint": "ckpt_path",
    "weights": "ckpt_path",
    "agents": "people",
}
"""What other programs call some of our options."""


def closest(name: str, known: Sequence[str]) -> str:
    """A hint at what may be meant: the same field somewhere else (--lr for --model.lr), or a similar name."""
    if (told := of_preset(name, known)) is not None:
        return told
    group, _, leaf = name.rpartition(".")
    flags = [flag for flag in known if not flag.endswith((".help", "+")) and flag != name]
    fields = [flag for flag in flags if flag.startswith(f"{group}.")] if group else flags  # --model.foo: of the model
    by_leaf = {flag.lstrip("-").rsplit(".", 1)[-1]: flag for flag in reversed(fields)}
    leaf = leaf.lstrip("-")
    near = [by_leaf[each] for each in (leaf, OTHER_NAMES.get(leaf, leaf)) if each in by_leaf][:1]
    near = near or [flag for each, flag in by_leaf.items() if leaf in words(each)][:-5:-1]
    near = near or [by_leaf[match] for match in difflib.get_close_matches(leaf, by_leaf, n=1)]
    near = near or difflib.get_close_matches(name, [] if fields else flags, n=1)
    if near:
        return f"; did you mean {' or '.join(near)}?"
    return f"; there are {', '.join(dict.fromkeys(fields))}" if group and fields else ""


def of_preset(name: str, known: Sequence[str]) -> str | None:
    """A hint where an option is meant that says how to sample: a preset is named by `--sampler` itself, and where that
    takes nothing else, it has no fields; else None."""
    if "--sampler" not in known:
        return None
    if name in ("--sampler.preset", "--sampler.name", "--preset"):
        return f"; a preset is named by --sampler PRESET: {' or '.join(PRESETS)}"
    if name.startswith("--sampler.") and not any(flag.startswith("--sampler.") for flag in known):
        own = f"--{name.rpartition('.')[2]}"
        return f"; --sampler takes a preset's name here{f', and there is {own}' if own in known else ''}"
    return None


def words(name: str) -> tuple[str, ...]:
    """What a field may be called in short: each of its words, and their first letters, as `lr`."""
    parts = name.split("_")
    return (*parts, "".join(part[:1] for part in parts))


def help_topic(arguments: Sequence[str]) -> str | None:
    """What help is asked for: `--help TOPIC`, empty for `--help` alone; None where none is."""
    for argument, after in pairwise([*arguments, "-"]):
        name, equals, value = argument.partition("=")
        if name in ("-h", "--help"):
            return value if equals else "" if after.startswith("-") else after
    return None


def chosen_flags(
    actions: Sequence[str], classes: Mapping[str, Mapping[str, Sequence[str]]], chosen: Mapping[str, str]
) -> list[str]:
    """All options that may be meant: the command's `actions`, and those of the classes that are chosen, or may be.

    classes: options of each class, without dashes, by key and short name; chosen: the class under a key, where one is.
    """
    flags = list(actions)
    for key, kinds in classes.items():
        wanted = chosen.get(key)
        for name, options in kinds.items():
            if wanted is None or wanted.rpartition(".")[2] == name:
                flags.extend(f"--{option}" for option in options)
    return flags


def mistake(arguments: Sequence[str], known: Mapping[str, Any]) -> str | None:
    """What is wrong with the first option that nothing here has, or whose value is a word in place of a number; None
    where there is none, or where only the parser can tell: with files, checkpoints and classes of the user's own, and
    for tasks.

    Args:
        arguments: after the command.
        known: `actions` and `classes` as in `chosen_flags`, `chosen` by default, and `values`: what options
            expect that take no words.
    """
    if any(argument.partition("=")[0] in ("-c", "--config", "--ckpt_path") for argument in arguments):
        return None
    named = {key: name for key in known["classes"] if (name := class_in_flags(arguments, key))}
    if any(name not in known["classes"][key] for key, name in named.items()):
        return None
    flags = chosen_flags(known["actions"], known["classes"], {**known["chosen"], **named})
    for argument in arguments:
        name = argument.partition("=")[0].rstrip("+")
        if name[:2] == "--" and name[2:3].isalpha() and not _accepted(name, known):
            return f"no option {name}{closest(name, flags)}"
    for name, value in valued(arguments):
        plain = re.fullmatch(r"[A-Za-z][\w.-]*", value) and value.lower() not in NO_WORDS
        if plain and name in flags and name in known["values"]:
            return f"{name}: got {value}, expected {known['values'][name]}"
    return None


def _accepted(name: str, known: Mapping[str, Any]) -> bool:
    """Whether something takes an option, or may."""
    key, _, rest = name[2:].partition(".")
    if key == "task" or name.endswith("."):
        return True
    if key in known["classes"] and rest:
        field = rest.removeprefix("init_args.").partition(".")[0]
        fields = {option.split(".")[1] for options in known["classes"][key].values() for option in options}
        return field in fields or field in CLASS_WORDS
    told = [flag for flag in known["actions"] if not flag.endswith(".help")]
    open_ones = [flag for flag in told if not any(other.startswith(f"{flag}.") for other in told)]
    return name in told or any(name.startswith(f"{flag}.") for flag in open_ones)
