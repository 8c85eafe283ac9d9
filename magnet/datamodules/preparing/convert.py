"""One take of a download converted to one part on disk: the work of `prepare`'s processes."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing import connection
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from magnet.body import Body, load_body
from magnet.body.family import title, titles
from magnet.datamodules import registry
from magnet.datamodules.preparing.canonicalize import CANONICALIZE_VERSION, CanonicalizeOptions, canonicalize
from magnet.datamodules.preparing.check_people import check_shapes
from magnet.datamodules.preparing.genders import load_bodies, one_body
from magnet.datamodules.preparing.progress import Tell
from magnet.datamodules.preparing.worker_processes import ended_at_once, unheard_ctrl_c
from magnet.datamodules.reading.recording import DataError, Gender, Reader, Take
from magnet.datamodules.store.reader import FORMAT, body_hash
from magnet.datamodules.store.rows import ROW, encode
from magnet.files import file_hash, write_whole
from magnet.threads import one_thread

PART_VERSION = 2
"""Raise it whenever a part holds something else: takes prepared before are then made anew."""
ALONE = 8.0
"""Seconds that this process may take for all takes before others are started, each of which imports everything anew."""
BODY_FROM = {
    "smplx": "https://smpl-x.is.tue.mpg.de (register; SMPLX_NEUTRAL.npz or .pkl)",
    "smpl": "https://smpl.is.tue.mpg.de for SMPL, https://mano.is.tue.mpg.de for SMPL-H (register; npz or pkl)",
}


def families_of(kind: type[Reader]) -> tuple[str, ...]:
    """Families of bodies that a data set's shape numbers belong to; none where it has no such numbers."""
    return kind.shapes_of or ((kind.family,) if kind.family in BODY_FROM else ())


def require_family(kind: type[Reader], body: Body, option: str, file: str) -> None:
    """Refuse a body whose tree of joints is another family's: its shape numbers mean something else."""
    families = families_of(kind)
    if not families or body.family in ("", *families) or body.id.startswith("open"):
        return
    beside = f", or with --bodies beside this one, to have everybody as {title(body.family)}"
    other = "" if option == "--bodies" else beside
    raise ValueError(
        f"{option} {file}: body {body.id!r} has the joints of {title(body.family)}, but {kind.title} holds shape "
        f"numbers of {titles(families)}: give a body file of that family with {option}{other}; such files are from "
        f"{BODY_FROM[kind.family]}"
    )


@contextmanager
def named_errors(kind: type[Reader], what: str) -> Iterator[None]:
    """Whatever a reader's code raises, or that it ends the program, as one line that names the data set.

    what: is not possible, for errors that are no sentences

    Raises:
        DataError: it raised something.
    """
    try:
        yield
    except (ValueError, OSError) as error:
        titled = kind.title in str(error)
        if isinstance(error, DataError) and titled:
            raise
        raise DataError(f"{'' if titled else f'{kind.title}: '}{_line(error)}") from error
    except (Exception, SystemExit) as error:
        text = " ".join(f"{type(error).__name__}: {error}".split())
        raise DataError(f"{kind.title}: {what} ({text}); mend {kind.__module__}.{kind.__qualname__}") from error


def _line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


@dataclass(frozen=True)
class PrepareJob:
    """What is to be prepared, and how; plain values that every process builds its own reader and body from.

    Args:
        name: of the reader in the registry.
        root: folder of the download.
        options: of the reader's constructor; files and folders among them as `Path`.
        body_file: path of the body file, or "open".
        canonicalize: what can be chosen about `canonicalize`.
        body_files: folder or files of gendered bodies that shape numbers belong to; none: all belong to `body_file`.
    """

    name: str
    root: str
    options: dict[str, Any]
    body_file: str
    canonicalize: CanonicalizeOptions
    body_files: tuple[str, ...] = ()

    def reader(self) -> Reader:
        """The data set's reader on the download.

        Raises:
            DataError: the reader cannot be made; names the data set.
        """
        kind = registry.reader(self.name)
        with named_errors(kind, f"its reader cannot be made on {self.root}"):
            return kind(self.root, **self.options)

    def body(self) -> Body:
        """The body model.

        Raises:
            ValueError: the data set holds shape numbers, but no body file was given, or another family's; says where to
                get it.
        """
        kind = registry.reader(self.name)
        if self.body_file == "open" and kind.family not in ("positions", "any"):
            raise ValueError(
                f"{kind.title} holds shape numbers of {title(kind.family)}: give the body's file with --body FILE, "
                f"from {BODY_FROM[kind.family]}; `magnet data fake` writes a made-up body.npz beside its files"
            )
        body = load_body(self.body_file)
        if not self.body_files:
            require_family(kind, body, "--body", self.body_file)
        return body

    def bodies(self) -> dict[Gender, Body]:
        """Gendered bodies that shape numbers belong to.

        Raises:
            ValueError: files that are not there, not to be told apart, or of another family.
        """
        kind = registry.reader(self.name)
        bodies = load_bodies(self.body_files, families_of(kind)) if self.body_files else {}
        for gender, body in bodies.items():
            require_family(kind, body, "--bodies", f"the {gender} one")
        return bodies

    def settings(self, body: Body) -> dict[str, Any]:
        """Everything that a take's part depends on besides its files."""
        kind = registry.reader(self.name)
        return {
            "format": FORMAT,
            "part version": PART_VERSION,
            "steps version": CANONICALIZE_VERSION,
            "steps": self.canonicalize.__dict__,
            "reader": self.name,
            "reader version": kind.version,
            "options": {key: content(value) for key, value in self.options.items()},
            "body": body_hash(body),
            "bodies": {gender: body_hash(one) for gender, one in self.bodies().items()},
        }


