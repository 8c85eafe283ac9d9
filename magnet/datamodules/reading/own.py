"""A user's own recordings: which files of a folder form a scene. Subclasses read the files."""

from __future__ import annotations

import hashlib
from abc import abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Generic, Literal, NamedTuple, Protocol, Self, TypeVar

from magnet.datamodules.clip import SPLITS, Split
from magnet.datamodules.reading.arrays import hashed_split
from magnet.datamodules.reading.fields import listing
from magnet.datamodules.reading.own_files import (
    TABLE,
    PersonFile,
    SceneFiles,
    by_names,
    by_pattern,
    by_table,
    files_of,
    of_others,
)
from magnet.datamodules.reading.recording import DataError, Reader, Recording, Take
from magnet.errors import counted, first_names
from magnet.export.cutting import rates_note
from magnet.motion.scene import FPS

FEW = 4
"""Fewer scenes than these are each split in time: whole ones would leave next to nothing to train on."""
HELD, LEAST, MOST = 0.15, 5.0, 0.3
"""Share of a scene that is held out for testing, the seconds that it is at least, and the largest share."""
VALIDATED = 0.1
SLOWEST, FASTEST = 1.0, 1000.0
"""Frames a second that are believed."""
SHOWN = 6
HOW = "name files NAME_A and NAME_B, or give --reader.pattern '{scene}/{person}' or a table (docs/own.md)"


class PersonTrack(Protocol):
    """One person's motion out of a file, at the file's rate."""

    @property
    def fps(self) -> float: ...

    @property
    def frames(self) -> int: ...

    def slice(self, start: int, stop: int) -> Self:
        """Frames `start:stop`."""
        ...

    def resampled(self, fps: float) -> Self:
        """At another rate."""
        ...


T = TypeVar("T", bound=PersonTrack)


class PartOf(NamedTuple):
    """A part of a scene, None: all of it, with the seconds of the scene and of the part before anything is cut out."""

    scene: str
    part: Split | None
    whole: float
    seconds: float


