"""`magnet data check`: every assertion on a store or a download, what it holds, and a picture of some scenes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from magnet.body import Body, load_body
from magnet.datamodules import registry
from magnet.datamodules.clip import SPLITS, Split, at_least
from magnet.datamodules.preparing import check_people
from magnet.datamodules.preparing.convert import ConvertedTake, PrepareJob, convert_all
from magnet.datamodules.preparing.pack import split_counts
from magnet.datamodules.preparing.prepare import absent_note, select_takes, summary_of
from magnet.datamodules.preparing.progress import Tell
from magnet.datamodules.reading.fields import listing
from magnet.datamodules.reading.own import FEW, OwnReader, seconds_needed
from magnet.datamodules.reading.own_files import of_others
from magnet.datamodules.reading.recording import DataError, Reader, Take
from magnet.datamodules.store.reader import StoreError, StoreReader, StoreSplit, body_hash
from magnet.datamodules.store.rows import SCALE, scene_of
from magnet.errors import counted
from magnet.export.picture import contact_sheet
from magnet.files import file_hash
from magnet.motion.scene import FPS, Scene

UNIT = 2.0
"""By how much a stored quaternion's length may differ from the scale: rounding to whole numbers moves it by one."""
PELVIS = (-1.0, 6.0)
"""Metres over the floor that pelvises are found at, climbing and lifting included."""
HELD_OUT: dict[Split, str] = {"val": "to validate", "test": "to test"}
"""What parts of a recording are held out for."""
SHOWN, SHOWN_FRAMES = 4, 120
"""Clips in the picture, and frames of each."""


@dataclass
class CheckReport:
    """What a check found."""

    name: str  # of the data set
    title: str
    problems: list[str] = field(default_factory=list)
    splits: dict[str, dict[str, Any]] = field(default_factory=dict)  # as `split_counts` says; of those with clips
    skipped: list[tuple[str, str]] = field(default_factory=list)  # take, why
    notes: list[str] = field(default_factory=list)
    scenes: list[tuple[str, Scene]] = field(default_factory=list)  # for the picture
    limited: bool = False  # not all takes were asked for

    def count_skipped(self, takes: int, short: int = 0) -> None:
        """Skipped ones of so many takes are a problem, but for those that are only short."""
        broken = len(self.skipped) - short
        if not self.splits:
            self.problems.append(f"none of {takes} takes can be used")
        elif broken:
            self.problems.append(f"{broken} of {takes} takes broke an assertion; they are listed above")


def noted(note: str, takes: list[str]) -> str:
    """What was found, and of which take or how many."""
    return f"{note} ({takes[0] if len(takes) == 1 else f'{len(takes)} takes'})"


# -- a store -----------------------------------------------------------------------------------


def check_store(folder: StoreReader, body: Body | None = None, progress: Tell | None = None) -> CheckReport:
    """All of a store's files: checksums, then rows, and its body where one is given.

    What is wrong is collected, nothing raised. `progress` is told of files.
    """
    manifest = folder.manifest
    found = CheckReport(manifest["name"], manifest["title"], limited="limit" in manifest)
    files = folder.files()
    for number, (name, digest) in enumerate(sorted(files.items())):
        if progress is not None:
            progress(name, number, 2 * len(files))
        path = folder.path / name
        if not path.is_file():
            found.problems.append(f"{name} is missing; prepare the store again")
        elif file_hash(path) != digest:
            found.problems.append(f"{name} is damaged: its checksum is not the manifest's; prepare the store again")
    if body is not None and body_hash(body) != manifest["body"]["sha256"]:
        theirs = manifest["body"]["id"]
        found.problems.append(f"the store is of body {theirs!r}, and {body.id!r} has other joints at rest")
    found.skipped = [(entry["take"], entry["why"]) for entry in manifest["skipped"]]
    found.notes = [noted(entry["note"], entry["takes"]) for entry in manifest["notes"]]
    if absent := manifest.get("listed but not there"):
        found.notes.append(absent_note(absent))
    if found.problems:
        return found
    try:
        for split in SPLITS:
            _check_split(folder, split, found)
    except StoreError as error:
        found.problems.append(str(error))
    return found


def _check_split(folder: StoreReader, split: Split, found: CheckReport) -> None:
    part, said = folder.split(split), folder.manifest["splits"][split]
    counted = split_counts(len(set(part.take)), part.frames.tolist(), part.people.tolist())
    if counted["clips"]:
        found.splits[split] = counted
    for name in ("takes", "clips", "frames", "person frames"):
        if counted[name] != said[name]:
            found.problems.append(f"split {split}: the index has {counted[name]} {name}, the manifest {said[name]}")
    total = int(part.ends[-1]) if len(part.ends) else 0
    if total != counted["person frames"]:
        found.problems.append(f"split {split}: shards have {total} rows, the index {counted['person frames']}")
        return
    if len(set(part.name)) < len(part.name):
        found.problems.append(f"split {split}: clips are named twice")
    if not np.isfinite(part.betas).all():
        found.problems.append(f"split {split}: shape numbers hold NaN or infinity")
    for c, name in enumerate(part.name):
        wrong = _wrong_rows(part, c)
        for one in [wrong] if wrong else _wrong_people(part, c, own=not folder.manifest["body"].get("genders")):
            found.problems.append(f"clip {name}: {one}; prepare the store again")
    found.scenes += _scenes(folder, part, SHOWN - len(found.scenes))


