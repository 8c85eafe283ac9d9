"""Fetch recordings of CMU's motion capture database from its own site, a subject at a time."""

from __future__ import annotations

import http.client
import os
import re
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from email.message import Message
from importlib import resources
from pathlib import Path

from magnet.datamodules.reading.cmu_subjects import folder_of
from magnet.errors import counted
from magnet.files import alone, file_hash, write_whole

SITE = "http://mocap.cs.cmu.edu"  # plain: the site's certificate chain is incomplete
MOST_SUBJECTS = 20
MANIFEST = "manifest.sha256"
LOCK = ".download.lock"
CHUNK = 1 << 16
EDGE = 2000
"""Lines at either end of a file that are looked at; a skeleton has fewer, a frame 30."""
LATER = (408, 425, 429, 500, 502, 503, 504)
Progress = Callable[[str, int, int | None], None]
"""Called with a file's name, its bytes so far and all its bytes, if the site says how many."""


class DownloadError(OSError):
    """The site cannot be reached or does not give what was asked for; says what to do."""


@dataclass(frozen=True)
class Downloaded:
    """What a download left in its folder; names are relative to it."""

    folder: Path
    fetched: tuple[str, ...]
    kept: tuple[str, ...]  # whole since an earlier run
    unlike: tuple[str, ...]  # taken although they are not the bytes that this project was tested with


@dataclass(frozen=True)
class Retries:
    """How patiently a file is asked for.

    Args:
        attempts: without a byte gained between them, before giving up.
        backoff: seconds before the second attempt, doubled for each later one.
        longest: seconds that no wait exceeds, whatever the site asks for.
        timeout: seconds without an answer that count as a failure.
        pause: seconds between two files, out of politeness.
    """

    attempts: int = 5
    backoff: float = 1.0
    longest: float = 60.0
    timeout: float = 30.0
    pause: float = 0.2

    def wait(self, failures: int, asked: float = 0.0) -> None:
        """Before the next attempt."""
        time.sleep(min(max(self.backoff * 2 ** (failures - 1), asked), self.longest))


def download_cmu(
    subjects: Iterable[int | str],
    out: str | Path,
    base_url: str = SITE,
    progress: Progress | None = None,
    retries: Retries | None = None,
    any_version: bool = False,
) -> Downloaded:
    """Skeletons and all recordings of subjects, in the folders that the data set `CMU` reads.

    Subjects 60 and 61 go to `salsa`, other couples to `couples`, all others to `singles`. A run that was stopped goes
    on where it was; files that are whole by `manifest.sha256`, which this writes and `sha256sum -c` reads, are not
    fetched again. A file whose SHA-256 is known, and differs, is refused when all others are done.

    Args:
        subjects: numbers such as 60; at most 20, because the database asks not to be crawled.
        out: folder, made if need be.
        base_url: of the site or a mirror laid out alike: search.php?subjectnumber=N and subjects/NN/NN_TT.amc.
        progress: told about every piece of every file.
        retries: how patiently.
        any_version: take files, too, that are not the bytes known; the site has issued some anew.

    Raises:
        ValueError: no subject, too many, or an address that is not http.
        DownloadError: the site cannot be reached, a file is not there or never whole, or not the one that is known.
        Taken: another download works in the folder: both would add to one file.
    """
    numbers = _numbers(subjects)
    if urllib.parse.urlsplit(base_url).scheme not in ("http", "https"):
        raise ValueError(f"base_url: got {base_url!r}, expected an address that begins with http:// or https://")
    base_url, folder, retries = base_url.rstrip("/"), Path(out).expanduser(), retries or Retries()
    folder.mkdir(parents=True, exist_ok=True)
    busy = f"another download is working in {folder}; wait for it, or choose another folder"
    with alone(folder / LOCK, busy):
        return _download(numbers, folder, base_url, progress, retries, any_version)


def _download(
    numbers: Sequence[int], folder: Path, base_url: str, progress: Progress | None, retries: Retries, any_version: bool
) -> Downloaded:
    listed = folder / MANIFEST
    manifest = _hashes(listed.read_text(encoding="utf-8", errors="replace")) if listed.is_file() else {}
    tested = known_hashes()
    fetched: list[str] = []
    kept: list[str] = []
    unlike: list[str] = []
    refused: list[str] = []
    for number in numbers:
        subject = f"{number:02}"
        for file in (f"{subject}.asf", *_recordings(number, base_url, retries)):
            name, known = _place(folder, number, file, manifest), tested.get(file)
            target = folder / name
            there = _whole(target, manifest.get(name))
            if not there:
                target.parent.mkdir(parents=True, exist_ok=True)
                part = _fetch(f"{base_url}/subjects/{subject}/{file}", target, retries, progress)
                time.sleep(retries.pause)
            found = file_hash(target if there else part)
            strange = known not in (None, found)
            if strange and not any_version:
                refused.append(f"{target}: its SHA-256 is {found}, expected {known}")
                if not there:
                    part.unlink()
                continue
            if strange:
                unlike.append(name)
            if not there:
                os.replace(part, target)
            (kept if there else fetched).append(name)
            if manifest.get(name) != found:
                manifest[name] = found
                lines = (f"{digest}  {each}\n" for each, digest in sorted(manifest.items()))
                write_whole(folder, MANIFEST, "".join(lines).encode())
    if refused:
        raise DownloadError(_refusal(refused))
    return Downloaded(folder, tuple(fetched), tuple(kept), tuple(unlike))


