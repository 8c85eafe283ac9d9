"""`magnet data list|info|check|fake|prepare|download`: from a download to a store that trains."""

from __future__ import annotations

import argparse
import os
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magnet.cli import answers
from magnet.cli.data_options import besides_reader_options, job_of, reader_parser
from magnet.cli.data_shown import (
    add_list,
    file_bars,
    run_list,
    show_gaps,
    show_notes,
    show_persons,
    show_problems,
    show_skipped,
    show_splits,
    training_commands,
    why_untrained,
)
from magnet.cli.errors import CommandError, no_such
from magnet.cli.flags import PlainParser
from magnet.errors import counted

if TYPE_CHECKING:
    from magnet.body import Body
    from magnet.datamodules.preparing.check import CheckReport

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
FAILED = 1
"""Exit code of a check that found a problem."""


def main(arguments: Sequence[str]) -> int:
    """`magnet data ...`. Returns the exit code.

    Raises:
        CommandError: no such command.
        ValueError: a data set, option or folder that does not fit; says what does.
        OSError: a folder or disk that cannot be used.
    """
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
    return show_help(known) if known.help else int(known.run(known))


def parser() -> argparse.ArgumentParser:
    """The commands."""
    whole = argparse.ArgumentParser(
        prog="magnet data", description=DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = whole.add_subparsers(metavar="COMMAND")
    for name, (_, _, what) in COMMANDS.items():
        commands.add_parser(name, help=what)
    return whole


def command_parser(command: str) -> PlainParser:
    """A command's options."""
    add, run, what = COMMANDS[command]
    one = PlainParser(f"data {command}", what, add_help=False)
    one.add_argument("-h", "--help", action="store_true", help="show this")
    add(one)
    one.set_defaults(run=run, parser=one)
    return one


def show_help(given: argparse.Namespace) -> int:
    """Help of a command, with a data set's own options where one is named."""
    given.parser.print_help()
    if given.run in (run_prepare, run_check) and given.name:
        print(answers.kept(f"data prepare {given.name} help", lambda: reader_help(given.name)), end="")
    return 0


def reader_help(name: str) -> str:
    """Options of a data set's own; nothing where there is no such data set."""
    from magnet.datamodules import registry

    kind = registry.readers().get(name)
    return "" if kind is None else f"\noptions of {kind.title}:\n\n{reader_parser(kind).format_help()}"


# -- options -----------------------------------------------------------------------------------


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


def needed(given: argparse.Namespace, *names: str) -> list[str]:
    """Values that must be there.

    Raises:
        ValueError: one is not.
    """
    for action in given.parser._actions:
        if action.dest in names and getattr(given, action.dest) is None:
            name, prog = "".join(action.option_strings[:1]) or action.dest, given.parser.prog
            raise ValueError(f"{prog}: {name} is missing ({action.help}); see {prog} --help")
    return [getattr(given, name) for name in names]


# -- commands ----------------------------------------------------------------------------------


def run_info(given: argparse.Namespace) -> int:
    from rich.console import Console

    from magnet.datamodules.preparing.check import noted
    from magnet.datamodules.preparing.prepare import absent_note
    from magnet.datamodules.store.reader import StoreReader

    (path,) = needed(given, "path")
    folder = StoreReader(path)
    m = folder.manifest
    out = Console(highlight=False)
    out.print(f"[bold]{m['title']}[/bold]  {m['licence']}\n{m['source']}", soft_wrap=True)
    genders = "".join(f", from {gender} ones ({digest[:8]})" for gender, digest in m["body"].get("genders", {}).items())
    body = f"body {m['body']['id']} ({m['body']['sha256'][:8]}){genders}"
    out.print(f"{body}, {m['fps']:g} fps, store format {m['format']}", soft_wrap=True)
    rows = sum(split["person frames"] for split in m["splits"].values())
    files = [folder.path / name for name in folder.files()]
    size = sum(file.stat().st_size for file in files if file.is_file())
    out.print(f"{rows:,} frames of one person, {size / 2**20:.1f} MiB; splits by {m['splits by']}")
    if m.get("limit"):
        out.print(f"a try-out: at most {counted(m['limit'], 'take')} of each split")
    show_splits(m["splits"])
    show_persons([(entry["persons"], len(entry["takes"])) for entry in m.get("persons", [])])
    show_notes([noted(entry["note"], entry["takes"]) for entry in m["notes"]])
    show_skipped([(entry["take"], entry["why"]) for entry in m["skipped"]])
    if m.get("listed but not there"):
        out.print(absent_note(m["listed but not there"]), soft_wrap=True, markup=False)
    if m["left out"]:
        out.print(f"in no split: {counted(len(m['left out']), 'take')}")
    show_gaps(m["splits"], "limit" in m)
    return 0


def run_check(given: argparse.Namespace) -> int:
    from magnet.datamodules.preparing import check
    from magnet.datamodules.store.reader import MANIFEST, STATE, StoreReader

    path = Path(needed(given, "path")[0]).expanduser()
    if (path / MANIFEST).exists() or (path / STATE).is_dir():
        picture = picture_of(given, StoreReader(path).manifest["name"])
        found, body = checked_store(given, path)
    elif not path.is_dir():
        raise ValueError(f"{path} is not a folder; give a store or the folder of a download")
    else:
        name = given.name or check.recognise(path)
        picture = picture_of(given, name)
        found, body = checked_download(given, name, path)
    show_splits(found.splits, title=found.title)
    show_notes(found.notes)
    show_skipped(found.skipped)
    show_gaps(found.splits, found.limited)
    if picture is not None and check.draw(found, picture, body):
        print(f"picture: {picture}")
    show_problems(found.problems)
    count = len(found.problems)
    print(f"{count} problem{'s' * (count > 1)}" if count else "all assertions hold")
    return FAILED if found.problems else 0


def picture_of(given: argparse.Namespace, name: str) -> Path | None:
    """The picture to write, where one can be written; None: none is wanted. name: of the data set, which names it.

    Raises:
        CannotWrite: no file can be written there.
    """
    from magnet.files import CannotWrite, require_place

    if given.picture == "none":
        return None
    picture = Path(given.picture or f"{name}_check.png")
    try:
        require_place(picture)
    except CannotWrite as error:
        raise CannotWrite(f"{error} (--picture FILE, or --picture none)") from error
    return picture


def checked_store(given: argparse.Namespace, path: Path) -> tuple[CheckReport, Body | None]:
    """What was found, and the body to draw."""
    from magnet.body import load_body
    from magnet.datamodules.preparing import check
    from magnet.datamodules.preparing.progress import progress_bar
    from magnet.datamodules.store.reader import StoreReader

    refuse_unused(given, "a store, which is checked whole, as it was prepared,")
    body = load_body(given.body) if given.body != "open" else None
    with progress_bar() as tell:
        return check.check_store(StoreReader(path), body, tell), body


def checked_download(given: argparse.Namespace, name: str, path: Path) -> tuple[CheckReport, Body]:
    """What was found, and the body to draw."""
    from magnet.datamodules.preparing import check
    from magnet.datamodules.preparing.prepare import read_splits
    from magnet.datamodules.preparing.progress import progress_bar

    job = job_of(given, name, str(path))
    body, splits = job.body(), read_splits(given.splits) if given.splits else None
    with progress_bar() as tell:
        return check.check_download(job, given.workers, splits, given.limit, tell), body


def refuse_unused(given: argparse.Namespace, what: str, *used: str) -> None:
    """Options that would change nothing.

    Raises:
        ValueError: one was given.
    """
    used = ("path", "picture", "body", "workers", "reader_options", *used)
    set_ones = {name for name, value in vars(given).items() if value != given.parser.get_default(name)}
    if words := [*(f"--{name}" for name in sorted(set_ones.difference(used))), *given.reader_options]:
        raise ValueError(f"{given.parser.prog}: {what} has no use for {words[0]}; leave it out")


def run_prepare(given: argparse.Namespace) -> int:
    from magnet.datamodules import registry
    from magnet.datamodules.preparing.prepare import absent_note, prepare, read_splits, summary_of
    from magnet.datamodules.preparing.progress import progress_bar

    if given.place and given.out and given.place != given.out:
        raise ValueError(f"{given.parser.prog}: OUT is {given.place} and --out {given.out}: give one")
    given.out = given.out or given.place
    if given.name:
        registry.reader(given.name)  # a wrong name is said before what else is missing
    name, root, out = needed(given, "name", "root", "out")
    job = job_of(given, name, root)
    splits = read_splits(given.splits) if given.splits else None
    with progress_bar() as tell:
        report = prepare(job, out, workers=given.workers, splits=splits, limit=given.limit, progress=tell)
    m = report.folder.manifest
    for line in summary_of(job.reader()):
        print(f"note: {line}")
    if m["listed but not there"]:
        print(absent_note(m["listed but not there"]))
    print(f"{counted(report.made - report.failed, 'take')} converted, {report.kept} kept from an earlier run")
    show_skipped([(entry["take"], entry["why"]) for entry in m["skipped"]])
    show_gaps(m["splits"], "limit" in m)
    takes = sum(split["takes"] for split in m["splits"].values())
    said = f"{f'{takes} takes are' if takes != 1 else '1 take is'} in {out}; {len(m['skipped'])} were skipped."
    if why := why_untrained(m):
        print(f"{said} Nothing can be trained on it, for split train is empty: {why}")
        return 0
    print(f"{said} To train on it:")
    longest = int(report.folder.split("test").frames.max(initial=0))
    for line in training_commands(name, out, given.body, longest):
        print(f"  {line}")
    return 0


def run_fake(given: argparse.Namespace) -> int:
    from magnet.datamodules import registry
    from magnet.datamodules.clip import MOST, at_least, at_most
    from magnet.files import writing

    name, out = needed(given, "name", "out")
    folder = Path(out).expanduser()
    kind = registry.reader(name)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"{folder} is not empty; give a new folder")
    at_least(1, takes=given.takes, frames=given.frames)
    at_most(MOST, takes=given.takes, frames=given.frames)
    with writing(folder, "choose another --out"):
        kind.write_fake(folder, given.takes, given.frames, given.seed)
    files = [path for path in folder.rglob("*") if path.is_file()]
    body = f" --body {shlex.quote(str(folder / 'body.npz'))}" if (folder / "body.npz").is_file() else ""
    print(f"{len(files)} files of a made-up {name} are in {folder}. To prepare it:")
    print(f"  magnet data prepare {name} --root {shlex.quote(str(folder))} --out STORE{body}")
    return 0


