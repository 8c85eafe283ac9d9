"""The parser behind the command: help that explains every field, and errors in a line."""

from __future__ import annotations

import argparse
import functools
import re
import sys
import types
import typing
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, ClassVar, NoReturn

from jsonargparse import ActionConfigFile, DefaultHelpFormatter, Namespace
from lightning.pytorch.cli import LightningArgumentParser

from magnet.cli.errors import KINDS, wrong_value
from magnet.cli.flags import chosen_flags, class_in_flags, closest, refused
from magnet.cli.lone_numbers import in_lists, lists_of
from magnet.cli.named_files import unquoted
from magnet.cli.option_places import as_key, flat_key, in_files, no_class, place_of, with_place
from magnet.cli.unknown_classes import no_such_class
from magnet.plugins import summary

USAGE = (
    "magnet {command} [--config FILE] [--model NAME] [--model.FIELD VALUE] [--data NAME] [--data.FIELD VALUE] "
    "{more}[--ckpt_path FILE] [--trainer.FIELD VALUE]"
)


OPTIMIZING = ("optimizer", "lr_scheduler")
"""Options of a training that name a class, beside those of every command."""

SHARING = ("model", "data")
"""Their classes have many fields in common, which help tells once. Of a task all fields are told."""

TRAINER = "Customize every aspect of training via flags"
"""Lightning's title over the Trainer's options."""

CKPT_PATH = {
    "fit": "last or a path: the training run to go on with (default: a new one)",
    "validate": "best, last, a path or a model's name (default: the model that comes with the package)",
}
"""What --ckpt_path says in place of Lightning's text, whose title is cut off and whose words mean other things here."""

CANDIDATES = r",\s+known\s+subclasses:\s[^)]*\)"
"""Class paths that jsonargparse lists behind an option; of the Trainer's options they fill a screen."""

GROUP = "Path to a configuration file."
"""What jsonargparse says of an option that stands for a group of others; the group's heading says more."""

REFUSED = r"(?:(?:Option|Key) |does not accept option )'([^']+)'(?: is not (?:accepted|expected)|$|\W)"
NOISE = ("Does not validate", "Subtypes:", "Errors:", "Given value type:", "- Expected a <class 'NoneType'>")


def option(parser: argparse.ArgumentParser, key: str) -> tuple[Any, argparse.Action]:
    """An option that a parser has, `--key`, and before it the group of options that it stands in."""
    groups = [(group, action) for group in parser._action_groups for action in group._group_actions]
    return next((group, action) for group, action in groups if f"--{key}" in action.option_strings)