def _refusal(refused: list[str], most: int = 5) -> str:
    listed = "".join(f"\n  {line}" for line in refused[:most])
    more = f"\n  and {len(refused) - most} more" if len(refused) > most else ""
    return (
        f"refused: {counted(len(refused), 'file')} that this project was not tested with:{listed}{more}\n"
        "changed on the way, or the site has issued them anew: try again, or take them as they are with "
        "--any_version"
    )


def _place(folder: Path, number: int, file: str, manifest: Mapping[str, str]) -> str:
    """Where a subject's file goes, or lies already."""
    name, old = f"{folder_of(number)}/{file}", f"singles/{file}"
    return old if not (folder / name).exists() and _whole(folder / old, manifest.get(old)) else name


def _numbers(subjects: Iterable[int | str]) -> list[int]:
    numbers = []
    for subject in subjects:
        if not re.fullmatch(r"\d{1,3}", str(subject)) or not int(subject):
            raise ValueError(f"subject {subject!r}: expected a number such as 60")
        numbers.append(int(subject))
    numbers = list(dict.fromkeys(numbers))
    if not numbers:
        raise ValueError("no subject was given; give numbers such as 60 61")
    if len(numbers) > MOST_SUBJECTS:
        raise ValueError(
            f"{len(numbers)} subjects: the database asks not to be crawled; fetch its zip of all asf and amc files, "
            f"linked from {SITE}/faqs.php, and unpack it, or give at most {MOST_SUBJECTS}"
        )
    return numbers


# -- what there is -----------------------------------------------------------------------------


def _recordings(number: int, base_url: str, retries: Retries) -> list[str]:
    """Names of a subject's amc files, as its page lists them; else the folder itself."""
    subject = f"{number:02}"
    pages = [f"{base_url}/search.php?subjectnumber={number}", f"{base_url}/subjects/{subject}/"]
    said = []
    for page in pages:
        try:
            text = _page(page, retries)
        except DownloadError as error:
            if not isinstance(error.__cause__, urllib.error.HTTPError):
                raise
            said.append(str(error))
            continue
        if found := sorted(set(re.findall(rf"\b{subject}_\d{{2,3}}\.amc\b", text, flags=re.IGNORECASE))):
            return found
        said.append(f"{page}: lists no {subject}_NN.amc")
    raise DownloadError(f"subject {number} has no recordings: {'; '.join(said)}; {SITE}/subjects.php lists who has")


def _page(url: str, retries: Retries) -> str:
    failures = 0
    while True:
        try:
            with _open(url, {}, retries) as response:
                return response.read().decode("utf-8", errors="replace")
        except (OSError, http.client.HTTPException) as error:
            failures += 1
            _give_up_or_wait(error, url, failures, retries)


# -- one file ----------------------------------------------------------------------------------


def _fetch(url: str, target: Path, retries: Retries, progress: Progress | None) -> Path:
    """All of a file in a .part file beside `target`, or what there is of it there and an error. Returns that file."""
    part, tag = target.with_name(f"{target.name}.part"), target.with_name(f"{target.name}.part.tag")
    failures = 0
    while True:
        before = _size(part)
        try:
            total = _continue(url, part, tag, retries, progress)
        except (OSError, http.client.HTTPException) as error:
            failures = 1 if _size(part) > before else failures + 1
            _give_up_or_wait(error, url, failures, retries)
            continue
        if total is not None and _size(part) != total:
            reason = f"{_size(part):,} of {total:,} bytes came"
            failures = 1 if _size(part) > before else failures + 1
        elif reason := unsound(part, target.suffix):
            part.unlink()  # nothing of it can be trusted
            failures += 1
        else:
            tag.unlink(missing_ok=True)
            return part
        if failures >= retries.attempts:
            raise DownloadError(f"{url}: {reason}, {failures} times over; run the same command later")
        retries.wait(failures)


