"""`prepare`: a download to a store, once; by many processes, resumable, the same bytes however it went."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

from magnet.datamodules.clip import SPLITS, Split, at_least
from magnet.datamodules.preparing.convert import ConvertedTake, PrepareJob, convert_all, named_errors, take_key
from magnet.datamodules.preparing.pack import PackSource, pack
from magnet.datamodules.preparing.progress import Tell
from magnet.datamodules.reading.recording import DataError, Reader, Take
from magnet.datamodules.store.reader import MANIFEST, STATE, StoreError, StoreReader, as_json, holds_store
from magnet.errors import counted, first_names
from magnet.files import CannotWrite, alone, file_hash, write_whole, writing

SHARD_ROWS = 2**18
"""Rows of a shard at most, 49 MB; small enough that ten million frames spread over some forty processes."""
ON_FULL = "choose another --out; then run the same command again, which keeps finished takes"


@dataclass(frozen=True)
class PrepareReport:
    """What a run of `prepare` did."""

    folder: StoreReader
    made: int  # takes read in this run
    failed: int  # of these, takes that could not be used
    kept: int  # takes that an earlier run had finished


def prepare(
    job: PrepareJob,
    out: str | Path,
    *,
    workers: int = 1,
    splits: dict[str, Split] | None = None,
    limit: int | None = None,
    shard_rows: int = SHARD_ROWS,
    progress: Tell | None = None,
) -> PrepareReport:
    """Make or bring up to date the store at `out`.

    Args:
        job: which data set, where, and how.
        out: the store's folder; an earlier run's finished takes in it are kept while their files and the options
            are the same.
        workers: processes; 1: this one. The store's bytes do not depend on it.
        splits: split of each take by name, in place of the official rule; takes it does not name are left out.
        limit: at most so many takes of each split, to try things out.
        shard_rows: rows of a shard, one frame of one person each; a take stays in one shard.
        progress: is told of progress.

    Raises:
        DataError: nothing of the data set was found, or no take could be used; says why for each.
        ValueError: a number out of range, a list of splits that does not fit, or `out` holds something else.
        OSError: another prepare works there, the disk is full, or the folder may not be written to.
    """
    at_least(1, workers=workers, limit=limit, shard_rows=shard_rows)
    reader, body = job.reader(), job.body()
    use = select_takes(reader, splits, limit)
    takes = use.takes
    out = Path(out).expanduser()
    opened(out, reader)  # a stranger's folder is refused before anything is made in it
    state = out / STATE
    make_state(out)
    with writing(out, ON_FULL), locked(state):
        old = opened(out, reader)  # again: whoever held the lock before may have made a new store
        settings = job.settings(body)
        keys = {take.name: take_key(take, reader.root, settings) for take in takes}
        finished = remembered(state, old)
        todo = [t for t in takes if keys[t.name] not in finished and not _whole(part_file(state, keys[t.name]))]
        for _ in convert_all(job, todo, lambda take: part_file(state, keys[take.name]), workers, progress):
            pass
        sources = [PackSource(take, part_file(state, keys[take.name]), finished.get(keys[take.name])) for take in takes]
        facts: dict[str, Any] = {
            "name": reader.name,
            "title": reader.title,
            "source": reader.source,
            "licence": reader.licence,
            "family": reader.family,
            "body": {"id": body.id, "sha256": settings["body"], "genders": settings["bodies"]},
            "options": {key: settings[key] for key in ("options", "steps", "steps version", "reader version")},
            "splits by": "the data set's rule" if splits is None else "a list given by the user",
            "left out": use.left_out,
            "listed but not there": use.absent,
        }
        if limit is not None:
            facts["limit"] = limit
        packed = pack(sources, old, out, facts, shard_rows)
        if packed is None:
            listed = "".join(f"\n  {s.take.name}: {s.load(None, rows=False).error}" for s in sources[:20])
            none = f"{reader.title}: none of {len(takes)} takes could be used"
            raise DataError(f"{none}; check --root and these files:{listed}")
        folder = StoreReader(out)
        done = {keys[name]: place for name, place in packed.items()}
        write_whole(state, "state.json", as_json({"manifest": file_hash(out / MANIFEST), "takes": done}))
        clean(folder, state, set(done))
    failed = sum(take.name not in packed for take in todo)
    return PrepareReport(folder, len(todo), failed, len(takes) - len(todo))


@dataclass(frozen=True)
class TakeSelection:
    """What is to be prepared of a download, and what is not."""

    takes: list[Take]  # each with its split
    left_out: list[str]  # takes that the rule or the list leaves out
    absent: list[str]  # what the lists name and the download lacks


def select_takes(reader: Reader, splits: dict[str, Split] | None, limit: int | None) -> TakeSelection:
    """The takes to prepare; official lists are not looked at where `splits` are given."""
    with named_errors(type(reader), f"its takes cannot be listed under {reader.root}"):
        takes = reader.takes() if splits is None else reader.found()
    if not takes:
        raise DataError(f"{reader.title}: no takes under {reader.root}; is it the folder of the download?")
    with named_errors(type(reader), "its lists of splits cannot be read"):
        listed = reader.official() if splits is None else splits
    absent = sorted(set(listed or ()) - {take.group if splits is None else take.name for take in takes})
    names = {take.name for take in takes}
    if len(names) < len(takes):
        twice = sorted({take.name for take in takes if sum(t.name == take.name for t in takes) > 1})
        raise DataError(f"{reader.title}: takes are named twice: {', '.join(twice[:5])}; rename one of each")
    if splits is not None:
        if len(absent) == len(splits):
            raise ValueError(
                f"the list of splits names no take of this download: it has {', '.join(absent[:3]) or 'no names'}, "
                f"takes are called {', '.join(sorted(names)[:3])}"
            )
        takes = [replace(take, split=splits.get(take.name)) for take in takes]
    groups: dict[str, tuple[str, Split]] = {}
    for take in takes:
        if take.group and take.split is not None:
            other, split = groups.setdefault(take.group, (take.name, take.split))
            if split != take.split:
                raise DataError(
                    f"{take.name} is in {take.split} but {other} in {split}, and both belong to {take.group}: such "
                    f"takes are all but copies; put them into one split"
                )
    left_out = [take.name for take in takes if take.split is None]
    used: list[Take] = []
    count: Counter[Split] = Counter()
    for take in takes:
        if take.split is not None and (limit is None or count[take.split] < limit):
            used.append(take)
            count[take.split] += 1
    if not used:
        raise DataError(
            f"{reader.title}: none of {len(takes)} takes belongs to a split; give a list of splits with --splits FILE"
        )
    return TakeSelection(used, left_out, absent)


def summary_of(reader: Reader) -> list[str]:
    """A reader's summary of what it found, or in its place the error that making it raised: no take depends on it."""
    try:
        with named_errors(type(reader), "its summary cannot be made"):
            lines: object = reader.summary()  # a stranger's may give anything
            return [lines] if isinstance(lines, str) else [str(line) for line in cast(Iterable[object], lines)]
    except DataError as error:
        return [str(error)]


