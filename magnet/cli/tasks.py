"""Tasks on the command line: `--task NAME --task.FIELD VALUE`, the list of them, and pictures of their plans."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from jsonargparse import ArgumentError, ArgumentParser, Namespace

from magnet.checks import require_whole
from magnet.cli.config_files import Layer
from magnet.cli.errors import CommandError, no_such, wrong_value
from magnet.cli.flags import flat, of_preset, taken_out
from magnet.cli.lone_numbers import in_lists, lists_of
from magnet.plugins import Registered, summary, told
from magnet.tasks import Task, registry
from magnet.tasks.base import fault_of, schedule_of
from magnet.version import __version__

if TYPE_CHECKING:
    from rich.console import Console


@dataclasses.dataclass(frozen=True)
class TaskChoice:
    """A task as it was asked for.

    Attributes:
        name: as `magnet tasks` lists it.
        fields: its options, all of them, in plain values.
        asked: the command line names it or one of its options; not so of the default, nor of a file's.
    """

    name: str
    fields: dict[str, Any]
    asked: bool = False

    @property
    def task(self) -> Task:
        """The task itself."""
        return made(registry.get(self.name), self.fields)

    @property
    def spec(self) -> dict[str, Any]:
        """As configuration files have it."""
        return {"name": self.name, **listed(self.fields)}


def named_task(layer: Layer) -> Layer:
    """A file's options with its task as a class and its options, where it says `task: {name: NAME, FIELD: VALUE}`."""
    task = layer.options.get("task")
    if not isinstance(task, dict) or "name" not in task:
        return layer
    spec = {"class_path": task["name"], "init_args": {key: value for key, value in task.items() if key != "name"}}
    return Layer(layer.path, {**layer.options, "task": spec})


def listed(value: Any) -> Any:
    """Tuples as lists, for files."""
    if isinstance(value, dict):
        return {key: listed(part) for key, part in value.items()}
    return [listed(part) for part in value] if isinstance(value, tuple | list) else value


def task_class(name: str) -> type:
    """A task's class by its name."""
    try:
        return registry.get(name)
    except ValueError as error:
        raise CommandError(str(error)) from error


def split_flags(flags: Sequence[str]) -> tuple[list[str], list[str]]:
    """A command line's `--task.FIELD VALUE`, and the rest of it without `--task NAME`."""
    taken, others = taken_out(flags, r"--task([.=]|$)")
    fields: list[str] = []
    for flag, *value in taken:
        if flag.partition("=")[0] not in ("--task", "--task.class_path"):
            fields += [flag.replace("--task.init_args.", "--task.", 1), *value]
    return fields, others


def parse_task(
    name: str, flags: list[str], below: Iterable[Mapping[str, Any]] = (), command: str = "test"
) -> TaskChoice:
    """A task from its flags over options from files (`below`, later ones win); the only way there is to read one.

    command: whose help is named in errors
    """
    kind = task_class(name)
    parser = task_parser(kind)
    return TaskChoice(name, read_fields(parser, flags, below, f"magnet {command} --help").get("task", {}))


def task_parser(kind: type | None, **settings: Any) -> ArgumentParser:
    """A parser that knows the options of one task."""
    parser = ArgumentParser(exit_on_error=False, **settings)
    if kind is not None:
        parser.add_class_arguments(kind, "task")
    return parser


def made(kind: type, fields: Mapping[str, Any]) -> Any:
    """A task of a class from its options in plain values; a dataclass among them is made of its own, too.

    Raises:
        ValueError: its fields contradict each other.
    """
    parser = task_parser(kind)
    return parser.instantiate(parser.parse_object({"task": dict(fields)})).task if fields else kind()


def read_fields(
    parser: ArgumentParser, flags: list[str], below: Iterable[Mapping[str, Any]], more: str
) -> dict[str, Any]:
    """Options from files, overridden by flags."""
    try:
        cfg = parser.get_defaults(skip_validation=True)
        for options in below:
            for key, value in options.items():
                nested = isinstance(value, dict) and isinstance(cfg.get(f"task.{key}"), Namespace)
                for name, part in (flat({key: value}) if nested else {key: value}).items():
                    if f"task.{name}" not in cfg:
                        raise CommandError(unknown_option(parser, f"--task.{name}", more))
                    cfg[f"task.{name}"] = part
        flags = in_lists(flags, lists_of(parser._actions).__contains__)
        return dict(parser.parse_args(flags, namespace=cfg).as_dict())
    except ArgumentError as error:
        message = str(error)
        if missing := re.search(r"arguments are required: (.+)", message):
            needed = " and ".join(f"--{key}" for key in missing[1].split(", "))
            raise CommandError(f"the task needs {needed}; see {more}") from error
        unknown = re.search(r"(?:[Uu]nrecognized arguments: |Key ')([^\s=']+)", message)
        if not unknown:
            raise CommandError(wrong_value(message) or message) from error
        raise CommandError(unknown_option(parser, "--" + unknown[1].removeprefix("--"), more)) from error


def unknown_option(parser: ArgumentParser, flag: str, more: str) -> str:
    """The message for an option that does not exist."""
    flags = [each for action in parser._actions for each in action.option_strings if each.startswith("--")]
    if (hint := of_preset(flag, flags)) is not None:
        return f"no option {flag}{hint}"
    known = [
        each
        for each in flags
        if each not in ("--help", "--task", "--sampler") and not each.startswith(("--print", "--task.help"))
    ]
    return no_such("option", flag, known, more)


