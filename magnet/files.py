"""Writes files whole or not at all, hashes them, and bounds what is read from untrusted ones."""

from __future__ import annotations

import errno
import hashlib
import os
import re
import secrets
import shutil
import tempfile
import tokenize
import unicodedata
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

FULL = (errno.ENOSPC, errno.EDQUOT)
REFUSED = (errno.EACCES, errno.EPERM, errno.EROFS)
JOINERS = "\u200c\u200d"
"""Signs without a width that stand inside words of some scripts."""
ANYHOW, RATIO = 64 * 2**20, 100
"""Any array of an npz may unpack to so many bytes, and a larger one to so many times its packed size."""


class CannotWrite(OSError):
    """A disk is full, or a path may not be written; names the path and says what to do next."""


class Refused(ValueError):
    """A file that is refused before it is read; names it and says what to do."""


# -- writing -----------------------------------------------------------------------------------


@contextmanager
def writing(path: str | Path, advice: str) -> Iterator[None]:
    """Name the path, and say what to do next, if the disk is full or refuses a file.

    Args:
        path: file or folder that the block writes.
        advice: what to do next, such as "choose another --out".

    Raises:
        CannotWrite: in place of the system's error, whose `errno` it keeps.
    """
    try:
        yield
    except CannotWrite:
        raise
    except OSError as error:
        if error.errno in FULL:
            said = f"{path}: the disk is full{_space(Path(path))}: free some space, or {advice}"
        elif error.errno in REFUSED and _about(error, Path(path)):
            said = f"{path}: cannot be written ({error.strerror}): give yourself the right to, or {advice}"
        else:
            raise
        told = CannotWrite(said)
        told.errno = error.errno
        raise told from error


def _about(error: OSError, path: Path) -> bool:
    """Whether an error is about a path, its folders or its content, and not about another file."""
    if not isinstance(error.filename, str | bytes | os.PathLike):
        return True
    # Locks are named in full, and no ".." may hide that two paths are one.
    named, path = (Path(os.path.abspath(os.fsdecode(each))) for each in (error.filename, path))
    return named.is_relative_to(path) or path.is_relative_to(named)


def _space(path: Path) -> str:
    """The free space where a path is or would be, in words; empty if unknown."""
    there = next((place for place in (path, *path.absolute().parents) if place.exists()), None)
    try:
        return "" if there is None else f" ({shutil.disk_usage(there).free / 2**20:,.1f} MiB are free)"
    except OSError:
        return ""


def require_place(path: str | Path) -> None:
    """Refuse a path at which no file can be written, before what it is to hold is made.

    Raises:
        CannotWrite: a folder lies there, what should be its folder is a file, or cannot be made or written.
    """
    path = Path(path)
    if path.is_dir():
        raise CannotWrite(f"{path}: is a folder, expected the name of a file")
    there = next(place for place in (path, *path.absolute().parents) if place.exists())
    if there is not path and not there.is_dir():
        raise CannotWrite(f"{path}: {there} is a file, expected a folder")
    if not os.access(there, os.W_OK):
        raise CannotWrite(f"{path}: {there} may not be written to; give yourself the right to, or choose another place")
    if there is not path:
        _try_folder(path)


def _try_folder(path: Path) -> None:
    """Make the folder of a file that is to be written, and a file in it, and take away again what was made."""
    folder = path.absolute().parent
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        if error.errno in FULL:
            raise CannotWrite(f"{path}: the disk is full{_space(path)}: free some space, or choose another") from error
        what = "be made" if made else "take a file"
        raise CannotWrite(f"{path}: {folder} cannot {what} ({error.strerror}); choose another place") from error
    finally:
        for each in made:
            with suppress(OSError):  # somebody else may have put something there
                each.rmdir()


