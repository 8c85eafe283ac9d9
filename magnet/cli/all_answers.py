"""Make every answer that `magnet.cli.answers` keeps, so that the first call is quick, too.

python -m magnet.cli.all_answers           # into the user's cache
python -m magnet.cli.all_answers --ship    # into the package, for a wheel or an image
"""

from __future__ import annotations

import contextlib
import io
import os
import sys
import tempfile
from importlib.metadata import entry_points

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


def ship() -> None:
    """Make every answer anew and put them into the package.

    Raises:
        SystemExit: plug-ins are installed, whose names would be among the answers.
    """
    path = answers.shipped()
    if path is None or any(entry_points(group=group) for group in answers.PLUGINS):
        sys.exit(
            f"answers of the package alone cannot be made where {answers.VARIABLE} is set or plug-ins are installed"
        )
    path.unlink(missing_ok=True)
    with tempfile.TemporaryDirectory() as cache:
        os.environ["XDG_CACHE_HOME"] = cache
        make_all()
        made = answers.place()
        assert made is not None
        path.write_bytes(made.read_bytes())
    print(path)


if __name__ == "__main__":
    ship() if sys.argv[1:] == ["--ship"] else make_all()
