"""Which files of a user's folder are people of one scene: by their names, by a pattern, or by a table."""

from __future__ import annotations

import csv
import math
import re
import shlex
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from magnet.datamodules.reading.fields import files_under, natural
from magnet.datamodules.reading.recording import DataError
from magnet.export.unread import ADVICE, advice_for
from magnet.files import said_sign

TABLE = "people.csv"
"""The table that is taken without being named, where it lies in the folder."""
COLUMNS = ("scene", "person", "file", "role", "start")
NEEDED = ("scene", "file")

WORDS = (
    r"[a-h]|(?:p|person|actor|dancer|subject|player|performer|agent|skeleton|character)[ _.\-]?\d+"
    r"|leader|follower|lead|follow|actor|reactor|man|woman|male|female"
)
"""How the end of a file's name says whose it is; a number alone does not, for it may count takes."""
NAMED = re.compile(rf"(?P<scene>.*[^ _.\-])[ _.\-]+(?P<person>{WORDS})", re.IGNORECASE)
ONLY = re.compile(rf"(?P<person>{WORDS})", re.IGNORECASE)
"""A name that is nothing else: the folder is the scene then."""
HERE = "scene"
"""What the scene of such files is called where they lie in no folder of their own."""


@dataclass(frozen=True)
class PersonFile:
    """One person's file.

    Args:
        person: a name or role; "" where nothing tells.
        file: where it is.
        start: second of the scene's clock at which its first frame lies; None: nothing says it.
    """

    person: str
    file: Path
    start: float | None = None


@dataclass(frozen=True)
class SceneFiles:
    """A scene and its people's files.

    Args:
        scene: its name.
        people: one a file, in the order of people.
        alone: its one file is named like one of several people's, and there is no other.
    """

    scene: str
    people: tuple[PersonFile, ...]
    alone: bool = False


def files_of(root: Path, suffixes: Sequence[str]) -> list[Path]:
    """All files of these suffixes under a folder, take 10 after take 9; hidden ones are left out."""
    found = [
        path
        for path in files_under(root)
        if path.suffix.lower() in suffixes
        and (path.is_file() or not path.exists())
        and not any(part.startswith(".") for part in path.relative_to(root).parts)
    ]
    return sorted(found, key=lambda path: (natural(path.relative_to(root).as_posix()), path.as_posix()))


def of_others(root: Path) -> str:
    """How other files of motion under a folder become files that are read, to end an error with; "" of none."""
    tables = [path for path in files_of(root, (".csv",)) if path.name != TABLE]
    if not tables:
        return advice_for(path.suffix.lower() for path in files_of(root, tuple(ADVICE)))
    export = shlex.join(["magnet", "export", str(tables[0]), f"scenes/{tables[0].stem}.npz"])
    return (
        f"; of tables of joint positions make scenes first, one by one: {export}, then magnet data prepare scenes "
        "--root scenes store (docs/own.md)"
    )


# -- by names ----------------------------------------------------------------------------------


def by_names(root: Path, files: Iterable[Path]) -> list[SceneFiles]:
    """Files whose names differ in the last word alone, such as dance_A and dance_B; in a folder, A and B alone.

    Everybody else is alone in a scene.
    """
    told = [_told(root, path) for path in files]
    members = Counter(scene for scene, person, _ in told if person)
    together: dict[str, list[PersonFile]] = {}
    alone: set[str] = set()
    for scene, person, path in told:
        whole = _label(root, path)
        if person and members[scene] > 1:
            together.setdefault(scene, []).append(PersonFile(person, path))
            continue
        while (whole in members and members[whole] > 1) or whole in together:
            whole += path.suffix
        together[whole] = [PersonFile("", path)]
        if person:
            alone.add(whole)
    _require_names_once(together, "name it otherwise")
    return [SceneFiles(scene, tuple(people), scene in alone) for scene, people in together.items()]


def _require_names_once(together: Mapping[str, Sequence[PersonFile]], advice: str) -> None:
    """Refuse a scene with two files of one person, who would be two people."""
    for scene, people in together.items():
        seen: dict[str, Path] = {}
        for each in people:
            if each.person and each.person in seen:
                both = f"{seen[each.person]} and {each.file}"
                raise DataError(f"{both} are both {each.person!r} of the scene {scene!r}: leave one out, or {advice}")
            seen[each.person] = each.file


def _label(root: Path, path: Path) -> str:
    return path.relative_to(root).with_suffix("").as_posix()


def _told(root: Path, path: Path) -> tuple[str, str, Path]:
    """Scene and person that a file's name tells, and the file; person "" where it tells none."""
    folder = path.parent.relative_to(root).as_posix()
    inside = "" if folder == "." else f"{folder}/"
    if match := NAMED.fullmatch(path.stem):
        return inside + match["scene"], match["person"], path
    if match := ONLY.fullmatch(path.stem):
        return folder if inside else HERE, match["person"], path
    return inside + path.stem, "", path


# -- by a pattern ------------------------------------------------------------------------------