def absent_note(names: list[str]) -> str:
    """Says which names of the lists the download lacks; perhaps it was not unpacked completely."""
    return f"{counted(len(names), 'name')} of the lists not in the download: {first_names(names, 5)}"


def read_splits(path: str | Path) -> dict[str, Split]:
    """A user's list of splits: lines `NAME SPLIT`, or JSON {name: split} or {split: [names]}.

    Raises:
        ValueError: a line that is neither, a split that is none of train, val and test, or a name in two of them.
        OSError: no such file.
    """
    pairs: list[tuple[str, str]] = []
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
        held = json.loads(text) if text.lstrip().startswith("{") else None
    except ValueError as error:
        raise ValueError(f"{path}: neither lines NAME SPLIT nor JSON ({error})") from error
    if held is not None:
        for key, value in held.items():
            pairs += [(name, key) for name in value] if isinstance(value, list) else [(key, value)]
    else:
        for number, line in enumerate(text.splitlines(), 1):
            line = line.split("#")[0].strip()
            if line:
                name, *rest = line.rsplit(maxsplit=1)
                if not rest:
                    raise ValueError(f"{path}, line {number}: got {line!r}, expected NAME SPLIT")
                pairs.append((name, rest[0]))
    found: dict[str, Split] = {}
    for name, split in pairs:
        known = [one for one in SPLITS if one == split]
        if not known:
            raise ValueError(f"{path}: {name} is in {split!r}, expected one of {', '.join(SPLITS)}")
        if found.setdefault(name, known[0]) != split:
            raise ValueError(f"{path}: {name} is in {found[name]} and in {split}")
    return found