@contextmanager
def whole(path: str | Path) -> Iterator[Path]:
    """A path beside `path`, of the same suffix, that takes its place when the block ends well; its folder is made.

    So what was there before stays where the disk is full or somebody interrupts, and no half file is left. What is no
    plain file, such as `/dev/null`, is written as it is, and so is a file in a folder that takes no other. A file that
    is protected against writing stays, too: its own path is opened, which the system refuses.

    Args:
        path: the file that the block writes; of a link, the file that it leads to.

    Raises:
        CannotWrite: the disk is full, or the folder does not take files.
    """
    path = Path(path)
    with writing(path, "choose another place"):
        path.parent.mkdir(parents=True, exist_ok=True)
        target = Path(os.path.realpath(path))
        # Of the path and not of the target, which a pipe behind /dev/stdout does not have.
        if path.exists() and not (path.is_file() and os.access(target, os.W_OK) and os.access(target.parent, os.W_OK)):
            yield path
            return
        part = target.with_name(f".{secrets.token_hex(8)}.part{target.suffix}")
        try:
            yield part
            if target.exists():
                with suppress(OSError):  # some network file systems have no modes, and the file is finished
                    shutil.copymode(target, part)
            part.replace(target)
        except OSError as error:
            if str(error.filename) != str(part):
                raise
            raise OSError(error.errno, error.strerror, str(path)) from error  # by the name that is known outside
        finally:
            part.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> Path:
    """A text file of UTF-8, whole or not at all; see `whole`. Returns the path."""
    with whole(path) as part:
        part.write_text(text, encoding="utf-8")
    return Path(path)


def file_word(text: str) -> str:
    """A name as part of a file's: letters, digits and marks of letters, of any script, composed; `_` for all between.

    >>> file_word("cafe\u0301 #2"), file_word("\u0928\u0943\u0924\u094d\u092f/1") == "\u0928\u0943\u0924\u094d\u092f_1"
    ('café_2', True)
    """
    word = ""
    for sign in unicodedata.normalize("NFC", text):
        mark = unicodedata.category(sign) in ("Mn", "Mc") and not "\ufe00" <= sign <= "\ufe0f"  # which choose a picture
        if sign.isalnum() or (mark and word[-1:] not in ("", "_")):
            word += sign
        elif sign not in JOINERS and not word.endswith("_"):
            word += "_"
    return word.strip("_")


class HashedFile:
    """Hashes a file while it is written, and keeps an error that a library may replace by its own."""

    def __init__(self, file: BinaryIO) -> None:
        self.file, self.digest = file, hashlib.sha256()
        self.failed: OSError | None = None

    def write(self, data: Any) -> int:
        self.digest.update(data)
        try:
            return self.file.write(data)
        except OSError as error:
            self.failed = error
            raise

    def flush(self) -> None:
        self.file.flush()


def write_whole(
    folder: Path,
    name: str | Callable[[str], str],
    content: bytes | Callable[[Any], object],
    ready: Callable[[str], object] | None = None,
    advice: str = "choose another folder; then run the same command again, which keeps what is finished",
) -> tuple[str, str]:
    """All of a file or none: written aside, synced, renamed. Returns its name and sha256.

    Args:
        folder: an existing folder.
        name: the file's name, or a function of its sha256.
        content: all bytes, or a function of an object with `write(bytes)`.
        ready: called with the sha256 when the file is whole, before it is renamed.
        advice: what to do if the disk is full.

    Raises:
        CannotWrite: the disk is full, or the folder does not take files; nothing is left behind.
    """
    aside = folder / f".new-{secrets.token_hex(8)}"
    with writing(folder, advice):
        opened = aside.open("xb")  # for others to read where the umask lets them
    try:
        with writing(folder, advice):
            with opened as file:
                hashed = HashedFile(file)
                try:
                    hashed.write(content) if isinstance(content, bytes) else content(hashed)
                except Exception as error:
                    raise hashed.failed or error from error
                file.flush()
                os.fsync(file.fileno())
            digest = hashed.digest.hexdigest()
            if ready is not None:
                ready(digest)
            called = name if isinstance(name, str) else name(digest)
            os.replace(aside, folder / called)
    except BaseException:
        aside.unlink(missing_ok=True)
        raise
    sync(folder)
    return called, digest


class Taken(OSError):
    """Another process holds a lock."""


@contextmanager
def alone(lock: Path, taken: str) -> Iterator[None]:
    """Hold a lock meanwhile, which goes with the process, however it ends. taken: the message where another has it

    Its file is removed while it is held, for once it is let go, another process may hold that very file. One that has
    opened it by now is not let in by a file without a name: filelock looks (3.29.5 and later). Some network file
    systems have no locks: there nobody is kept out.

    Raises:
        Taken: another process has it.
    """
    from filelock import FileLock, Timeout  # brings asyncio, which the first words of a command need not wait for

    try:
        held: AbstractContextManager[object] = FileLock(lock, timeout=0).acquire()
    except Timeout as error:
        raise Taken(taken) from error
    except OSError as error:
        if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP):
            raise
        held = nullcontext()
    with held:
        try:
            yield
        finally:
            with suppress(OSError):  # on Windows filelock removes it as it lets go
                lock.unlink()