def run_download(given: argparse.Namespace) -> int:
    from magnet.datamodules import registry

    (name,) = needed(given, "name")
    if name != "cmu":
        kind = registry.reader(name)
        raise ValueError(f"{kind.title} is given out by its authors alone: ask at {kind.source} ({kind.licence})")
    (out,) = needed(given, "out")
    from magnet.datamodules.reading.download import download_cmu
    from magnet.files import writing

    subjects = [word.strip() for word in given.subjects.split(",") if word.strip()]
    options: dict[str, Any] = {"any_version": True} if given.any_version else {}
    options |= {} if given.base_url is None else {"base_url": given.base_url}
    with file_bars() as tell, writing(out, "choose another --out; then run the same command again, which goes on"):
        got = download_cmu(subjects, out, progress=tell, **options)
    print(f"{counted(len(got.fetched), 'file')} fetched, {len(got.kept)} there before, in {got.folder}")
    if got.unlike:
        unlike = counted(len(got.unlike), "file")
        print(f"{unlike} not of the bytes this project was tested with: {', '.join(got.unlike[:5])}")
    print(f"to train on them: magnet fit --model Tokenizer --data CMU --data.root {shlex.quote(str(out))}")
    return 0


COMMANDS: dict[str, tuple[Callable[[argparse.ArgumentParser], None], Callable[[argparse.Namespace], int], str]] = {
    "list": (add_list, run_list, "data sets: who may use them, where to ask, what must lie where"),
    "info": (add_info, run_info, "what a prepared store holds"),
    "check": (add_check, run_check, "run all assertions on a store or a download; a summary and a picture"),
    "fake": (add_fake, run_fake, "write a tiny made-up download in a data set's layout"),
    "prepare": (add_prepare, run_prepare, "turn a download into a store, once"),
    "download": (add_download, run_download, "fetch CMU's free recordings"),
}
