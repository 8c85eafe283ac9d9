"""`magnet data list|info|check|fake|prepare|download`: from a download to a store that trains."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from magnet.cli import answers
from magnet.cli.errors import CommandError, no_such
from magnet.cli.flags import PlainParser

if TYPE_CHECKING:
    from rich.console import Console

DESCRIPTION = """\
Prepare, check, describe, fake and download data sets.

  magnet data list                                   who may use each, where to ask, what must lie where
  magnet data list dd100                             the same of one
  magnet data fake interx OUT                        a tiny made-up download, to try everything out
  magnet data check DOWNLOAD_OR_STORE                all assertions, a summary, a picture
  magnet data prepare interx --root DOWNLOAD --out STORE --body SMPLX_NEUTRAL.npz
  magnet data prepare bvh --root FOLDER STORE        recordings of your own: docs/own.md
  magnet data info STORE                             what a store holds
  magnet data download cmu --subjects 60,61 OUT      CMU's free recordings
"""


def main(arguments: Sequence[str]) -> int:
    """`magnet data ...`. Returns the exit code."""
    command, *words = arguments or ["--help"]
    if command in ("-h", "--help"):
        parser().print_help()
        return 0
    if command not in COMMANDS:
        raise CommandError(
            no_such("command", f"data {command}", [f"data {name}" for name in COMMANDS], "magnet data --help")
        )
    # Intermixed, so that OUT may come after options: argparse would take it as left out once another came before them.
    options = command_parser(command)
    known, rest = options.parse_known_intermixed_args(words)
    if wrong := besides_reader_options(rest) if command in ("prepare", "check") else rest:
        folder = "; the folder that is read is --root FOLDER" if command == "prepare" else ""
        name = wrong[0].partition("=")[0]
        no_option = f"no option {name}{options.closest(name)}"
        options.error(no_option if name.startswith("-") else f"got {wrong[0]}, expected an option{folder}")
    known.reader_options = rest
    return show_help(command, known) if known.help else run_of(command)(known)


def parser() -> argparse.ArgumentParser:
    """The commands."""
    whole = argparse.ArgumentParser(
        prog="magnet data", description=DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = whole.add_subparsers(metavar="COMMAND")
    for name, (_, what) in COMMANDS.items():
        commands.add_parser(name, help=what)
    return whole


def command_parser(command: str) -> PlainParser:
    """A command's options."""
    add, what = COMMANDS[command]
    one = PlainParser(f"data {command}", what, add_help=False)
    one.add_argument("-h", "--help", action="store_true", help="show this")
    add(one)
    one.set_defaults(parser=one)
    return one


def show_help(command: str, given: argparse.Namespace) -> int:
    """Help of a command, with a data set's own options where one is named."""
    given.parser.print_help()
    if command in ("prepare", "check") and given.name:

        def options() -> str:
            from magnet.cli.data_options import reader_help

            return reader_help(given.name)

        print(answers.kept(f"data prepare {given.name} help", options), end="")
    return 0


def besides_reader_options(words: Sequence[str]) -> list[str]:
    """Words that belong to no `--reader.OPTION VALUE` or `--reader.OPTION=VALUE`."""
    found, takes_values = [], False
    for word in words:
        if word.startswith("--"):
            takes_values = word.startswith("--reader.") and "=" not in word
        if not takes_values and not word.startswith("--reader."):
            found.append(word)
    return found


def run_of(command: str) -> Callable[[argparse.Namespace], int]:
    """What a command runs."""
    if command == "list":  # its answer is kept, and told again without the code that reads data
        return run_list
    from magnet.cli.data_runs import RUNS

    return RUNS[command]


def run_list(given: argparse.Namespace) -> int:
    def draw(console: Console) -> bool:
        from magnet.cli.data_list import draw_list

        return draw_list(console, given.name)

    answers.show(f"data list {given.name or ''}", draw)
    return 0


# -- options -----------------------------------------------------------------------------------


def add_list(one: argparse.ArgumentParser) -> None:
    one.add_argument("name", nargs="?", help="the data set to tell of; default: all")


def add_info(one: argparse.ArgumentParser) -> None:
    one.add_argument("path", nargs="?", help="a prepared store")


def add_work(one: argparse.ArgumentParser) -> None:
    add = one.add_argument
    add("--body", default="open", help="SMPL-X's or SMPL's file, npz or pkl (register at https://smpl-x.is.tue.mpg.de)")
    bodies = "folder or files of gendered bodies (SMPLX_FEMALE.npz ...) that the shape numbers belong to; people are "
    add("--bodies", nargs="+", action="extend", default=[], help=f"{bodies}expressed in the one --body")
    add("--workers", type=int, default=min(8, os.cpu_count() or 1), help="processes (default: %(default)s)")
    add("--splits", default=None, help="lines NAME SPLIT or JSON, in place of the official splits")
    add("--limit", type=int, default=None, help="largest number of takes per split, to try things out")
    add("--min_frames", type=int, default=30, help="shortest clip kept, at 30 fps (default: %(default)s)")
    add("--up", default=None, help="the files' up axis: x, y, z, or --up=-z (default: the data set's)")
    add("--trust_fps", action="store_true", help="keep people who are too fast or slow for the frame rate")


def add_check(one: argparse.ArgumentParser) -> None:
    one.add_argument("path", nargs="?", help="a prepared store, or the folder of a download")
    one.add_argument("--name", default=None, help="which data set a download is; default: found by its layout")
    one.add_argument("--picture", default=None, help="PNG to write (default: NAME_check.png here); none: no picture")
    add_work(one)


def add_prepare(one: argparse.ArgumentParser) -> None:
    one.add_argument("name", nargs="?", help="of the data set, see magnet data list")
    one.add_argument("place", nargs="?", metavar="OUT", help="the same as --out")
    one.add_argument("--root", help="folder of the download, or of your own recordings")
    one.add_argument("--out", help="folder of the store; run again to go on or to bring it up to date")
    add_work(one)
    one.add_argument("--reader.OPTION", metavar="VALUE", help="an option of the data set: prepare NAME --help")


def add_fake(one: argparse.ArgumentParser) -> None:
    one.add_argument("name", nargs="?", help="of the data set, see magnet data list; cmu as well")
    one.add_argument("out", nargs="?", help="folder to write to; new or empty")
    one.add_argument("--takes", type=int, default=4, help="number of takes (default: %(default)s)")
    one.add_argument("--frames", type=int, default=300, help="frames at 30 fps, DuoBox: of the test part (%(default)s)")
    one.add_argument("--seed", type=int, default=0, help="seed of the motion (default: %(default)s)")


def add_download(one: argparse.ArgumentParser) -> None:
    one.add_argument("name", nargs="?", help="cmu; all others come from their authors only")
    one.add_argument("out", nargs="?", help="folder to write to; run again to go on")
    one.add_argument("--subjects", default="60,61", help="numbers with commas (default: %(default)s, salsa couples)")
    one.add_argument("--base_url", default=None, help="another copy of the site")
    anew = "also take files whose SHA-256 differs from the known one: the site has reissued some"
    one.add_argument("--any_version", action="store_true", help=anew)


COMMANDS: dict[str, tuple[Callable[[argparse.ArgumentParser], None], str]] = {
    "list": (add_list, "data sets: who may use them, where to ask, what must lie where"),
    "info": (add_info, "what a prepared store holds"),
    "check": (add_check, "run all assertions on a store or a download; a summary and a picture"),
    "fake": (add_fake, "write a tiny made-up download in a data set's layout"),
    "prepare": (add_prepare, "turn a download into a store, once"),
    "download": (add_download, "fetch CMU's free recordings"),
}