class OwnReader(Reader, Generic[T]):
    """A folder of a user's own recordings.

    Args:
        root: the folder.
        pattern: which files are people of one scene, by their paths without suffixes, such as {scene}/{person}; by
            default those whose names differ in a last word such as A and B, leader and follower, person1 and person2.
        table: CSV with the columns scene, person, file, role, start in its place; by default people.csv in the folder,
            where there is one.
        split: whole scenes to train, validate and test on (`scenes`), or the last parts of each to validate and test on
            (`time`); by default `time` where there are fewer than four.

    Raises:
        DataError: there are no such files; says what was found.
        ValueError: a pattern that is none.
    """

    source: ClassVar[str] = "your own recordings"
    licence: ClassVar[str] = "yours to know"
    own: ClassVar[bool] = True
    suffixes: ClassVar[tuple[str, ...]]
    one_person_a_file: ClassVar[bool] = True

    def __init__(
        self,
        root: str | Path,
        pattern: str | None = None,
        table: Path | None = None,
        split: Literal["scenes", "time"] | None = None,
    ) -> None:
        self.root = Path(root)
        if not self.root.is_dir():
            raise DataError(f"{self.title}: {self.root} is not a folder; give the one that holds them")
        own = self.root / TABLE
        self.pattern, self.table = pattern, Path(table) if table is not None else own if own.is_file() else None
        self.split = split
        if not self._files:
            kinds = " or ".join(self.suffixes)
            raise DataError(
                f"{self.root}: no {kinds} file; it holds {listing(self.root)}; give the folder that has them"
                f"{of_others(self.root)}"
            )
        if pattern is not None:
            by_pattern(self.root, (), pattern)

    # -- which files -----------------------------------------------------------------------------

    @cached_property
    def _files(self) -> list[Path]:
        return files_of(self.root, self.suffixes)

    @cached_property
    def _grouped(self) -> tuple[dict[str, SceneFiles], list[Path]]:
        """Scenes by name, and files that belong to none."""
        if self.table is not None:
            groups, left = by_table(self.root, self.table, self.suffixes), []
            used = {person_file.file for group in groups for person_file in group.people}
            left = [path for path in self._files if path not in used]
        elif self.pattern is not None:
            groups, left = by_pattern(self.root, self._files, self.pattern)
            if not groups:
                raise DataError(
                    f"{self.root}: no file fits the pattern {self.pattern}; the first is "
                    f"{left[0].relative_to(self.root).with_suffix('').as_posix()}; give a pattern that it fits"
                )
        else:
            groups, left = by_names(self.root, self._files), []
        return {group.scene: group for group in groups}, left

    @property
    def groups(self) -> dict[str, SceneFiles]:
        """Every scene by name, told by files' names alone."""
        return self._grouped[0]

    def scenes(self) -> dict[str, SceneFiles]:
        """Those that are recordings; a look into the files may leave some out."""
        return self.groups

    @property
    def in_time(self) -> bool:
        """Whether each scene is split in time."""
        return self.split == "time" or (self.split is None and len(self.scenes()) < FEW)

    def found(self) -> list[Take]:
        also = () if self.table is None else (self.table,)
        return [
            Take(scene, tuple(person_file.file for person_file in group.people), None, scene, also)
            for scene, group in self.scenes().items()
        ]

    def official(self) -> Mapping[str, Split] | None:
        """Ours: by a hash of the scene's name, a tenth for testing and a tenth for validation, at least one each."""
        if self.in_time:
            return None
        splits = {take.name: hashed_split(take.name) for take in self.found()}
        order: tuple[Split, ...] = ("train", "test", "val")
        needed = order[: len(splits)]
        for split in needed:
            count = Counter(splits.values())
            if not count[split]:
                donor = max(count, key=lambda one: (one not in needed, count[one]))
                splits[min((n for n in splits if splits[n] == donor), key=lambda n: _place(n, split))] = split
        return splits

    def takes(self) -> list[Take]:
        """Scenes with their splits; or their parts, where they are split in time."""
        if not self.in_time:
            return super().takes()
        for scene in self.scenes():
            twice = [part_name(scene, split) for split in SPLITS if part_name(scene, split) in self.scenes()]
            if twice:
                raise DataError(f"{self.root}: the scene {twice[0]!r} is called as a part of {scene!r}; rename it")
        return [
            Take(part_name(take.name, split), take.files, split, "", take.also)
            for take in self.found()
            for split in SPLITS
        ]

    def summary(self) -> list[str]:
        """What the folder holds, by names alone."""
        groups, left = self.scenes(), self._grouped[1]
        sizes = Counter(len(group.people) for group in groups.values())
        said = []
        for size, count in sorted(sizes.items(), reverse=True):
            scenes, files = "scene" + "s" * (count > 1), "file" + "s" * (size > 1) + " each" * (count > 1)
            said.append(f"{count} {scenes} of {size} {files}: {_some(groups, size)}")
        if set(sizes) == {1} and self.table is None and self.pattern is None and self.one_person_a_file:
            said.append(f"everybody is alone: no names tell who was recorded together; if some were, {HOW}")
        if left:
            said.append(f"{counted(len(left), 'file')} of no scene: {first_names([path.name for path in left], SHOWN)}")
        if self.in_time:
            how = "fewer than four scenes: " if self.split is None else ""
            said.append(
                f"{how}each is split in time, its end validates and tests (--reader.split scenes keeps scenes whole)"
            )
        return said

    # -- reading ---------------------------------------------------------------------------------

    @abstractmethod
    def open(self, person_file: PersonFile, alone: bool) -> tuple[list[T], list[str]]:
        """The people in a file, and what should be known of it.

        Args:
            person_file: whose file.
            alone: it is the only one of its scene, and may hold several people.

        Raises:
            DataError: the file is damaged, or not what it should be.
        """

    def together(self, group: SceneFiles, tracks: list[T], notes: list[str]) -> list[T]:
        """Everybody in a scene, before any part of it is cut out; what should be known of them is added to `notes`."""
        return tracks

    @abstractmethod
    def recording(self, where: str, tracks: Sequence[T], names: Sequence[str], notes: Sequence[str]) -> Recording:
        """People with equal rates and lengths as one recording."""

    def read(self, take: Take) -> Recording:
        """The scene, or the part of it that the take is."""
        group, part = self._meant(take)
        tracks, names, notes = self._people(group)
        frames = min(track.frames for track in tracks)
        if len({track.frames for track in tracks}) > 1:
            lengths = ", ".join(f"{n or p} {t.frames}" for p, (n, t) in enumerate(zip(names, tracks, strict=True)))
            notes.append(f"unequal numbers of frames ({lengths}), cut to the shortest")
        start, stop = (0, frames) if part is None else span(part, frames, tracks[0].fps)
        tracks = [track.slice(start, stop) for track in tracks]
        return self.recording(group.scene, tracks, names, notes)

    def part_of(self, take: Take) -> PartOf:
        """Which part of which scene a take is, and how long both are."""
        group, part = self._meant(take)
        tracks, _, _ = self._people(group)
        frames, fps = min(track.frames for track in tracks), tracks[0].fps
        start, stop = (0, frames) if part is None else span(part, frames, fps)
        return PartOf(group.scene, part, frames / fps, (stop - start) / fps)

    def _people(self, group: SceneFiles) -> tuple[list[T], list[str], list[str]]:
        """Everybody in a scene from when the last of them begins, their names, and what should be known of it."""
        tracks: list[T] = []
        names: list[str] = []
        starts: list[float] = []
        notes: list[str] = []
        for person_file in group.people:
            held, said = self.open(person_file, len(group.people) == 1)
            notes += said
            tracks += held
            starts += [person_file.start or 0.0] * len(held)
            names += [person_file.person] if len(held) == 1 else [""] * len(held)  # else as the file calls them
        if group.alone:
            notes.append("named like one of several people, but no other file goes with it")
        tracks = _from_latest(self._one_rate(tracks, group, notes), starts, group)
        return self.together(group, tracks, notes), names, notes

    def _meant(self, take: Take) -> tuple[SceneFiles, Split | None]:
        if take.name in self.groups:
            return self.groups[take.name], None
        for split in SPLITS:
            scene = take.name.removesuffix(part_name("", split))
            if scene != take.name and scene in self.groups:
                return self.groups[scene], split
        missing = next((path for path in take.files if not path.is_file()), self.root)
        raise DataError(f"{missing}: no such file; {take.name} was made of it")

    def _one_rate(self, tracks: list[T], group: SceneFiles, notes: list[str]) -> list[T]:
        rates = sorted({track.fps for track in tracks})
        if not all(SLOWEST <= rate <= FASTEST for rate in rates):
            said = ", ".join(f"{rate:g}" for rate in rates)
            raise DataError(
                f"{group.people[0].file}: {said} frames a second, expected {SLOWEST:g} to {FASTEST:g}; mend that number"
            )
        if len(rates) == 1:
            return tracks
        notes += rates_note(rates, FPS)
        return [track.resampled(FPS) for track in tracks]