def content(value: Any) -> str:
    """An option's value as text; of a file or folder its name and content, but not where it lies.

    Raises:
        ValueError: no such file or folder.
    """
    if not isinstance(value, Path):
        return str(value)
    if not value.exists():
        raise ValueError(f"{value}: no such file or folder")
    inside = sorted(path for path in value.rglob("*") if path.is_file()) if value.is_dir() else [value]
    listed = [[path.relative_to(value).as_posix(), file_hash(path)] for path in inside]
    return f"{value.resolve().name} ({hashlib.sha256(json.dumps(listed).encode()).hexdigest()[:16]})"


def take_key(take: Take, root: Path, settings: dict[str, Any]) -> str:
    """Name of a take's part. It changes with the sizes and times of its files, with files that come or go, and with
    settings."""
    files: list[list[str | int]] = []
    for path in (*take.files, *take.also):
        try:
            stat = path.stat()
        except OSError:
            files.append([os.path.relpath(path, root), "missing"])
        else:
            files.append([os.path.relpath(path, root), stat.st_size, stat.st_mtime_ns])
    text = json.dumps([take.name, files, settings], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


@dataclass(frozen=True)
class ConvertedTake:
    """The result of converting one take."""

    error: str | None
    notes: tuple[str, ...]
    names: tuple[str, ...]  # of its clips
    frames: tuple[int, ...]
    people: tuple[int, ...]
    betas: NDArray[np.float32]  # (people of all its clips, 10)
    rows: NDArray[np.void]  # (rows of all its clips,) of `ROW`
    persons: tuple[str, ...] = ()  # names or roles of the people in all its clips; (): none are known

    @staticmethod
    def failed(error: str) -> ConvertedTake:
        """A take that gives nothing."""
        return ConvertedTake(
            shortened(error), (), (), (), (), np.zeros((0, 10), dtype=np.float32), np.zeros(0, dtype=ROW)
        )

    def saved(self, path: Path) -> ConvertedTake:
        """Write it, all or nothing. Returns it without its rows."""
        facts = {name: getattr(self, name) for name in ("error", "notes", "names", "frames", "people", "persons")}
        text = np.array(json.dumps(facts))

        def write(out: Any) -> None:
            for array in (text, self.betas, self.rows):
                np.lib.format.write_array(out, array, allow_pickle=False)

        write_whole(path.parent, path.name, write)
        return self.without_rows()

    def without_rows(self) -> ConvertedTake:
        """All but its rows, whose memory is free then: an empty slice would hold it."""
        return replace(self, rows=np.zeros(0, dtype=ROW))

    @staticmethod
    def load(path: Path, rows: bool = True) -> ConvertedTake:
        """What `saved` wrote, with or without its rows.

        Raises:
            ValueError: it is damaged.
        """
        with path.open("rb") as file:
            facts = json.loads(str(np.lib.format.read_array(file, allow_pickle=False)))
            betas = np.lib.format.read_array(file, allow_pickle=False)
            array = np.lib.format.read_array(file, allow_pickle=False) if rows else np.zeros(0, dtype=ROW)
        lists = {name: tuple(facts[name]) for name in ("notes", "names", "frames", "people", "persons")}
        return ConvertedTake(error=facts["error"], betas=betas, rows=array, **lists)


def convert(
    reader: Reader, take: Take, body: Body, options: CanonicalizeOptions, bodies: Mapping[Gender, Body] | None = None
) -> ConvertedTake:
    """Read a take and canonicalize it; whatever is wrong with it becomes the part's error."""
    try:
        recording = reader.read(take)
        if recording.betas is not None:
            check_shapes(recording.betas, recording.persons)
        recording = one_body(recording, bodies or {}, body)
        clips, notes = canonicalize(
            recording, body, take.name, reader.name, take.split or "train", reader.family, options
        )
    except (ValueError, OSError) as error:
        return ConvertedTake.failed(about(take, str(error) or type(error).__name__, reader.root))
    except (Exception, SystemExit) as error:  # a reader that does not know what to say: the others go on
        return ConvertedTake.failed(about(take, f"{type(error).__name__}: {error}", reader.root))
    return ConvertedTake(
        error=None,
        notes=tuple(relative(note, reader.root) for note in notes),
        names=tuple(clip.name for clip in clips),
        frames=tuple(clip.frames for clip in clips),
        people=tuple(clip.agents for clip in clips),
        betas=np.concatenate([clip.scene.betas[0].float().numpy() for clip in clips]),
        rows=np.concatenate([encode(clip.scene) for clip in clips]),
        persons=recording.persons,
    )


def about(take: Take, text: str, root: Path) -> str:
    """A message that names a file of the take, or its folder; the first file where it did not."""
    said = relative(text, root)
    places = {os.path.relpath(place, root) for file in take.files for place in (file, file.parent)}
    named = any(place in said for place in places if place != ".") or not take.files
    return said if named else f"{os.path.relpath(take.files[0], root)}: {said}"


def shortened(text: str, most: int = 600) -> str:
    """A message that fits a list of them."""
    return text if len(text) <= most else f"{text[: most // 2]} ... {text[-most // 2 :]}"


def relative(text: str, root: Path) -> str:
    """A message without the folder of the download, so that a store does not depend on where it was made."""
    for path in sorted({str(root), str(root.absolute()), str(root.resolve())}, key=len, reverse=True):
        text = text.replace(path + os.sep, "")
    return text


# -- processes ---------------------------------------------------------------------------------

_HERE: dict[str, Any] = {}


def begin(job: PrepareJob, kind: type[Reader]) -> None:
    """Set up a worker process: one thread, its own reader and body; it ends when its parent is gone.

    That `kind`, the reader's class, has come here has imported its module, which registers it.
    """
    torch.set_num_threads(1)
    threading.Thread(target=_follow_parent, daemon=True).start()
    _HERE.update(job=job, reader=job.reader(), body=job.body(), bodies=job.bodies())


def _follow_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)


