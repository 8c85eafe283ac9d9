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
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magnet.body import Body
from magnet.datamodules.clip import SPLITS, Clip, Ints, Split
from magnet.datamodules.store.rows import ROW, scene_of
from magnet.files import inside

FORMAT = 1
MANIFEST = "manifest.json"
STATE = ".prepare"
"""Folder of a store with what a later `prepare` goes on from; not part of the store."""


class StoreError(ValueError):
    """A folder that is no store, is damaged, or is of a later version; says what to do."""


def body_hash(body: Body) -> str:
    """What stored shape numbers belong to: a hash of the joints at rest, whatever the file was called."""
    joints = body.J_template.numpy().tobytes() + body.J_shapedirs.numpy().tobytes()
    return hashlib.sha256(joints).hexdigest()


def as_json(value: Any) -> bytes:
    """Always the same bytes for the same value."""
    return (json.dumps(value, indent=1, sort_keys=True, ensure_ascii=False) + "\n").encode()


# -- reading -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class StoreSplit:
    """The clips of one split: parallel columns, and shards that hold their rows in the same order."""

    name: list[str]
    take: list[str]
    frames: Ints
    people: Ints
    betas: NDArray[np.float32]  # (people of all clips, 10)
    files: list[Path]
    ends: Ints  # rows up to the end of each shard
    persons: list[tuple[str, ...]] = field(default_factory=list)  # names or roles; none where none are known
    maps: dict[int, NDArray[np.void]] = field(default_factory=dict, repr=False)

    @staticmethod
    def concatenate(parts: Sequence[StoreSplit]) -> StoreSplit:
        """Several parts one after the other, each with shards of its own."""
        before = np.cumsum([0, *(int(part.ends[-1]) for part in parts)])
        maps: dict[int, NDArray[np.void]] = {}
        number = 0
        for part in parts:
            maps |= {number + k: rows for k, rows in part.maps.items()}
            number += len(part.files)
        return StoreSplit(
            name=[name for part in parts for name in part.name],
            take=[take for part in parts for take in part.take],
            frames=np.concatenate([part.frames for part in parts]),
            people=np.concatenate([part.people for part in parts]),
            betas=np.concatenate([part.betas for part in parts]),
            files=[file for part in parts for file in part.files],
            ends=np.concatenate([part.ends + rows for part, rows in zip(parts, before[:-1], strict=True)]),
            persons=[names for part in parts for names in part.persons_of()],
            maps=maps,
        )

    def persons_of(self) -> list[tuple[str, ...]]:
        """Names or roles of each clip's people; () where the data set gives none."""
        return self.persons or [()] * len(self.name)

    def slot_order(self, roles: Sequence[str]) -> Ints:
        """Each clip's people in the order of their roles: the first whose name holds the first word, and so on. (C, P)

        People of none of the roles come last, in the order of the recording.
        """
        order = np.tile(np.arange(int(self.people.max(initial=1))), (len(self.name), 1))
        for clip, names in enumerate(self.persons_of() if roles else []):
            rank = [next((r for r, role in enumerate(roles) if role in words(name)), len(roles)) for name in names]
            order[clip, : len(names)] = np.argsort(rank, kind="stable")
        return order

    def shard(self, number: int) -> NDArray[np.void]:
        """The rows of a shard, mapped when first asked for.

        Raises:
            StoreError: the file is missing or is not what the manifest says.
        """
        if number not in self.maps:
            path, begin = self.files[number], int(self.ends[number - 1]) if number else 0
            try:
                rows = np.load(path, mmap_mode="r", allow_pickle=False)
            except (OSError, ValueError, EOFError) as error:
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


def words(name: str) -> set[str]:
    """What a person is called: the whole name and each word of it, so that "P1, actor" is an "actor"."""
    return {name, *re.findall(r"[^\s,;:()]+", name)}


class StoreReader:
    """A prepared store, opened: its manifest is read, rows are not.

    Raises:
        StoreError: not a store, of a later version, or files are missing or damaged.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path).expanduser()
        try:
            self.manifest: dict[str, Any] = json.loads((self.path / MANIFEST).read_text())
            version = self.manifest["format"]
        except FileNotFoundError as error:
            raise StoreError(
                f"{self.path} is not a prepared store: it has no {MANIFEST}; {_advice(self.path)}"
            ) from error
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise StoreError(f"{self.path / MANIFEST} cannot be read ({error}); prepare the store again") from error
        if version != FORMAT:
            raise StoreError(f"{self.path}: store format {version}, this version reads {FORMAT}; prepare it again")
        self._splits: dict[str, StoreSplit] = {}
        self.body: str = self.manifest["body"]["id"]

    @property
    def fps(self) -> float:
        return float(self.manifest["fps"])

    @cached_property
    def _clips(self) -> dict[str, list[Any]]:
        path = self._file(self.manifest["clips"])
        try:
            return json.loads(path.read_text())
        except (OSError, ValueError) as error:
            raise StoreError(f"{path}: the index cannot be read ({error}); prepare the store again") from error

    @cached_property
    def _betas(self) -> NDArray[np.float32]:
        path = self._file(self.manifest["betas"])
        try:
            return np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise StoreError(f"{path}: the shapes cannot be read ({error}); prepare the store again") from error

    def split(self, split: Split) -> StoreSplit:
        """The clips of a split; none where it is empty."""
        if split not in self._splits:
            self._splits[split] = self._part(split)
        return self._splits[split]

    def _file(self, entry: Any) -> Path:
        """A file that the manifest names; it lies in the store's own folder, wherever the store came from."""
        try:
            return inside(self.path, entry["file"])
        except (ValueError, KeyError, TypeError) as error:
            raise StoreError(f"{self.path / MANIFEST}: damaged ({error}); prepare the store again") from error

    def _part(self, split: Split) -> StoreSplit:
        table = self._clips
        mine = [i for i, name in enumerate(table["split"]) if name == split]
        people = np.array(table["people"], dtype=np.int64)
        end = np.cumsum(people)
        low, high = (int(end[mine[0]] - people[mine[0]]), int(end[mine[-1]])) if mine else (0, 0)
        shards = self.manifest["splits"][split]["shards"]
        return StoreSplit(
            name=[table["name"][i] for i in mine],
            take=[table["take"][i] for i in mine],
            frames=np.array([table["frames"][i] for i in mine], dtype=np.int64),
            people=people[mine] if mine else people[:0],
            betas=self._betas[low:high],
            files=[self._file(shard) for shard in shards],
            ends=np.cumsum([shard["rows"] for shard in shards], dtype=np.int64),
            persons=[tuple(table["persons"][i]) for i in mine] if "persons" in table else [],
        )

    def clips(self, split: Split, roles: Sequence[str] = ()) -> list[Clip]:
        """All clips of a split in memory, people in the order of `roles`, as `StoreSplit.slot_order` says."""
        part = self.split(split)
        slot_order = part.slot_order(roles)
        clips = []
        for c, name in enumerate(part.name):
            order = slot_order[c, : part.people[c]]
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