def draw_tasks(console: Console) -> bool:
    """All tasks, with what is wrong with one's plan, and the plug-ins that failed to load. -> whether it stays so"""
    from rich.padding import Padding
    from rich.text import Text

    faults = 0
    for entry in registry.entries():
        console.print(Text.assemble((entry.name, "bold cyan"), "  ", (origin(entry), "dim")))
        formula, fields = str(getattr(entry.kind, "formula", "")), options(entry.kind)
        lines = [(formula, "magenta"), (summary(entry.kind), ""), (fields, "green")]
        if (fault := fault_of(entry.kind)) is not None:
            faults += 1
            lines.append((f"cannot be sampled: {fault}", "bold red"))
        for line, style in lines:
            console.print(Padding(Text(line, style), (0, 0, 0, 4), expand=False))
        console.print()
    for lost in registry.failures():
        console.print(Text.assemble((lost.name, "bold red"), "  failed to load  ", (lost.origin, "dim")))
        console.print(Padding(Text(told(lost.error), "red"), (0, 0, 1, 4), expand=False))
    console.print("magnet tasks show NAME      draw in what order a task removes noise", style="dim")
    console.print("magnet test --task NAME     sample it and measure; magnet predict --task NAME", style="dim")
    return not registry.failures() and not faults


def origin(entry: Registered) -> str:
    """Where a task comes from, with its version."""
    package = entry.kind.__module__.partition(".")[0]
    if entry.origin != "magnet":
        return entry.origin
    return f"magnet {__version__}" if package == "magnet" else package  # a stranger's decorator says magnet, too


def options(task: type) -> str:
    """Fields with their defaults, as flags."""
    flags = []
    for field in dataclasses.fields(task):
        default = field.default
        if field.default_factory is not dataclasses.MISSING:
            default = field.default_factory()
        flags += flags_of(f"--task.{field.name}", default)
    return "  ".join(flags) or "no options"


def flags_of(flag: str, value: Any) -> list[str]:
    """A field's value as flags: of a dataclass those of each of its own fields."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        own = dataclasses.fields(value)
        return [each for field in own for each in flags_of(f"{flag}.{field.name}", getattr(value, field.name))]
    return [f"{flag} {'(required)' if value is dataclasses.MISSING else as_flag(value)}"]


def as_flag(value: Any) -> str:
    """A field's value as one writes it on the command line: tuples in brackets, nothing in quotes."""
    if isinstance(value, tuple | list):
        return f"[{','.join(as_flag(part) for part in value)}]"
    return "null" if value is None else str(value)


# -- magnet tasks show -------------------------------------------------------------------------

MOST_TOKENS, MOST_PEOPLE = 10_000, 200
"""That a picture is drawn of."""


@dataclasses.dataclass(frozen=True)
class Shown:
    """What `magnet tasks show` draws a task on.

    Args:
        out: PNG to write; the terminal if left out.
        people: agents P.
        tokens: token steps N, of 4 frames each.
        context: token steps that are given at the start, where the task continues a recording.
        steps: denoising steps of a token; the sampler's default is 16.
        window: token steps that the model sees at once.
        stride: token steps finished before the window moves on.
        pyramid_offset: denoising steps between a token and the next; 0: the tokens of a stride go together. By default
            tasks that can roll do, as in sampling.
        noise_sampling: `joint`: agents at a time step share their level; `independent`: each token has its own.
        moments: rows of the picture at most; denoising steps between them are left out.
        turn: token steps of a turn, where the task leaves it open; `duet` takes turns of 2.
        opening: more denoising steps at the highest noise where nothing is known; `duet` takes 5.
    """

    out: Path | None = None
    people: int = 2
    tokens: int = 14
    context: int = 4
    steps: int = 6
    window: int = 8
    stride: int = 4
    pyramid_offset: int | None = None
    noise_sampling: Literal["joint", "independent"] = "joint"
    moments: int = 16
    turn: int = 1
    opening: int = 0


def show_task(arguments: list[str]) -> int:
    """Draw the noise levels of a task's schedule, to a PNG or the terminal."""
    from rich.console import Console
    from rich.text import Text

    from magnet.export.schedule import draw_schedule
    from magnet.export.schedule_terminal import schedule_text
    from magnet.sampling.grid import Grid

    if not arguments or arguments[0].startswith("-"):
        raise CommandError(f"say which task: magnet tasks show NAME; there are {', '.join(registry.names())}")
    name, *rest = arguments
    kind = task_class(name)
    fields = read_fields(show_parser(kind), rest, (), f"magnet tasks show {name} --help")
    task = made(kind, fields.get("task", {}))
    shown = Shown(**{f.name: fields[f.name] for f in dataclasses.fields(Shown)})
    require_whole("tokens", shown.tokens, most=MOST_TOKENS)
    require_whole("people", shown.people, most=MOST_PEOPLE)
    sizes = (shown.tokens, shown.people, shown.context, shown.steps, shown.window, shown.stride, shown.pyramid_offset)
    grid = Grid(*sizes, noise_sampling=shown.noise_sampling, turn=shown.turn, opening=shown.opening)
    schedule = schedule_of(task, grid)
    formula = str(getattr(task, "formula", ""))
    if shown.out is not None:
        path = draw_schedule(schedule, shown.out, title=name, subtitle=formula, count=shown.moments)
        print(path)
        return 0
    console = Console(highlight=False)
    colour = console.is_terminal and not console.no_color and console.encoding.startswith("utf")
    console.print(Text.assemble((name, "bold"), "  ", (formula, "magenta")), soft_wrap=True)
    console.print(schedule_text(schedule, console.width, colour, shown.moments), soft_wrap=True)
    console.print(f"as a picture: magnet tasks show {name} --out {name}.png", style="dim", soft_wrap=True)
    return 0


def show_parser(task: type | None) -> ArgumentParser:
    """Options of `magnet tasks show`, with those of one task."""
    parser = task_parser(task, prog="magnet tasks show NAME", description="Draw a task's schedule.")
    parser.add_class_arguments(Shown, as_group=False)
    return parser