def _continue(url: str, part: Path, tag: Path, retries: Retries, progress: Progress | None) -> int | None:
    """Append what is missing of a file, or begin again if the site will not or has another file by now. -> all bytes"""
    offset, known = _size(part), tag.read_text(encoding="utf-8") if tag.exists() else ""
    headers = {"Range": f"bytes={offset}-", "If-Range": known} if offset and known else {}
    try:
        with _open(url, headers, retries) as response:
            start, total = _extent(response.status, response.headers)
            if start not in (0, offset):
                raise http.client.HTTPException(f"bytes from {start:,} came, from {offset:,} were asked for")
            tag.write_text(_validator(response.headers), encoding="utf-8")
            with part.open("ab" if start else "wb") as file:
                while chunk := response.read(CHUNK):
                    file.write(chunk)
                    if progress:
                        progress(part.stem, file.tell(), total)
            return total
    except urllib.error.HTTPError as error:
        if error.code != 416:
            raise
        if error.headers.get("Content-Range", "") == f"bytes */{offset}":
            return offset  # all of it was there already
        part.unlink()
        raise http.client.HTTPException(f"the site has nothing beyond {offset:,} bytes") from error


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _validator(headers: Message) -> str:
    """What tells this version of a file from others, so that a rest never joins another file's beginning."""
    etag = headers.get("ETag", "")
    return etag if etag and not etag.startswith("W/") else headers.get("Last-Modified", "")


def _extent(status: int, headers: Message) -> tuple[int, int | None]:
    """Where an answer begins and how long the whole file is."""
    if status == 206:
        said = headers.get("Content-Range", "")
        match = re.fullmatch(r"bytes (\d+)-(\d+)/(\d+|\*)", said)
        if match is None:
            raise http.client.HTTPException(f"a part of the file came that does not say which it is: {said!r}")
        return int(match[1]), int(match[2]) + 1 if match[3] == "*" else int(match[3])  # all up to the end was asked for
    length = headers.get("Content-Length", "")
    return 0, int(length) if length.isdigit() else None


def _open(url: str, headers: dict[str, str], retries: Retries) -> http.client.HTTPResponse:
    request = urllib.request.Request(url, headers={"User-Agent": "magnet-motion", **headers})
    return urllib.request.urlopen(request, timeout=retries.timeout)


def _give_up_or_wait(error: Exception, url: str, failures: int, retries: Retries) -> None:
    """Wait, or raise what a user can do something about."""
    asked = 0.0
    if isinstance(error, urllib.error.HTTPError):
        error.close()
        if error.code not in LATER:
            raise DownloadError(f"{url}: the site answers {error.code} {error.reason}") from error
        after = error.headers.get("Retry-After", "")
        asked = float(after) if after.isdigit() else 0.0
    if failures < retries.attempts:
        return retries.wait(failures, asked)
    host = urllib.parse.urlsplit(url).netloc
    why = getattr(error, "reason", None) or error
    raise DownloadError(
        f"{url}: {host} cannot be reached or does not answer ({why}), {failures} times over; are you online? Run the "
        f"same command later: it goes on from here"
    ) from error


def unsound(path: Path, kind: str) -> str:
    """Why a file cannot be a whole ASF or AMC file, or nothing: lengths that a site states may be wrong."""
    text = path.read_text("latin-1").splitlines()
    if len(text) > 2 * EDGE:  # the middle cannot be cut short
        text = text[:EDGE] + text[-EDGE:]
    lines = [words for line in text if (words := line.split("#")[0].split())]
    if kind.lower() == ".asf":
        heads = [words[0].lower() for words in lines]
        whole = ":bonedata" in heads and ":hierarchy" in heads and heads[-1] == "end"
        return "" if whole else "it is no whole ASF file (:bonedata and :hierarchy up to the last end)"
    frames = [number for number, words in enumerate(lines) if len(words) == 1 and words[0].isdigit()]
    if not frames:
        return "it is no AMC file (it has no frames)"
    bones = (frames[1] if len(frames) > 1 else len(lines)) - frames[0]
    first, last = lines[frames[0] :][:bones], lines[frames[-1] :]
    if [(words[0], len(words)) for words in first[1:]] != [(words[0], len(words)) for words in last[1:]]:
        return f"its last frame {last[0][0]} is not whole"
    return ""


# -- checksums ---------------------------------------------------------------------------------


def _whole(path: Path, known: str | None) -> bool:
    """The file is as it was fetched; one that was put there by hand is whole if it reads like one."""
    if not path.is_file():
        return False
    return file_hash(path) == known if known else not unsound(path, path.suffix)


def _hashes(text: str) -> dict[str, str]:
    return {name: found for found, name in re.findall(r"^([0-9a-f]{64})  (.+)$", text, flags=re.MULTILINE)}


def known_hashes() -> dict[str, str]:
    """Hashes of the files that this project was tested with, by name."""
    return _hashes((resources.files("magnet.datamodules") / "cmu.sha256").read_text(encoding="utf-8"))
