"""Make every answer that `magnet.cli.answers` keeps, so that the first call is quick, too."""

from __future__ import annotations

import contextlib
import io
import os

from magnet.cli import answers, data, task_list  # isort: split

from magnet.cli.main import TRAINER_COMMANDS
from magnet.cli.train import help_answers


def make_all() -> None:
    """Make every answer that needs no argument, for every width, with and without colours."""
    for colours in ({}, {"FORCE_COLOR": "1", "TERM": "xterm-256color"}, {"COLORTERM": "truecolor"}):
        os.environ |= colours  # from none to all
        for number in answers.WIDTHS:
            with answers.columns(number), contextlib.redirect_stdout(io.StringIO()):
                task_list.main([])
                task_list.main(["show", "--help"])
                data.main(["list"])
    for command in TRAINER_COMMANDS:
        answers.keep(help_answers(command))


if __name__ == "__main__":
    make_all()
