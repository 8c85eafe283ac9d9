"""What SMPL-X files of several data sets have in common: one person's keys, people side by side, folders."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing import parent_process
from pathlib import Path
from typing import Any

import numpy as np

from magnet.datamodules.reading.arrays import Doubles, floats, one_length, one_shape, require
from magnet.datamodules.reading.recording import GENDERS, Axis, Gender, Recording
from magnet.errors import first_names, warn_user
from magnet.unpickle import load_object_npy, load_pickle, mapping


@dataclass(frozen=True)
class PersonMotion:
    """One person's file: T frames in radians and metres."""

    poses: Doubles  # (T, 22, 3) axis-angle
    transl: Doubles  # (T, 3)
    betas: Doubles  # (10,)
    name: str
    notes: tuple[str, ...] = ()
    gender: Gender | None = None

    @property
    def frames(self) -> int:
        return len(self.poses)


def pickled_mapping(path: Path) -> Mapping[str, Any]:
    """The dict with text keys that a .pkl holds, or an .npy as its one object. No code in it is run."""
    return mapping(path, load_pickle(path) if path.suffix == ".pkl" else load_object_npy(path))


def rows(where: object, held: Mapping[str, Any], key: str, width: int) -> Doubles:
    """A key's value as so many numbers a frame, however a frame is shaped. -> (T, width)"""
    require(where, held, (key,))
    value = held[key]
    if isinstance(value, np.ndarray) and value.ndim > 2 and math.prod(value.shape[1:]) == width:
        value = value.reshape(len(value), width)
    return floats(f"{where}: {key}", value, ("T", width))


def shape_numbers(where: object, held: Mapping[str, Any]) -> tuple[Doubles, tuple[str, ...]]:
    """A person's first ten shape numbers from `betas` (10+,), (1, 10+) or (T, 10+). -> (10,), notes"""
    require(where, held, ("betas",))
    value = held["betas"]
    if isinstance(value, np.ndarray) and value.ndim == 1:
        value = value[None]
    return one_shape(f"{where}: betas", floats(f"{where}: betas", value, ("T", "shapes")))


def gender_of(said: Any) -> Gender | None:
    """The gender in a file's own words: text, bytes, or an array of one of them; None: it says something else."""
    said = said.item() if isinstance(said, np.ndarray) and said.size == 1 else said
    said = said.decode("latin-1") if isinstance(said, bytes) else said
    return next((gender for gender in GENDERS if isinstance(said, str) and said.strip().lower() == gender), None)


def person(
    where: object,
    held: Mapping[str, Any],
    name: str,
    *,
    gender: Any = None,
    orient: str = "global_orient",
    body: str = "body_pose",
    transl: str = "transl",
) -> PersonMotion:
    """One person from a dict with keys of SMPL-X's family: root and 21 body joints in axis-angle, metres.

    gender: of the body that the shape is of, as the data set says it
    orient, body, transl: keys of the root, the joints and the translation
    """
    require(where, held, (orient, body, transl, "betas"))
    parts = {key: rows(where, held, key, width) for key, width in ((orient, 3), (body, 63), (transl, 3))}
    frames = one_length(where, {key: len(part) for key, part in parts.items()})
    poses = np.concatenate([parts[orient], parts[body]], axis=1).reshape(frames, 22, 3)
    shape, notes = shape_numbers(where, held)
    return PersonMotion(poses, parts[transl], shape, name, notes, gender_of(gender))


def side_by_side(
    where: object, people: Sequence[PersonMotion], fps: float, up: Axis, *, cut: bool = False, notes: Iterable[str] = ()
) -> Recording:
    """People who were recorded together, in the order of agents, as one recording.

    cut: unequal lengths to the shortest, with a note beside what else was found (`notes`)
    """
    lengths, said = {someone.name: someone.frames for someone in people}, list(notes)
    if not cut:
        one_length(where, lengths)
    frames, why = shortest(lengths)
    said += why
    said += [f"{someone.name}: {note}" for someone in people for note in someone.notes]
    known = any(someone.gender for someone in people)
    return Recording(
        fps=fps,
        up=up,
        poses=np.stack([someone.poses[:frames] for someone in people], axis=1),
        transl=np.stack([someone.transl[:frames] for someone in people], axis=1),
        betas=np.stack([someone.betas for someone in people]),
        persons=tuple(lengths),
        notes=tuple(said),
        genders=tuple(someone.gender or "neutral" for someone in people) if known else (),
    )


def shortest(lengths: Mapping[str, int]) -> tuple[int, list[str]]:
    """Frames that everybody has, and a note where somebody has more."""
    frames = min(lengths.values())
    if frames == max(lengths.values()):
        return frames, []
    listed = ", ".join(f"{name} {count}" for name, count in lengths.items())
    return frames, [f"unequal numbers of frames ({listed}), cut to the shortest"]


# -- folders -----------------------------------------------------------------------------------


def first_folder(root: Path, places: Sequence[str], holds: str) -> Path | None:
    """The first of `places` under `root` that has something matching the glob `holds`; upper and lower case alike."""
    for place in places:
        for folder in _folders(root, [part for part in place.split("/") if part]):
            if any(folder.glob(holds)):
                return folder
    return None


def _folders(root: Path, parts: Sequence[str]) -> list[Path]:
    if not parts:
        return [root]
    named = [path for path in sorted(root.iterdir()) if path.is_dir() and path.name.casefold() == parts[0].casefold()]
    return [folder for path in named for folder in _folders(path, parts[1:])]


def files_under(root: Path) -> Iterator[Path]:
    """All files under a folder, and under those that links in it lead to; no folder twice, so that no link goes round.

    A link that leads nowhere counts as a file, which whoever reads it finds missing; a folder that may not be read is
    warned of.
    """
    seen: set[str] = set()
    refused: list[OSError] = []
    starts = [str(root)]  # links come last: what lies in the folder itself keeps its name
    for start in starts:
        for folder, below, names in os.walk(start, onerror=refused.append):
            if (place := os.path.realpath(folder)) in seen:
                below.clear()
                continue
            seen.add(place)
            starts += sorted(path for name in below if os.path.islink(path := os.path.join(folder, name)))
            yield from (Path(folder, name) for name in names)
    if parent_process() is None:  # processes that convert takes have looked, too
        for error in refused:
            warn_user(f"{error.filename}: cannot be read ({error.strerror}); what is in it is left out")


def listing(folder: Path, most: int = 8) -> str:
    """What a folder holds, in a few words."""
    return first_names([path.name + "/" * path.is_dir() for path in sorted(folder.iterdir())], most) or "nothing"


def natural(name: str) -> tuple[tuple[str, int], ...]:
    """Sort key by which take 10 comes after take 9."""
    return tuple((text, int(digits or 0)) for text, digits in re.findall(r"(\D*)(\d*)", name))