class Parser(LightningArgumentParser):
    """Knows the classes that can be named under `model`, `data` and `task`, for help and for suggestions."""

    root: ClassVar[Parser | None] = None
    """The parser of the command; the parsers of classes inside it know only their own fields."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **{"allow_abbrev": False, **kwargs})
        self.command = ""
        self.arguments: list[str] = []
        self.classes: dict[str, dict[str, type]] = {}
        self.chosen: Mapping[str, str] = {}
        self.layers: list[str] = []
        self.files: list[str] = []
        self.topic = ""
        self.kind: type | None = None  # of a parser inside: the class whose fields it knows

    def add_class_arguments(self, theclass: Any, nested_key: str | None = None, *args: Any, **kwargs: Any) -> list[str]:
        """As the parser does; remembers the class for what it says of it."""
        if nested_key is None and isinstance(theclass, type):
            self.kind = theclass
        return super().add_class_arguments(theclass, nested_key, *args, **kwargs)

    def parse_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: Namespace | None = None, **kwargs: Any
    ) -> Namespace:
        """Flags over the layers of configuration, of which later ones win."""
        if self.layers:
            namespace = self.get_defaults(skip_validation=True) if namespace is None else namespace
            try:
                for layer in self.layers:
                    ActionConfigFile.apply_config(self, namespace, "config", layer)
            except TypeError as error:
                self.error(str(error), error)
        args = None if args is None else in_lists(args, self._takes_list)
        return super().parse_args(args, namespace, **kwargs)

    def _takes_list(self, flag: str) -> bool:
        """Whether an option of the command, or of a class that is chosen, takes a list of whole numbers."""
        flag = flag.replace(".init_args.", ".", 1)
        key = flag.lstrip("-").partition(".")[0]
        path = self.chosen.get(key) or (self._default_path(key) if key in self.classes else "")
        kind = self.classes.get(key, {}).get(path.rpartition(".")[2])
        return flag in (_lists(key, kind) if kind else lists_of(self._actions))

    def format_help(self, *args: Any, **kwargs: Any) -> str:
        """Options of every run and the list of topics; or the options of one topic; or all of them."""
        if not self.command:
            return super().format_help(*args, **kwargs)
        for key, classes in self.classes.items():
            if self.topic in classes:
                return re.sub(CANDIDATES, ")", _fields_help(key, self.topic, classes[self.topic], set()))
        self.usage = USAGE.format(command=self.command, more="[--task NAME] " if "task" in self.classes else "")
        for key in self.classes:
            self._name_choices(key)
        group, _ = option(self, "ckpt_path")
        group.title, group.description = "the weights", None
        self.explain("ckpt_path", "FILE", CKPT_PATH.get(self.command, CKPT_PATH["validate"]))
        for action in self._actions:
            if action.option_strings and action.option_strings[0].endswith(".help"):
                action.help = argparse.SUPPRESS  # of classes that Lightning brings
        everything = self._action_groups
        shown = sorted(everything, key=lambda group: (group.title or "").startswith(TRAINER))
        if self.topic != "all":
            shown = [group for group in shown if _topic_of(group) == self.topic]
        self._action_groups = shown
        parts = [super().format_help(*args, **kwargs)] if shown else []
        self._action_groups = everything
        if not self.topic:
            parts.append(self._topics())
        for key in self.classes:
            if self.topic in (key, "all"):
                parts += self._classes_help(key, whole=self.topic == "all")
        return re.sub(CANDIDATES, ")", "\n".join(parts))

    def topics(self) -> dict[str, str]:
        """What stands behind `--help`, and what it tells."""
        found = {key: f"the fields of --{key}.FIELD VALUE; of one class alone by its name" for key in self.classes}
        if "task" in self.classes:
            found["sampler"] = "how scenes are sampled"
        return found | {"trainer": "Lightning's Trainer", "all": "everything at once"}

    def _topics(self) -> str:
        width = max(map(len, self.topics()))
        told = self.topics() | ({"files": "FILE...: motion of your own"} if self.command == "predict" else {})
        lines = [f"  magnet {self.command} --help {name:<{width}}  {what}" for name, what in told.items()]
        names = ", ".join(name for classes in self.classes.values() for name in list(classes)[:2])
        return "\n".join(["more help:", *lines, f"  magnet {self.command} --help NAME, such as {names}", ""])

    def _classes_help(self, key: str, whole: bool) -> list[str]:
        """The fields of each class under a key. Of models and data sets, in short: of the first, and what each is."""
        parts: list[str] = []
        shared: set[str] = set()
        for name, kind in self.classes[key].items():
            if key in SHARING and parts and not whole:
                parts.append(f"--{key} {name}: {summary(kind)}")
            else:
                parts.append(_fields_help(key, name, kind, shared if key in SHARING else set()))
        if key in SHARING and not whole:
            parts.append(f"\nThe fields of one of these: magnet {self.command} --help NAME\n")
        return parts

    def _name_choices(self, key: str) -> None:
        """Give a group a heading with the names to choose from, instead of class paths and the base class's text."""
        group, action = option(self, key)
        path = self._default_path(key)
        default = f"; default: {path.rpartition('.')[2]}" if path else ""
        group.title, action.help = f"--{key} NAME", argparse.SUPPRESS
        group.description = f"One of {', '.join(self.classes[key])}{default}. Fields are --{key}.FIELD VALUE."

    def _default_path(self, key: str) -> str:
        """The class under a key where nobody names one, as a dotted path or a task's name; empty if there is none."""
        _, action = option(self, key)
        return (action.default.get("class_path") or action.default["name"]) if action.default else ""

    def explain(self, key: str, value: str, text: str) -> None:
        """Set the help of an option that Lightning or the parser has made."""
        _, action = option(self, key)
        action.metavar, action.help = value, text

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        """Say what is wrong, and the closest thing that would be right."""
        told = self if self.command or Parser.root is None else Parser.root
        lacking = re.search(r"arguments are required: (.+)", message)
        if self is not told and self.kind is not None and lacking:
            message = told.lacks(self.kind.__name__, lacking[1].split(", "))
        said = told.clearer(message)
        print(refused(told.command, said + unquoted(told.arguments)), file=sys.stderr)
        sys.exit(2)

    def lacks(self, kind: str, names: Sequence[str]) -> str:
        """That a class is not given what it has no default for: as flags, where it is the one that a flag names."""
        named = dict(self.chosen) | {key: class_in_flags(self.arguments, key) or "" for key in OPTIMIZING}
        key = next((key for key, path in named.items() if path.rpartition(".")[2] == kind), None)
        needed = " and ".join(f"--{key}.{name}" if key else name for name in names)
        return f"{kind} needs {needed}, which is not given{'' if key else '; it belongs under its init_args'}"

    def clearer(self, message: str) -> str:
        """The parser's message without its internals."""
        if dangling := next((word for word in self.arguments if re.match(r"--[\w.]+\.(=|$)", word)), None):
            return f"no option {dangling.partition('=')[0]}; the name of a field belongs behind the point"
        if bare := re.search(r"argument (?:-\w/)?(--[\w.]+): expected one argument", message):
            behind = pairwise([*self.arguments, "--"])
            short = [flag for flag, after in behind if flag.startswith(bare[1]) and after.startswith("--")]
            return f"{(short or [bare[1]])[0]}: got nothing, expected a value behind it"
        unknown = re.search(r"[Uu]nrecognized arguments: (\S+)", message)
        no_such = re.search(REFUSED, message)
        if unknown and not unknown[1].startswith("-"):
            meant = [f"--{key} {unknown[1]}" for key, classes in self.classes.items() if unknown[1] in classes]
            hint = f"did you mean {meant[0]}?" if meant else "options are written --NAME VALUE"
            return f"got {unknown[1]}, expected an option; {hint}"
        if found := unknown or no_such:
            said = found[1].partition("=")[0]
            name = self._written(said.lstrip("-"), said)
            if not unknown and (told := self._unknown_in_files(said)):
                return told
            return f"no option {name}{self._had_by_others(name) or closest(name, self._flags())}"
        required = re.search(r"(?:required.*?|Key \")\b(model|data)\b", message)
        if required and required[1] in self.classes:
            key = required[1]
            return f"say which {key}: --{key} {' or '.join(self.classes[key])}, or a --config that does"
        named = re.search(r'Parser key "(\w+)"', message)
        path = re.search(r"(?:Expected a dot import path string|Unexpected import path format): (\S+)", message)
        if named and path and named[1] in self.classes:
            return no_class(self.files, self.arguments, named[1], path[1], self.classes[named[1]])
        if told := no_such_class(message, self.files, self.arguments):
            return told
        key = re.search(r'Parser key "([\w.]+)"', message)
        if key and (told := wrong_value(message, self._written(key[1], f"--{key[1]}"))):
            return with_place(self.layers, self.files, self.arguments, told)
        if key and (file := re.search(r"Unable to load config ['\"](.*?)['\"]", message)):
            group = self._written(key[1], f"--{key[1]}")
            return f"{group}: got {file[1]}, expected a YAML file of its fields, or {group}.FIELD VALUE"
        message = re.sub(r"Call to compute_fn of link .* failed: ", "", message)
        lines = [line.strip() for line in message.splitlines() if line.strip()]
        return " ".join(line for line in lines if not line.startswith(NOISE)) or message

    def _unknown_in_files(self, said: str) -> str | None:
        """What is wrong with an option that there is not, where it stands in a file or a list; else None."""
        if self._flag_of(said):
            return None
        within = place_of(self.layers, said)
        flags = self._flags()
        place = in_files(self.files, within[0] if within else said, known={flag.lstrip("-") for flag in flags})
        where = f"{place[0]}: " if place else ""
        if within:
            return f"{where}no option {place[1] if place else within[0]}: {within[1]} has no {said}"
        if place is None:
            return None
        flag = f"--{flat_key(place[1])}"
        return f"{where}no option {place[1]}{self._had_by_others(flag) or as_key(closest(flag, flags))}"

    def _flag_of(self, field: str) -> str | None:
        """The flag that gives a field: `--model.foo` for `foo`."""
        words = [re.match(rf"(--(?:\w+\.)*{re.escape(field)})(?![\w-])", argument) for argument in self.arguments]
        return next((word[1] for word in words if word), None)

    def _written(self, field: str, otherwise: str) -> str:
        """A field as the user wrote it."""
        return self._flag_of(field) or otherwise

    def _had_by_others(self, name: str) -> str:
        """Names another class that has the option; empty if there is none."""
        key, _, field = name.lstrip("-").partition(".")
        classes = self.classes.get(key, {})
        having = [each for each, kind in classes.items() if f"{key}.{field}" in _options(key, kind)] if field else []
        chosen = self.chosen.get(key, "").rpartition(".")[2]
        if not having or chosen in having:
            return ""
        others = f" ({len(having) - 1} more have it)" if len(having) > 1 else ""
        return f" of {chosen or f'this {key}'}; it belongs to another: --{key} {having[0]}{others}"

    def _flags(self) -> list[str]:
        return chosen_flags(self.own_flags(), self.options(self.chosen), self.chosen)

    def own_flags(self) -> list[str]:
        """The command's own options; of predict also the one that, without files, asks for people from nothing."""
        more = ["--people"] if self.command == "predict" else []
        return [flag for action in self._actions for flag in action.option_strings] + more

    def options(self, chosen: Mapping[str, str] | None = None) -> dict[str, dict[str, list[str]]]:
        """Options of each class, or of those that are chosen where one is, by key and short name."""
        wanted = {key: name.rpartition(".")[2] for key, name in (chosen or {}).items()}
        return {
            key: {name: list(_options(key, kind)) for name, kind in classes.items() if wanted.get(key, name) == name}
            for key, classes in self.classes.items()
        }

    def values(self) -> dict[str, str]:
        """What options expect that take numbers, true, false or null alone; of classes where all mean the same."""
        found = {flag: _expected(action) for action in self._actions for flag in action.option_strings}
        for key, classes in self.classes.items():
            for name, text in [item for kind in classes.values() for item in _options(key, kind).items()]:
                found[f"--{name}"] = text if found.get(f"--{name}", text) == text else ""
        return {flag: text for flag, text in found.items() if text}


