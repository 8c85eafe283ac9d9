"""A prepared store on disk: rows of frames in shards, an index of clips, and a manifest that is written last.

manifest.json            what it is made from, with a checksum of every other file; its rename is the commit
clips-HASH.json          columns: name, take, split, frames, people, persons, of clips in the order of their rows
betas-HASH.npy           (people of all clips, 10) float32
SPLIT-NNNNN-HASH.npy     (rows,) of `ROW`; a clip's people one after the other, a row a frame; clips in order
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from magnet.body import Body
from magnet.datamodules.clip import SPLITS, Clip, Ints, Split
from magnet.datamodules.store.rows import ROW, encode, scene_of
from magnet.files import DAMAGED, inside

FORMAT = 1
MANIFEST = "manifest.json"
STATE = ".prepare"
"""Folder of a store with what a later `prepare` goes on from; not part of the store."""


class StoreError(ValueError):
    """A folder is no store, is damaged, or is of a later version; the message says what to do."""


def holds_store(path: Path) -> bool:
    """Whether a folder is a store, finished or damaged; a manifest.json of another program does not make it one."""
    if (path / STATE).is_dir():
        return True
    try:
        return _is_manifest(json.loads((path / MANIFEST).read_text(encoding="utf-8")))
    except (FileNotFoundError, NotADirectoryError):
        return False
    except (OSError, ValueError):
        return True


def _is_manifest(found: object) -> bool:
    return isinstance(found, dict) and "format" in found


def body_hash(body: Body) -> str:
    """A hash of a body's joints at rest, which identifies the body whatever its file is called."""
    joints = body.J_template.numpy().tobytes() + body.J_shapedirs.numpy().tobytes()
    return hashlib.sha256(joints).hexdigest()


def as_json(value: Any) -> bytes:
    """A value as JSON: always the same bytes for the same value."""
    return (json.dumps(value, indent=1, sort_keys=True, ensure_ascii=False) + "\n").encode()


