"""Tasks on the command line: `--task NAME --task.FIELD VALUE`, the list of them, and pictures of their plans."""

from __future__ import annotations

import abc
import dataclasses
import inspect
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

from jsonargparse import ArgumentError, ArgumentParser, Namespace

from magnet.tasks import registry
from magnet.version import __version__

ALIASES = "magnet.cli.tasks.aliases"
SHOW_USAGE = "magnet tasks show NAME [--out FILE.png] [--people 2] [--task.FIELD VALUE]"


class NamedTask(abc.ABC):
    """What is sampled: one of the tasks that `magnet tasks` lists."""

    # The parser resolves short names only for imported subclasses of one base. Tasks share no base, and their names
    # are not their classes': each gets a stand-in of its fields under its name, with this as base.

    @abc.abstractmethod
    def schedule(self, grid: Any) -> Any:
        """The task's own."""


def aliases() -> dict[str, type]:
    """One stand-in a task, by the task's name; made on first use, for that is when plug-ins are loaded."""
    if ALIASES not in sys.modules:
        module = ModuleType(ALIASES)
        for entry in registry.entries():
            members = {"__module__": ALIASES, "__qualname__": entry.name, "__doc__": entry.task.__doc__}
            setattr(module, entry.name, type(entry.name, (entry.task, NamedTask), members))
        sys.modules[ALIASES] = module
    return {entry.name: getattr(sys.modules[ALIASES], entry.name) for entry in registry.entries()}


def alias_path(name: str) -> str:
    """Class path of a task's stand-in.

    Raises:
        ValueError: no such task; names the closest one.
    """
    short = name.removeprefix(f"{ALIASES}.")
    registry.get(short)
    return f"{ALIASES}.{short}"


def task_of(config: Namespace) -> Any:
    """The task itself from what was parsed.

    Raises:
        ValueError: no such task.
    """
    options = config.as_dict().get("init_args") or {}
    return registry.get(config.class_path.rsplit(".", 1)[-1])(**options)


def list_tasks(arguments: list[str]) -> int:
    """`magnet tasks`: all tasks, and the plug-ins that failed to load; `magnet tasks show NAME`: its schedule.

    Raises:
        CommandError: neither of these.
    """
    from rich.console import Console
    from rich.padding import Padding
    from rich.text import Text

    from magnet.cli.errors import CommandError

    if arguments[:1] == ["show"]:
        return show_task(arguments[1:])
    arguments = arguments[1:] if arguments[:1] == ["list"] else arguments
    if arguments and arguments[0] not in ("-h", "--help"):
        raise CommandError(f"magnet tasks {arguments[0]}: give nothing, or {SHOW_USAGE}")
    console = Console(highlight=False)
    for entry in registry.entries():
        console.print(Text.assemble((entry.name, "bold cyan"), "  ", (origin(entry), "dim")))
        first = (inspect.getdoc(entry.task) or "").split("\n\n")[0].replace("\n", " ")
        lines = [(str(getattr(entry.task, "formula", "")), "magenta"), (first, ""), (options(entry.task), "green")]
        for line, style in lines:
            console.print(Padding(Text(line, style), (0, 0, 0, 4), expand=False))
        console.print()
    for name, error in registry.failures().items():
        console.print(Text.assemble((name, "bold red"), "  failed to load"))
        console.print(Padding(Text(f"{type(error).__name__}: {error}", "red"), (0, 0, 1, 4), expand=False))
    console.print("magnet tasks show NAME      draw in what order a task removes noise", style="dim")
    console.print("magnet test --task NAME     sample it and measure; magnet predict --task NAME", style="dim")
    return 0


def origin(entry: registry.Registered) -> str:
    """Where a task comes from, with its version."""
    package = entry.task.__module__.partition(".")[0]
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
        value = "(required)" if default is dataclasses.MISSING else as_flag(default)
        flags.append(f"--task.{field.name} {value}")
    return "  ".join(flags) or "no options"


def as_flag(value: Any) -> str:
    """A field's value as one writes it on the command line: tuples in brackets, nothing in quotes."""
    if isinstance(value, tuple | list):
        return f"[{','.join(as_flag(part) for part in value)}]"
    return "null" if value is None else str(value)


# -- magnet tasks show -------------------------------------------------------------------------


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


def show_task(arguments: list[str]) -> int:
    """Draw the noise levels of a task's schedule, to a PNG or the terminal.

    Raises:
        CommandError: no such task or option, or a task that makes no sense at these sizes.
    """
    from rich.console import Console
    from rich.text import Text

    from magnet.cli.errors import CommandError
    from magnet.export.schedule import draw_schedule
    from magnet.export.schedule_terminal import schedule_text
    from magnet.sampling.grid import Grid

    if not arguments or arguments[0].startswith("-"):
        if set(arguments) & {"-h", "--help"}:
            show_parser(None).print_help()
            return 0
        raise CommandError(f"say which task: {SHOW_USAGE}; there are {', '.join(registry.names())}")
    name, *rest = arguments
    try:
        kind = registry.get(name)
    except ValueError as error:
        raise CommandError(str(error)) from error
    task, shown = parse_shown(name, kind, rest)
    sizes = (shown.tokens, shown.people, shown.context, shown.steps, shown.window, shown.stride, shown.pyramid_offset)
    grid = Grid(*sizes, noise_sampling=shown.noise_sampling)
    schedule = task.schedule(grid)
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
    parser = ArgumentParser(prog="magnet tasks show NAME", exit_on_error=False, description="Draw a task's schedule.")
    parser.add_class_arguments(Shown, as_group=False)
    if task is not None:
        parser.add_class_arguments(task, "task")
    return parser


def parse_shown(name: str, task: type, arguments: list[str]) -> tuple[Any, Shown]:
    """The task and the sizes that a command line asks for.

    Raises:
        CommandError: an option that neither has, or a value that does not fit.
    """
    from magnet.cli.errors import CommandError, no_such, wrong_value

    parser = show_parser(task)
    try:
        fields = parser.parse_args(arguments).as_dict()
    except ArgumentError as error:
        message = str(error)
        unknown = re.search(r"(?:[Uu]nrecognized arguments: |Key ')([^\s=']+)", message)
        if not unknown:
            raise CommandError(wrong_value(message) or message) from error
        flags = [flag for action in parser._actions for flag in action.option_strings if flag.startswith("--")]
        known = [flag for flag in flags if not flag.startswith(("--print", "--task.help"))]
        flag = "--" + unknown[1].removeprefix("--")
        raise CommandError(no_such("option", flag, known, f"magnet tasks show {name} --help")) from error
    return task(**fields.get("task", {})), Shown(**{f.name: fields[f.name] for f in dataclasses.fields(Shown)})