def _topic_of(group: Any) -> str:
    """The topic of help that a group of options belongs to; empty for what every run has."""
    flags = [flag for action in group._group_actions for flag in action.option_strings]
    return next((name for name in ("trainer", "sampler") if any(flag.startswith(f"--{name}") for flag in flags)), "")


@functools.cache
def _lists(key: str, kind: type) -> frozenset[str]:
    """Options of a class, with dashes, that take a list of whole numbers."""
    parser = LightningArgumentParser()
    parser.add_class_arguments(kind, key, fail_untyped=False)
    return lists_of(parser._actions)


@functools.cache
def _options(key: str, kind: type) -> dict[str, str]:
    """Options of a class, without dashes, and what each expects as `_expected` says it."""
    parser = LightningArgumentParser()
    names = parser.add_class_arguments(kind, key, fail_untyped=False)
    told = {flag: _expected(action) for action in parser._actions for flag in action.option_strings}
    return {name: told.get(f"--{name}", "") for name in names}


def _expected(action: argparse.Action) -> str:
    """What an option expects, in the words of `wrong_value`; empty where it takes more than numbers, truth and null."""
    kind = getattr(action, "_typehint", None) or action.type
    kinds = typing.get_args(kind) if typing.get_origin(kind) in (typing.Union, types.UnionType) else (kind,)
    plain = all(each in (int, float, bool, types.NoneType) for each in kinds)
    return " or ".join(KINDS[each.__name__] for each in kinds) if plain else ""