def by_pattern(root: Path, files: Iterable[Path], pattern: str) -> tuple[list[SceneFiles], list[Path]]:
    """Groups by a pattern of the path under `root` without its suffix, such as {scene}/{person} or {person}-{scene}.

    A `*` stands for anything but a slash. Also returns the files that do not fit.

    Raises:
        ValueError: the pattern lacks {scene} or {person}, or holds one twice.
        DataError: two files are of one person of a scene.
    """
    if any(pattern.count(word) != 1 for word in ("{scene}", "{person}")):
        raise ValueError(
            f"pattern: got {pattern!r}, expected {{scene}} and {{person}} once each, as {{scene}}/{{person}}"
        )
    words = {"{scene}": "(?P<scene>.+)", "{person}": "(?P<person>[^/]+?)", "*": "[^/]*"}
    parts = re.split(r"(\{scene\}|\{person\}|\*)", pattern)
    form = re.compile("".join(words.get(part, re.escape(part)) for part in parts))
    together: dict[str, list[PersonFile]] = {}
    strangers = []
    for path in files:
        if match := form.fullmatch(_label(root, path)):
            together.setdefault(match["scene"], []).append(PersonFile(match["person"], path))
        else:
            strangers.append(path)
    _require_names_once(together, "let {scene} take in the folder, as {scene}_{person} does without */ before it")
    return [SceneFiles(scene, tuple(people)) for scene, people in together.items()], strangers


# -- by a table --------------------------------------------------------------------------------


def by_table(root: Path, table: Path, suffixes: Sequence[str]) -> list[SceneFiles]:
    """Groups by a CSV with a head: scene and file (under `root`), and, where they are wanted, person, role and start.

    Raises:
        DataError: a column is missing or unknown, a file is not there, lies elsewhere, is of another kind or is named
            twice, or a start is no number of seconds; names the line.
    """
    together: dict[str, list[PersonFile]] = {}
    used: dict[Path, int] = {}
    for number, row in _rows(table):
        where = f"{table}, line {number}"
        file = _file(where, root, row["file"], suffixes)
        if file in used:
            raise DataError(f"{where}: {row['file']} is named in line {used[file]} already: leave one of them out")
        used[file] = number
        person = " ".join(filter(None, (row.get("person", ""), row.get("role", ""))))
        together.setdefault(row["scene"], []).append(PersonFile(person, file, _seconds(where, row.get("start", ""))))
    if not together:
        raise DataError(f"{table}: lists no file; expected a row a file with {', '.join(COLUMNS)}: write them")
    _require_names_once(together, f"name another scene or person in {table}")
    return [SceneFiles(scene, tuple(people)) for scene, people in together.items()]


def _rows(table: Path) -> list[tuple[int, dict[str, str]]]:
    """Rows that hold anything, with their lines."""
    try:
        lines = table.read_text(encoding="utf-8-sig").splitlines()
    except FileNotFoundError as error:
        raise DataError(f"{table}: no such file; give a CSV with the columns {', '.join(COLUMNS)}") from error
    except (OSError, ValueError) as error:
        raise DataError(f"{table}: cannot be read as text ({error}); save it as CSV in UTF-8") from error
    said = said_sign(lines[0]) if lines else None
    above = int(said is not None)  # lines before the columns' names
    first = lines[above] if len(lines) > above else ""
    mark = said or max(",;\t", key=first.count)
    head = [word.strip().lower() for word in next(csv.reader([first], delimiter=mark), [])]
    strange, lacking = sorted(set(head) - set(COLUMNS)), [name for name in NEEDED if name not in head]
    if strange or lacking or len(set(head)) < len(head):
        raise DataError(
            f"{table}, line {1 + above}: the columns are {', '.join(head) or 'none'}; expected {', '.join(NEEDED)}, "
            "and of person, role and start those that you want: mend it"
        )
    found = []
    for number, line in enumerate(lines[1 + above :], 2 + above):
        words = [word.strip() for word in next(csv.reader([line], delimiter=mark), [])]
        if not any(words):
            continue
        if len(words) != len(head) or not all(words[head.index(name)] for name in NEEDED):
            raise DataError(f"{table}, line {number}: got {line!r}, expected {', '.join(head)}; mend that line")
        found.append((number, dict(zip(head, words, strict=True))))
    return found


def _file(where: str, root: Path, name: str, suffixes: Sequence[str]) -> Path:
    path = root / name
    if not path.resolve().is_relative_to(root.resolve()):
        raise DataError(f"{where}: {name} lies outside {root}; put it inside, and name it from there")
    if path.suffix.lower() not in suffixes:
        raise DataError(f"{where}: {name} is no {' or '.join(suffixes)} file")
    if not path.is_file():
        raise DataError(f"{where}: {name}: no such file under {root}; names are relative to that folder")
    return path


def _seconds(where: str, text: str) -> float | None:
    if not text:
        return None
    try:
        start = float(text)
    except ValueError:
        start = math.nan
    if not math.isfinite(start):
        raise DataError(f"{where}: start is {text!r}, expected seconds on the scene's clock, such as 1.25: mend it")
    return start