def _wrong_rows(part: StoreSplit, clip: int) -> str | None:
    rows = part.rows(clip)
    length = np.sqrt(np.square(rows["rotations"].astype(np.float32)).sum(axis=-1))
    if np.abs(length - SCALE).max() > UNIT:
        return "rotations are not unit quaternions"
    pelvis = rows["pelvis"]
    if not np.isfinite(pelvis).all():
        return "pelvises hold NaN or infinity"
    low, high = float(pelvis[..., 1].min()), float(pelvis[..., 1].max())
    if low < PELVIS[0] or high > PELVIS[1]:
        return f"pelvises are {low:.1f} to {high:.1f} m over the floor, expected {PELVIS[0]:g} to {PELVIS[1]:g} m"
    return None


def _wrong_people(part: StoreSplit, clip: int, own: bool) -> list[str]:
    """By person and frame; shape numbers only where they are those of the data set, and not of another body."""
    names, rows = part.persons[clip], part.rows(clip)
    quat, pelvis = (rows[key].swapaxes(0, 1).astype(np.float32) for key in ("rotations", "pelvis"))
    quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
    valid = np.ones(pelvis.shape[:2], dtype=bool)
    flags = check_people.frozen(*check_people.held(pelvis, quat), valid) + check_people.jumps(quat, None, valid)
    said = check_people.described(flags, names, FPS, met=False)
    try:
        check_people.check_shapes(part.betas_of(clip) if own else part.betas_of(clip)[:0], names)
    except DataError as error:
        said.append(str(error))
    return said