@dataclass(frozen=True)
class StoreSplit:
    """The clips of one split: parallel columns, and shards that hold their rows in the same order."""

    name: list[str]
    take: list[str]
    source: list[str]  # what mixture weights refer to
    frames: Ints
    people: Ints
    betas: NDArray[np.float32]  # (people of all clips, 10)
    files: list[Path]
    ends: Ints  # rows up to the end of each shard
    persons: list[tuple[str, ...]]  # names or roles of each clip's people; () where the data set gives none
    slot_order: Ints  # (C, P) which person of a clip is shown as its first, second and so on
    fps: float
    body: str
    bad: Mapping[int, NDArray[np.bool_]] = field(default_factory=dict)  # clips with invalid frames: valid ones (T,)
    maps: dict[int, NDArray[np.void]] = field(default_factory=dict, repr=False)

    @staticmethod
    def encoded(clips: Sequence[Clip]) -> StoreSplit:
        """Clips in memory as the rows that a store would hold; at least one clip."""
        rows = [encode(clip.scene) for clip in clips]
        people, first = [clip.agents for clip in clips], clips[0].scene
        return StoreSplit(
            name=[clip.name for clip in clips],
            take=[clip.name for clip in clips],
            source=[clip.source for clip in clips],
            frames=np.array([clip.frames for clip in clips], dtype=np.int64),
            people=np.array(people, dtype=np.int64),
            betas=np.concatenate([clip.scene.betas[0].float().cpu().numpy() for clip in clips]),
            files=[Path("in memory")],
            ends=np.array([sum(map(len, rows))], dtype=np.int64),
            persons=[()] * len(clips),
            slot_order=np.tile(np.arange(max(people)), (len(clips), 1)),
            fps=first.fps,
            body=first.body,
            bad={c: good for c, clip in enumerate(clips) if not (good := clip.good()).all()},
            maps={0: np.concatenate(rows)},
        )

    @staticmethod
    def concatenate(parts: Sequence[StoreSplit]) -> StoreSplit:
        """Several parts one after the other, each with shards of its own.

        Raises:
            ValueError: bodies or rates differ.
        """
        first, clips, rows, shards = parts[0], 0, 0, 0
        most = max(part.slot_order.shape[1] for part in parts)
        ends: list[Ints] = []
        bad: dict[int, NDArray[np.bool_]] = {}
        maps: dict[int, NDArray[np.void]] = {}
        for part in parts:
            if (part.fps, part.body) != (first.fps, first.body):
                raise ValueError(
                    f"clip {part.name[0]}: {part.fps:g} fps and body {part.body}, but clip {first.name[0]} has "
                    f"{first.fps:g} fps and body {first.body}"
                )
            ends.append(part.ends + rows)
            bad |= {clips + c: good for c, good in part.bad.items()}
            maps |= {shards + k: shard for k, shard in part.maps.items()}
            clips, rows, shards = clips + len(part.name), int(ends[-1][-1]), shards + len(part.files)
        orders = [np.pad(part.slot_order, ((0, 0), (0, most - part.slot_order.shape[1]))) for part in parts]
        return StoreSplit(
            name=[name for part in parts for name in part.name],
            take=[take for part in parts for take in part.take],
            source=[source for part in parts for source in part.source],
            frames=np.concatenate([part.frames for part in parts]),
            people=np.concatenate([part.people for part in parts]),
            betas=np.concatenate([part.betas for part in parts]),
            files=[file for part in parts for file in part.files],
            ends=np.concatenate(ends),
            persons=[names for part in parts for names in part.persons],
            slot_order=np.concatenate(orders),
            fps=first.fps,
            body=first.body,
            bad=bad,
            maps=maps,
        )

    def shard(self, number: int) -> NDArray[np.void]:
        """The rows of a shard, mapped when first asked for.

        Raises:
            StoreError: the file is missing or is not what the manifest says.
        """
        if number not in self.maps:
            path, begin = self.files[number], int(self.ends[number - 1]) if number else 0
            try:
                rows = np.load(path, mmap_mode="r", allow_pickle=False)
            except (OSError, ValueError, *DAMAGED) as error:
                raise StoreError(f"{path}: the shard cannot be read ({error}); prepare the store again") from error
            if rows.dtype != ROW or rows.shape != (self.ends[number] - begin,):
                raise StoreError(
                    f"{path}: holds {rows.shape} rows, expected {self.ends[number] - begin}; prepare again"
                )
            self.maps[number] = rows
        return self.maps[number]

    @cached_property
    def first(self) -> Ints:
        """First row of each clip, over all shards."""
        rows = self.frames * self.people
        return np.cumsum(rows) - rows

    def rows(self, clip: int) -> NDArray[np.void]:
        """A clip's rows. -> (P, T) of `ROW`"""
        number = int(np.searchsorted(self.ends, self.first[clip], side="right"))
        begin = int(self.first[clip]) - (int(self.ends[number - 1]) if number else 0)
        count = int(self.frames[clip] * self.people[clip])
        return self.shard(number)[begin : begin + count].reshape(self.people[clip], self.frames[clip])

    @cached_property
    def last_person(self) -> Ints:
        """People up to the end of each clip."""
        return np.cumsum(self.people)

    def betas_of(self, clip: int) -> NDArray[np.float32]:
        """A clip's shapes. -> (P, 10)"""
        end = int(self.last_person[clip])
        return self.betas[end - int(self.people[clip]) : end]


def in_roles(persons: Sequence[Sequence[str]], roles: Sequence[str], slots: int) -> Ints:
    """The order in which each clip's people fill the slots: first who has the first role, and so on. -> (C, slots)

    "P1, actor" has the role "actor", and so has "Actor". People of none of the roles come last, in the order of the
    recording.
    """
    roles = [role.casefold() for role in roles]
    order = np.tile(np.arange(slots), (len(persons), 1))
    for clip, names in enumerate(persons if roles else []):
        words = [_words(name) for name in names]
        rank = [next((r for r, role in enumerate(roles) if role in mine), len(roles)) for mine in words]
        order[clip, : len(names)] = np.argsort(rank, kind="stable")
    return order


def _words(name: str) -> set[str]:
    """A person's name and the words in it, in lower case."""
    return {name.casefold(), *re.findall(r"[^\s,;:()]+", name.casefold())}


T = TypeVar("T")