def sync(folder: Path) -> None:
    """Write the renames in a folder to the disk, where it takes that: Windows opens no folder, and needs none."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except PermissionError:
        return
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EOPNOTSUPP):  # of network file systems that sync no folders
            raise
    finally:
        os.close(handle)


def file_hash(path: Path) -> str:
    """sha256 of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


# -- reading -----------------------------------------------------------------------------------


def regular(path: Path) -> Path:
    """The path, if a plain file or a link to one is there; reading a pipe or a device would never end.

    Raises:
        FileNotFoundError: nothing is there, or a link leads nowhere.
        Refused: it is something else.
    """
    if not path.exists():
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))
    if not path.is_file():
        what = "a folder" if path.is_dir() else "a pipe, a socket or a device"
        raise Refused(f"{path}: is {what}, expected a file; copy the file itself there")
    return path


def said_sign(line: str) -> str | None:
    """The sign between a table's columns, where its first line says it to spreadsheets; None: it says something else.

    >>> said_sign("sep=;\\n"), said_sign("frame;person\\n")
    (';', None)
    """
    match = re.fullmatch(r'"?sep=(.)"?[,;\t]*\s*', line, re.IGNORECASE)
    return match[1] if match else None


def inside(folder: Path, name: Any) -> Path:
    """The file of a folder that an index names. The name must be plain, so that no index leads out of its folder.

    Raises:
        Refused: it is a path, or no name at all.
    """
    if not isinstance(name, str) or name in ("", ".", "..") or set("/\\\0") & set(name):
        raise Refused(f"{folder}: its index names {name!r:.80}, expected the name of a file in it; make it anew")
    return folder / name


def suffixed(path: str | Path, suffix: str) -> Path:
    """The path with a suffix, behind whatever its name ends in: a name may have points of its own.

    >>> suffixed("my.model.v2", ".npz").name, suffixed("dance.NPZ", ".npz").name
    ('my.model.v2.npz', 'dance.NPZ')
    """
    path = Path(path)
    return path if path.suffix.lower() == suffix else path.with_name(path.name + suffix)


def npz_path(path: str | Path, others: str) -> Path:
    """The path of an npz, with its suffix where there is none.

    Args:
        path: of an npz, with its suffix or without any.
        others: what the message says of other suffixes.

    Raises:
        ValueError: the path has another suffix.
    """
    path = Path(path)
    if path.suffix.lower() not in ("", ".npz"):
        raise ValueError(f"{path.name}: got suffix {path.suffix}, expected .npz or none; {others}")
    return path if path.suffix else path.with_name(path.name + ".npz")


def save_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write a whole compressed npz under exactly this name: numpy adds .npz to names that end in .NPZ."""
    with whole(path) as part, part.open("wb") as file:
        np.savez_compressed(file, **arrays)


DAMAGED = (EOFError, OverflowError, RuntimeError, zipfile.BadZipFile, zlib.error, tokenize.TokenError)
"""What reading a damaged npz raises besides `ValueError`: of its archive, its packed numbers, its arrays' heads."""


def load_npz(path: str | Path, names: Collection[str] | None = None) -> Any:
    """Open an npz without pickles, unless it unpacks to far more than its size.

    Args:
        path: the file.
        names: arrays that will be read; None: any.

    Raises:
        FileNotFoundError: no such file.
        Refused: not a file, or an array that would unpack to more than 64 MiB and 100 times its packed size.
        zipfile.BadZipFile: not an npz; of a damaged one, and when its arrays are read, any of `DAMAGED`.
    """
    with zipfile.ZipFile(regular(Path(path))) as archive:
        for member in archive.infolist():
            key = member.filename.removesuffix(".npy")
            if names is not None and key not in names:
                continue
            if member.file_size > ANYHOW + RATIO * member.compress_size:
                raise Refused(
                    f"{path}: {key!r:.80} would unpack from {member.compress_size / 2**20:,.1f} to "
                    f"{member.file_size / 2**20:,.0f} MiB, expected at most {RATIO} times as much: no recording is so "
                    f"even; do not use the file"
                )
    return np.load(path, allow_pickle=False)
