"""Parts of takes to the shards, index and manifest of a store: in the order of takes, so that bytes do not vary."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magnet.datamodules.clip import SPLITS, Split
from magnet.datamodules.preparing.convert import ConvertedTake
from magnet.datamodules.reading.recording import Take
from magnet.datamodules.store.reader import FORMAT, MANIFEST, StoreReader, as_json
from magnet.datamodules.store.rows import ROW
from magnet.files import write_whole
from magnet.motion.scene import FPS


@dataclass(frozen=True)
class PackSource:
    """Where a take's rows are: in its part, or still in the present store."""

    take: Take
    file: Path
    place: dict[str, Any] | None  # in the present store

    def load(self, old: StoreReader | None, rows: bool = True) -> ConvertedTake:
        """The take, with or without its rows, which are most of it. old: the present store"""
        if self.place is None or old is None:
            return ConvertedTake.load(self.file, rows)
        split, first, count = self.place["split"], self.place["first"], self.place["clips"]
        part = old.split(split)
        mine = range(first, first + count)
        return ConvertedTake(
            error=None,
            notes=tuple(self.place["notes"]),
            names=tuple(part.name[c] for c in mine),
            frames=tuple(int(part.frames[c]) for c in mine),
            people=tuple(int(part.people[c]) for c in mine),
            betas=np.concatenate([part.betas_of(c) for c in mine]),
            rows=np.concatenate([part.rows(c).reshape(-1) for c in mine]) if rows else np.zeros(0, dtype=ROW),
            persons=part.persons[first],
        )


def pack(
    sources: list[PackSource], old: StoreReader | None, out: Path, facts: dict[str, Any], shard_rows: int
) -> dict[str, dict[str, Any]] | None:
    """Write the store; the manifest comes last, and until then the old one is whole.

    Returns where each take's clips are, by its name; None when no take gave any, and nothing was written.
    """
    pairs = [(source, source.load(old, rows=False)) for source in sources]
    if not any(head.names for _, head in pairs):
        return None
    table: dict[str, list[Any]] = {"name": [], "take": [], "split": [], "frames": [], "people": [], "persons": []}
    places: dict[str, dict[str, Any]] = {}
    betas: list[NDArray[np.float32]] = []
    shown: dict[str, Any] = {}
    for split in SPLITS:
        mine = [(source, head) for source, head in pairs if source.take.split == split and head.error is None]
        first = 0
        for source, head in mine:
            count = len(head.names)
            places[source.take.name] = {"split": split, "first": first, "clips": count, "notes": list(head.notes)}
            first += count
            table["name"] += head.names
            table["take"] += [source.take.name] * count
            table["split"] += [split] * count
            table["frames"] += head.frames
            table["people"] += head.people
            table["persons"] += [head.persons] * count
            betas.append(head.betas)
        shards = [
            write_shard(out, split, number, rows, [source for source, _ in group], old)
            for number, (rows, group) in enumerate(groups(mine, shard_rows))
        ]
        frames, people = ([n for _, head in mine for n in getattr(head, key)] for key in ("frames", "people"))
        shown[split] = split_counts(len(mine), frames, people) | {"shards": shards}
    failed = [(source.take, head.error) for source, head in pairs if head.error is not None]
    notes = [(note, source.take.name) for source, head in pairs for note in head.notes]
    persons = [(head.persons, source.take.name) for source, head in pairs if head.error is None]
    shapes = np.concatenate(betas).astype("<f4")
    manifest = {
        **facts,
        "format": FORMAT,
        "fps": FPS,
        "clips": _written(out, "clips", "json", as_json(table)),
        "betas": _written(out, "betas", "npy", lambda file: np.lib.format.write_array(file, shapes, version=(1, 0))),
        "splits": shown,
        "skipped": [{"take": take.name, "split": take.split, "why": why} for take, why in failed],
        "notes": [{"note": note, "takes": takes} for note, takes in by_first(notes)],
        "persons": [{"persons": names, "takes": takes} for names, takes in by_first(persons) if names],
    }
    write_whole(out, MANIFEST, as_json(manifest))
    return places


def by_first(pairs: list[tuple[Any, str]]) -> list[tuple[Any, list[str]]]:
    """The second ones of each first one, in the order of first ones."""
    found: dict[Any, list[str]] = {}
    for first, second in pairs:
        found.setdefault(first, []).append(second)
    return list(found.items())


def groups(
    mine: list[tuple[PackSource, ConvertedTake]], most: int
) -> Iterator[tuple[int, list[tuple[PackSource, ConvertedTake]]]]:
    """Takes in order, as many to a shard as fit; with each shard's number of rows."""
    held: list[tuple[PackSource, ConvertedTake]] = []
    rows = 0
    for source, head in mine:
        count = sum(f * p for f, p in zip(head.frames, head.people, strict=True))
        if held and rows + count > most:
            yield rows, held
            held, rows = [], 0
        held.append((source, head))
        rows += count
    if held:
        yield rows, held


def write_shard(
    out: Path, split: Split, number: int, rows: int, sources: list[PackSource], old: StoreReader | None
) -> dict[str, Any]:
    """One npy of `rows` rows, streamed take by take. Returns its entry in the manifest."""

    def write(file: Any) -> None:
        np.lib.format.write_array_header_1_0(
            file, {"descr": np.lib.format.dtype_to_descr(ROW), "fortran_order": False, "shape": (rows,)}
        )
        for source in sources:
            file.write(np.ascontiguousarray(source.load(old).rows).tobytes())

    return {**_written(out, f"{split}-{number:05d}", "npy", write), "rows": rows}


def _written(out: Path, name: str, suffix: str, content: bytes | Callable[[Any], object]) -> dict[str, str]:
    """A file named by its content. Returns its entry in the manifest."""
    file, digest = write_whole(out, lambda digest: f"{name}-{digest[:8]}.{suffix}", content)
    return {"file": file, "sha256": digest}


def split_counts(takes: int, frames: Sequence[int], people: Sequence[int]) -> dict[str, Any]:
    """What the manifest says of a split, from the frames and people of each of its clips."""
    return {
        "takes": takes,
        "clips": len(frames),
        "frames": sum(frames),
        "person frames": sum(f * p for f, p in zip(frames, people, strict=True)),
        "clips by people": {str(n): count for n, count in sorted(Counter(people).items())},
    }