class StoreReader:
    """A prepared store, opened: its manifest is read, rows are not.

    Raises:
        StoreError: not a store, of a later version, or files are missing or damaged.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path).expanduser()
        try:
            self.manifest: dict[str, Any] = json.loads((self.path / MANIFEST).read_text(encoding="utf-8"))
        except FileNotFoundError as error:
            if not self.path.exists():
                here = "" if self.path.is_absolute() else f" in {Path.cwd()}, where paths of a configuration count from"
                raise StoreError(
                    f"{self.path}: no such folder{here}; if the store lies elsewhere, give it with --data.path, else "
                    f"{_advice(self.path)}"
                ) from error
            raise StoreError(
                f"{self.path} is not a prepared store: it has no {MANIFEST}; {_advice(self.path)}"
            ) from error
        except (OSError, ValueError) as error:
            raise StoreError(f"{self.path / MANIFEST} cannot be read ({error}); prepare the store again") from error
        if not _is_manifest(self.manifest):
            raise StoreError(
                f"{self.path} is not a prepared store: its {MANIFEST} is of another program; {_advice(self.path)}"
            )
        if self.manifest["format"] != FORMAT:
            its = self.manifest["format"]
            raise StoreError(f"{self.path}: store format {its}, this version reads {FORMAT}; prepare it again")
        self.body: str = self.manifest["body"]["id"]
        self._splits: dict[tuple[Split, tuple[str, ...]], StoreSplit] = {}

    @property
    def fps(self) -> float:
        return float(self.manifest["fps"])

    @cached_property
    def _clips(self) -> dict[str, list[Any]]:
        return self._load("clips", lambda path: json.loads(path.read_text(encoding="utf-8")))

    @cached_property
    def _betas(self) -> NDArray[np.float32]:
        return self._load("betas", lambda path: np.load(path, allow_pickle=False))

    def _load(self, entry: str, read: Callable[[Path], T]) -> T:
        path = self._file(self.manifest[entry])
        try:
            return read(path)
        except (OSError, ValueError, *DAMAGED) as error:
            raise StoreError(f"{path}: the {entry} cannot be read ({error}); prepare the store again") from error

    def _file(self, entry: Any) -> Path:
        """A file that the manifest names; it lies in the store's own folder, wherever the store came from."""
        try:
            return inside(self.path, entry["file"])
        except (ValueError, KeyError, TypeError) as error:
            raise StoreError(f"{self.path / MANIFEST}: damaged ({error}); prepare the store again") from error

    def require_roles(self, roles: Sequence[str]) -> None:
        """Refuse a role that nobody in the store has."""
        named = {name for entry in self.manifest.get("persons", []) for name in entry["persons"]}
        had = {word for name in named for word in _words(name)}
        for role in roles:
            if role.casefold() not in had:
                some = ", ".join(sorted(named)[:8]) or "without names"
                raise ValueError(f"roles: got {role}, which nobody in {self.path} has; its people are {some}")

    def split(self, split: Split, roles: tuple[str, ...] = ()) -> StoreSplit:
        """The clips of a split, people in the order of `roles` as `in_roles` says; no clips where it is empty."""
        if (split, roles) not in self._splits:
            self._splits[split, roles] = self._split(split, roles)
        return self._splits[split, roles]

    def _split(self, split: Split, roles: tuple[str, ...]) -> StoreSplit:
        table = self._clips
        mine = [i for i, name in enumerate(table["split"]) if name == split]
        people = np.array(table["people"], dtype=np.int64)
        end = np.cumsum(people)
        low, high = (int(end[mine[0]] - people[mine[0]]), int(end[mine[-1]])) if mine else (0, 0)
        people = people[mine] if mine else people[:0]
        persons = [tuple(table["persons"][i]) for i in mine]
        shards = self.manifest["splits"][split]["shards"]
        return StoreSplit(
            name=[table["name"][i] for i in mine],
            take=[table["take"][i] for i in mine],
            source=[self.manifest["name"]] * len(mine),
            frames=np.array([table["frames"][i] for i in mine], dtype=np.int64),
            people=people,
            betas=self._betas[low:high],
            files=[self._file(shard) for shard in shards],
            ends=np.cumsum([shard["rows"] for shard in shards], dtype=np.int64),
            persons=persons,
            slot_order=in_roles(persons, roles, int(people.max(initial=1))),
            fps=self.fps,
            body=self.body,
        )

    def clips(self, split: Split, roles: tuple[str, ...] = ()) -> list[Clip]:
        """All clips of a split in memory, people in the order of `roles`."""
        part = self.split(split, roles)
        clips = []
        for c, name in enumerate(part.name):
            order = part.slot_order[c, : part.people[c]]
            scene = scene_of(part.rows(c)[order], part.betas_of(c)[order], self.body, self.fps, name)
            clips.append(Clip(scene, name, self.manifest["name"], split))
        return clips

    def files(self) -> dict[str, str]:
        """Every file of the store but the manifest, and its sha256."""
        manifest = self.manifest
        shards = [shard for split in SPLITS for shard in manifest["splits"][split]["shards"]]
        return {self._file(entry).name: entry["sha256"] for entry in (manifest["clips"], manifest["betas"], *shards)}


def _advice(path: Path) -> str:
    if (path / STATE).is_dir():
        return "a prepare that has not finished lies there: run the same magnet data prepare again"
    return "make one with: magnet data prepare NAME --root DOWNLOAD --out STORE"