def _scenes(folder: StoreReader, part: StoreSplit, most: int) -> list[tuple[str, Scene]]:
    """Some clips, evenly spread over those that are long enough."""
    longest = int(part.frames.max()) if len(part.frames) else 0
    good = np.flatnonzero(part.frames >= min(SHOWN_FRAMES, longest))
    count = min(most, 2, len(good))
    chosen_clips = good[np.arange(count) * len(good) // max(count, 1)]
    return [
        (part.name[c], scene_of(part.rows(c)[:, :SHOWN_FRAMES], part.betas_of(c), folder.body, FPS))
        for c in chosen_clips.tolist()
    ]


# -- a download --------------------------------------------------------------------------------


def _all(words: Sequence[str]) -> str:
    """a, b and c"""
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def recognise(root: Path) -> str:
    """Which data set's layout lies under a folder.

    Raises:
        ValueError: none does, or several do, or a table of a user's own recordings is wrong.
    """
    found = _readable(root, [name for name, kind in registry.readers().items() if not kind.own])
    found = found or _own(root)
    if len(found) == 1:
        return found[0]
    if found:
        own = [kind for name in found if issubclass(kind := registry.reader(name), OwnReader)]
        reads = " and ".join(f"{kind.name} reads {_all(kind.suffixes)}" for kind in own)
        alone = f"; {reads} alone, each as scenes of its own" if own else ""
        raise ValueError(f"{root} could be {' or '.join(found)}: say which with --name{alone}")
    raise ValueError(
        f"{root} is neither a prepared store nor a download that is known; it holds {listing(root)}; give "
        f"another folder, or say which data set it should be with --name, to be told what is missing{of_others(root)}"
    )


def _readable(root: Path, names: Sequence[str]) -> list[str]:
    """Those data sets whose reader finds takes."""
    found = []
    for name in names:
        with suppress(Exception, SystemExit):  # what this one lacks; a stranger's reader may raise anything
            found += [name] if registry.reader(name)(root).found() else []
    return found


def _own(root: Path) -> list[str]:
    """Which of a user's own kinds of files there are. What is wrong with a table of them is raised."""
    readers = []
    for kind in registry.readers().values():
        with suppress(ValueError, OSError):  # no such files
            readers += [kind(root)] if kind.own else []
    return [reader.name for reader in readers if reader.found()]


def check_download(
    job: PrepareJob,
    workers: int = 1,
    splits: dict[str, Split] | None = None,
    limit: int | None = None,
    progress: Tell | None = None,
) -> CheckReport:
    """Every take of a download read and canonicalized; nothing is written. Arguments are those of `prepare`.

    Raises:
        DataError: there are no takes at all.
        ValueError: a list of splits that does not fit, or a number out of range.
    """
    at_least(1, workers=workers, limit=limit)
    reader: Reader = job.reader()
    body = job.body()
    found = CheckReport(reader.name, reader.title, limited=limit is not None)
    use = select_takes(reader, splits, limit)
    takes = use.takes
    found.notes += summary_of(reader)
    if use.left_out:
        whose = "the data set's rule" if splits is None else "the list given"
        found.notes.append(f"in no split by {whose}: {counted(len(use.left_out), 'take')}")
    if use.absent:
        found.notes.append(absent_note(use.absent))
    notes: dict[str, list[str]] = {}
    parts: dict[str, ConvertedTake] = {}
    clips: dict[str, tuple[list[str], list[int], list[int]]] = {}
    for take, part in convert_all(job, takes, lambda take: None, workers, progress):
        if part.error is None and len(found.scenes) < SHOWN:
            found.scenes.append((part.names[0], _first_scene(part, body)))
        parts[take.name] = part.without_rows()  # downloads are larger than the memory
    for take in takes:
        part = parts[take.name]
        if part.error is not None:
            found.skipped.append((take.name, part.error))
            continue
        for note in part.notes:
            notes.setdefault(note, []).append(take.name)
        takes_of, frames, people = clips.setdefault(take.split or "train", ([], [], []))
        takes_of.append(take.name)
        frames += part.frames
        people += part.people
    found.splits = {split: split_counts(len(names), *each) for split, (names, *each) in clips.items()}
    found.notes += [noted(note, takes) for note, takes in notes.items()]
    failed = {name for name, _ in found.skipped}
    short, said = short_parts(reader, [take for take in takes if take.name in failed], job.canonicalize.min_frames)
    found.notes += said
    found.count_skipped(len(takes), short)
    return found


def _first_scene(part: ConvertedTake, body: Body) -> Scene:
    """The beginning of a take's first clip, for the picture."""
    P, T = part.people[0], part.frames[0]
    rows = part.rows[: P * T].reshape(P, T)[:, :SHOWN_FRAMES]
    return scene_of(rows, part.betas[:P], body.id, FPS)


def short_parts(reader: Reader, takes: Sequence[Take], least: int) -> tuple[int, list[str]]:
    """How many of some takes are parts held out of a recording that is too short for that, and what to do.

    takes: that cannot be used; least: frames of a clip
    """
    if not isinstance(reader, OwnReader) or not reader.in_time:
        return 0, []
    lacking: dict[tuple[str, float], list[Split]] = {}
    for take in takes:
        with suppress(DataError, OSError):
            scene, part, whole, seconds = reader.part_of(take)
            if part is not None and part in HELD_OUT and round(seconds * FPS) < least:
                lacking.setdefault((scene, whole), []).append(part)
    said = []
    for (scene, whole), parts in lacking.items():
        lengths = {part: math.ceil(10 * seconds_needed(part, least / FPS)) / 10 for part in parts}
        needed = " and ".join(f"{seconds:g} s {HELD_OUT[part]}" for part, seconds in lengths.items())
        said.append(
            f"{scene} is {whole:.1f} s long; to hold out a part of {least / FPS:g} s it must be {needed}: record "
            f"longer, or {FEW} takes or more, of which whole ones are held out; or train on all of it: --splits FILE "
            f"with the line '{scene} train'"
        )
    return sum(map(len, lacking.values())), said


# -- the picture -------------------------------------------------------------------------------


def draw(found: CheckReport, path: Path, body: Body | None) -> Path | None:
    """A contact sheet of the scenes kept, as skeletons; None when there are none.

    Without the store's own body the open one is drawn, in its mean shape.
    """
    if not found.scenes:
        return None
    frames = min(scene.frames for _, scene in found.scenes)
    scenes = [(name, scene.slice(0, frames)) for name, scene in found.scenes]
    title = found.title
    if body is None or body.id != scenes[0][1].body:
        body = load_body()
        scenes = [(n, s.replace(body=body.id, betas=torch.zeros_like(s.betas))) for n, s in scenes]
        title += " (drawn with the open body's mean shape)"
    return contact_sheet(scenes, path, context_frames=0, body=body, style="capsules", title=title)


WITHOUT: dict[Split, str] = {
    "train": "nothing can be trained on it",
    "val": "training goes without validation",
    "test": "magnet test has no scenes",
}
YOURS = "a split of your own is given to prepare with --splits FILE, lines NAME SPLIT"
LIMITED = "; --limit may be too low"


def split_gaps(clips: Mapping[Split, Mapping[int, int]], limited: bool = False) -> list[str]:
    """A sentence for every gap, then what to do; none where every split has clips of every number of people.

    Somebody alone is no gap where others are together: data sets hold such clips to learn bodies from.
    clips: their number by number of people, of each split that has any; limited: not all takes were asked for.
    """
    counts = {split: {n: count for n, count in clips.get(split, {}).items() if count} for split in SPLITS}
    if not any(counts.values()):
        return []
    said = [f"split {split} is EMPTY: {WITHOUT[split]}" for split in SPLITS if not counts[split]]
    sizes = sorted({n for of in counts.values() for n in of})
    for people in sizes if sizes == [1] else [n for n in sizes if n > 1]:
        lacking = [split for split in SPLITS if counts[split] and people not in counts[split]]
        if lacking:
            has = ", ".join(f"{split} {of[people]}" for split, of in counts.items() if people in of)
            said.append(f"no clip of {people} people in {' and '.join(lacking)} ({has})")
    return [*said, YOURS + LIMITED * limited] if said else []
