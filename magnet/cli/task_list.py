"""`magnet tasks`: what there is, without importing what tasks are made of where that was told before."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from magnet.cli import answers
from magnet.cli.errors import CommandError

if TYPE_CHECKING:
    from rich.console import Console

SHOW_USAGE = "magnet tasks show NAME [--out FILE.png] [--people 2] [--task.FIELD VALUE]"
HELP = ("-h", "--help")


def main(arguments: Sequence[str]) -> int:
    """`magnet tasks`: all tasks, and the plug-ins that failed to load; `magnet tasks show NAME`: its schedule."""
    command, *rest = arguments or ["list"]
    if command == "show":
        if rest[:1] and rest[0] in HELP:
            print(answers.kept("tasks show help", _show_help), end="")
            return 0
        from magnet.cli.tasks import show_task

        return show_task(rest)
    if command not in ("list", *HELP) or (rest and rest[0] not in HELP):
        raise CommandError(f"magnet tasks {command}: give nothing, or {SHOW_USAGE}")
    answers.show("tasks", _draw)
    return 0


def _draw(console: Console) -> bool:
    from magnet.cli.tasks import draw_tasks

    return draw_tasks(console)


def _show_help() -> str:
    from magnet.cli.tasks import show_parser

    return show_parser(None).format_help()