def work(take: Take, path: Path | None) -> ConvertedTake:
    """Make one part in a worker process, on disk if there is a path. Returns it without its rows if so."""
    part = convert(_HERE["reader"], take, _HERE["body"], _HERE["job"].canonicalize, _HERE["bodies"])
    return part if path is None else part.saved(path)


def sizes(takes: Sequence[Take]) -> dict[str, int]:
    """Bytes of each take's files, by name; at least 1."""
    return {take.name: 1 + sum(path.stat().st_size for path in take.files if path.is_file()) for take in takes}


def convert_all(
    job: PrepareJob, takes: list[Take], file: Callable[[Take], Path | None], workers: int, progress: Tell | None = None
) -> Iterator[tuple[Take, ConvertedTake]]:
    """Make the parts of all takes as they are done, each on disk, whole, where `file` says; in any order.

    `progress` is told of bytes of the download.

    Raises:
        OSError: a worker process died.
    """
    size = sizes(takes)
    total, done = sum(size.values()), 0
    progress = progress or (lambda name, done, total: None)
    if takes:
        progress(takes[0].name, 0, total)
    for take, part in _converted(job, sorted(takes, key=lambda take: -size[take.name]), file, workers):
        done += size[take.name]
        progress(take.name, done, total)
        yield take, part


def in_a_notebook(kind: type) -> bool:
    """Whether a class was defined where no other process finds it: in no file."""
    return kind.__module__ == "__main__" and not hasattr(sys.modules["__main__"], "__file__")


def _converted_here(
    job: PrepareJob, takes: list[Take], file: Callable[[Take], Path | None]
) -> Iterator[tuple[Take, ConvertedTake]]:
    reader, body, bodies = job.reader(), job.body(), job.bodies()
    for take in takes:
        with one_thread():  # as in worker processes: sums come out the same whatever the number of cores
            part, path = convert(reader, take, body, job.canonicalize, bodies), file(take)
            part = part if path is None else part.saved(path)
        yield take, part


def _converted(
    job: PrepareJob, takes: list[Take], file: Callable[[Take], Path | None], workers: int
) -> Iterator[tuple[Take, ConvertedTake]]:
    kind = registry.reader(job.name)
    here = _converted_here(job, takes[::-1], file)  # the smallest first: it tells how long the others will take
    if workers == 1 or len(takes) < 2 or in_a_notebook(kind):
        yield from here
        return
    began, size = time.monotonic(), sizes(takes)
    yield next(here)
    if (time.monotonic() - began) * sum(size.values()) / size[takes[-1].name] < ALONE:
        yield from here
        return
    takes = takes[:-1]
    spawn = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(min(workers, len(takes)), mp_context=spawn, initializer=begin, initargs=(job, kind))
    try:
        with ended_at_once(pool):
            with unheard_ctrl_c():
                running = {pool.submit(work, take, file(take)): take for take in takes}
            for future in as_completed(running):  # looks at each once; `wait` looks at all that run, each time
                yield running.pop(future), future.result()
    except BrokenProcessPool as error:
        raise OSError(
            "a worker process died, perhaps for want of memory: run the same command again with fewer --workers; "
            "finished takes are kept"
        ) from error
