"""What the commands of `magnet data` do: info, check, fake, prepare and download."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.console import Console

from magnet.body import Body, load_body
from magnet.cli import data_shown
from magnet.cli.data_list import body_of
from magnet.cli.data_options import job_of
from magnet.datamodules import registry
from magnet.datamodules.clip import MOST, at_least, at_most
from magnet.datamodules.preparing import check
from magnet.datamodules.preparing.prepare import absent_note, prepare, read_splits, summary_of
from magnet.datamodules.preparing.progress import progress_bar
from magnet.datamodules.reading import download
from magnet.datamodules.store.reader import StoreReader, holds_store
from magnet.errors import counted
from magnet.files import CannotWrite, require_place, writing

FAILED = 1
"""Exit code of a check that found a problem."""


def needed(given: argparse.Namespace, *names: str) -> list[str]:
    """Values that must be there."""
    for action in given.parser._actions:
        if action.dest in names and getattr(given, action.dest) is None:
            name, prog = "".join(action.option_strings[:1]) or action.dest, given.parser.prog
            raise ValueError(f"{prog}: {name} is missing ({action.help}); see {prog} --help")
    return [getattr(given, name) for name in names]


def run_info(given: argparse.Namespace) -> int:
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
    data_shown.show_splits(m["splits"])
    data_shown.show_persons([(entry["persons"], len(entry["takes"])) for entry in m.get("persons", [])])
    data_shown.show_notes([check.noted(entry["note"], entry["takes"]) for entry in m["notes"]])
    data_shown.show_skipped([(entry["take"], entry["why"]) for entry in m["skipped"]])
    if m.get("listed but not there"):
        out.print(absent_note(m["listed but not there"]), soft_wrap=True, markup=False)
    if m["left out"]:
        out.print(f"in no split: {counted(len(m['left out']), 'take')}")
    data_shown.show_gaps(m["splits"], "limit" in m)
    return 0


def run_check(given: argparse.Namespace) -> int:
    path = Path(needed(given, "path")[0]).expanduser()
    if holds_store(path):
        folder = StoreReader(path)
        picture = picture_of(given, folder.manifest["name"])
        found, body = checked_store(given, folder)
    elif not path.is_dir():
        raise ValueError(f"{path} is not a folder; give a store or the folder of a download")
    else:
        name = given.name or check.recognise(path)
        picture = picture_of(given, name)
        found, body = checked_download(given, name, path)
    data_shown.show_splits(found.splits, title=found.title)
    data_shown.show_notes(found.notes)
    data_shown.show_skipped(found.skipped)
    data_shown.show_gaps(found.splits, found.limited)
    if picture is not None and check.draw(found, picture, body):
        print(f"picture: {picture}")
    data_shown.show_problems(found.problems)
    count = len(found.problems)
    print(f"{count} problem{'s' * (count > 1)}" if count else "all assertions hold")
    return FAILED if found.problems else 0


def picture_of(given: argparse.Namespace, name: str) -> Path | None:
    """The picture to write, where one can be written; None: none is wanted. name: of the data set, which names it."""
    if given.picture == "none":
        return None
    picture = Path(given.picture or f"{name}_check.png")
    try:
        require_place(picture)
    except CannotWrite as error:
        raise CannotWrite(f"{error} (--picture FILE, or --picture none)") from error
    return picture


def checked_store(given: argparse.Namespace, folder: StoreReader) -> tuple[check.CheckReport, Body | None]:
    """What was found, and the body to draw."""
    refuse_unused(given)
    body = load_body(given.body) if given.body != "open" else None
    with progress_bar() as tell:
        return check.check_store(folder, body, tell), body


def checked_download(given: argparse.Namespace, name: str, path: Path) -> tuple[check.CheckReport, Body]:
    """What was found, and the body to draw."""
    job = job_of(given, name, str(path))
    body, splits = job.body(), read_splits(given.splits) if given.splits else None
    with progress_bar() as tell:
        return check.check_download(job, given.workers, splits, given.limit, tell), body


def refuse_unused(given: argparse.Namespace) -> None:
    """Refuse options that would change nothing where a store is checked."""
    said = {name for name, value in vars(given).items() if value != given.parser.get_default(name)}
    unused = said - {"path", "picture", "body", "workers", "reader_options"}
    if words := [*(f"--{name}" for name in sorted(unused)), *given.reader_options]:
        what = "a store, which is checked whole, as it was prepared, has no use for"
        raise ValueError(f"{given.parser.prog}: {what} {words[0]}; leave it out")


def run_prepare(given: argparse.Namespace) -> int:
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
    data_shown.show_skipped([(entry["take"], entry["why"]) for entry in m["skipped"]])
    data_shown.show_gaps(m["splits"], "limit" in m)
    takes = sum(split["takes"] for split in m["splits"].values())
    said = f"{f'{takes} takes are' if takes != 1 else '1 take is'} in {out}; {len(m['skipped'])} were skipped."
    if why := data_shown.why_untrained(m):
        print(f"{said} Nothing can be trained on it, for split train is empty: {why}")
        return 0
    print(f"{said} To train on it:")
    longest = int(report.folder.split("test").frames.max(initial=0))
    for line in data_shown.training_commands(name, out, given.body, longest):
        print(f"  {line}")
    return 0


def run_fake(given: argparse.Namespace) -> int:
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
    made = folder / "body.npz"
    body = f" --body {shlex.quote(str(made))}" if body_of(kind) and made.is_file() else ""
    print(f"{len(files)} files of a made-up {name} are in {folder}. To prepare it:")
    print(f"  magnet data prepare {name} --root {shlex.quote(str(folder))} --out STORE{body}")
    return 0


def run_download(given: argparse.Namespace) -> int:
    (name,) = needed(given, "name")
    if name != "cmu":
        kind = registry.reader(name)
        raise ValueError(f"{kind.title} is given out by its authors alone: ask at {kind.source} ({kind.licence})")
    (out,) = needed(given, "out")
    subjects = [word.strip() for word in given.subjects.split(",") if word.strip()]
    options: dict[str, Any] = {"any_version": True} if given.any_version else {}
    options |= {} if given.base_url is None else {"base_url": given.base_url}
    again = "choose another --out; then run the same command again, which goes on"
    with data_shown.file_bars() as tell, writing(out, again):
        got = download.download_cmu(subjects, out, progress=tell, **options)
    print(f"{counted(len(got.fetched), 'file')} fetched, {len(got.kept)} there before, in {got.folder}")
    if got.unlike:
        unlike = counted(len(got.unlike), "file")
        print(f"{unlike} not of the bytes this project was tested with: {', '.join(got.unlike[:5])}")
    print(f"to train on them: magnet fit --model Tokenizer --data CMU --data.root {shlex.quote(str(out))}")
    return 0


RUNS: dict[str, Callable[[argparse.Namespace], int]] = {
    "info": run_info,
    "check": run_check,
    "fake": run_fake,
    "prepare": run_prepare,
    "download": run_download,
}