class ChoicesOnce(DefaultHelpFormatter):
    """Help that names the choices of an option beside its flag, and not as its type again."""

    def _get_type_str(self, action: argparse.Action) -> str | None:
        said: str | None = super()._get_type_str(action)
        return None if said is not None and said.startswith("Literal[") else said


def _fields_help(key: str, name: str, kind: type, shared: set[str]) -> str:
    """Fields of one class as `--key.field`, less those that a class before it has told the same of."""
    parser = LightningArgumentParser(add_help=False, usage=argparse.SUPPRESS, formatter_class=ChoicesOnce)
    parser.add_class_arguments(kind, key, fail_untyped=False)
    told: set[str] = set()
    for action in parser._actions:
        flags = action.option_strings
        if any(flag == f"--{key}" or flag.endswith(".help") for flag in flags) or action.help == GROUP:
            action.help = argparse.SUPPRESS
            continue
        told.add(f"{flags} {action.default!r} {action.help}")
        if f"{flags} {action.default!r} {action.help}" in shared:
            action.help = argparse.SUPPRESS
    more = " (more fields as above)" if told & shared else "" if told else " (no fields)"
    shared |= told
    text = parser.format_help()
    lines = text.splitlines()
    start = next((i for i, line in enumerate(lines) if line.lstrip().startswith("--")), len(lines))
    return f"--{key} {name}: {summary(kind)}{more}\n" + "\n".join(lines[start:]) + "\n"