# -- what lies in the folder -------------------------------------------------------------------


def make_state(out: Path) -> None:
    """The store's folder, with one in it for what is not finished.

    Raises:
        CannotWrite: it cannot be made.
    """
    with writing(out, "choose another --out"):
        try:
            (out / STATE).mkdir(parents=True, exist_ok=True)
        except FileNotFoundError as error:  # in /proc, for example
            raise CannotWrite(f"{out}: cannot be made ({error.strerror}); choose another --out") from error


def opened(out: Path, reader: Reader) -> StoreReader | None:
    """The store that is there already.

    Raises:
        ValueError: the folder holds another data set's store, or something that is no store.
    """
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out} is a file, expected a folder; choose another --out")
    if not out.exists() or not any(out.iterdir()):
        return None
    if not holds_store(out):
        raise ValueError(f"{out} is not empty and holds no store; choose another --out")
    try:
        folder = StoreReader(out)
    except StoreError:
        return None  # not finished, or of another format: made anew
    if folder.manifest.get("name") != reader.name:
        raise ValueError(f"{out} holds a store of {folder.manifest.get('title')}; choose another --out")
    return folder


def part_file(state: Path, key: str) -> Path:
    return state / f"{key}.part"


def _whole(path: Path) -> bool:
    """Whether an earlier run finished this part. Failures are tried again: permissions and disks get mended."""
    if not path.exists():
        return False
    try:
        return ConvertedTake.load(path, rows=False).error is None
    except (OSError, ValueError, KeyError, EOFError):
        return False


@contextmanager
def locked(state: Path) -> Iterator[None]:
    """Nobody else prepares into the same folder meanwhile; the lock goes with the process, however it ends."""
    with alone(state / "lock", f"another prepare is working in {state.parent}; wait for it, or choose another --out"):
        yield


def remembered(state: Path, old: StoreReader | None) -> dict[str, Any]:
    """Keys of takes whose rows are in the present store, and which clips they are."""
    path = state / "state.json"
    if old is None or not path.exists():
        return {}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    if found.get("manifest") != file_hash(old.path / MANIFEST):
        return {}
    files = {old.path / name: digest for name, digest in old.files().items()}
    whole = all(path.is_file() and file_hash(path) == digest for path, digest in files.items())
    return found["takes"] if whole else {}


OURS = re.compile(r"((train|val|test)-\d{5}|clips|betas)-[0-9a-f]{8}\.(npy|json)|\.new-.*")


def clean(folder: StoreReader, state: Path, keys: set[str]) -> None:
    """Remove what the new store does not need: an older store's files, and parts, which can be got from it."""
    needed = set(folder.files())
    for path in folder.path.iterdir():
        if OURS.fullmatch(path.name) and path.name not in needed:
            path.unlink()
    for path in state.iterdir():
        if path.suffix == ".part" or path.name.startswith(".new-"):
            path.unlink()