def require_alone(path: Path, people: int, alone: bool) -> None:
    """Refuse several people in one of a scene's several files. alone: it is the only one of its scene."""
    if people > 1 and not alone:
        raise DataError(
            f"{path}: holds {people} people, but other files belong to its scene, too; of several files each holds "
            "one person: rename it, or put it elsewhere"
        )


def part_name(scene: str, split: Split) -> str:
    """What the part of a scene that is split in time is called."""
    return f"{scene} ({split})"


def span(part: Split, frames: int, fps: float) -> tuple[int, int]:
    """The frames of a part of a scene of so many: most of it trains, then a stretch validates, the last one tests."""
    tested = min(max(HELD * frames, LEAST * fps), MOST * frames)
    test = max(frames - round(tested), min(2, frames - 1))
    val = max(test - max(1, round(VALIDATED * frames)), min(1, test))
    return {"train": (0, val), "val": (val, test), "test": (test, frames)}[part]


def seconds_needed(part: Split, least: float) -> float:
    """Seconds of a scene of which a validating or testing part is at least so long; see `span`.

    >>> seconds_needed("val", 1.0), round(seconds_needed("test", 1.0), 1), round(seconds_needed("test", 6.0), 1)
    (10.0, 3.3, 40.0)
    """
    share = VALIDATED if part == "val" else MOST if least <= LEAST else HELD
    return least / share


def _from_latest(tracks: list[T], starts: list[float], group: SceneFiles) -> list[T]:
    """Cut so that all begin when the last of them does, to the nearest frame."""
    latest = max(starts)
    cut = []
    for track, start in zip(tracks, starts, strict=True):
        skipped = round((latest - start) * track.fps)
        if skipped >= track.frames:
            ends = start + track.frames / track.fps
            raise DataError(
                f"{group.people[0].file}: people of {group.scene} never overlap: one begins at {latest:g} s, another "
                f"ends at {ends:g} s; mend the starts in the table"
            )
        cut.append(track.slice(skipped, track.frames))
    return cut


def _place(name: str, split: str) -> str:
    """Where a name comes in an order that only names decide."""
    return hashlib.sha256(f"{split}: {name}".encode(errors="replace")).hexdigest()


def _some(groups: Mapping[str, SceneFiles], size: int) -> str:
    def shown(group: SceneFiles) -> str:
        people = ", ".join(person_file.person or person_file.file.name for person_file in group.people)
        return f"{group.scene} ({people})" if size > 1 else group.scene

    return first_names([shown(group) for group in groups.values() if len(group.people) == size], SHOWN)
