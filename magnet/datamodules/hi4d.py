"""Hi4D: pairs of people in close contact, SMPL fits frame by frame at 30 fps, y up."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from magnet.datamodules.clip import Split
from magnet.datamodules.prepared import Prepared
from magnet.datamodules.reading.arrays import AGAIN, Doubles, floats, open_npz
from magnet.datamodules.reading.fields import listing, natural, person, side_by_side
from magnet.datamodules.reading.recording import DataError, Reader, Recording, Take
from magnet.datamodules.registry import register_data

SHAPES = {"global_orient": (2, 3), "body_pose": (2, 69), "transl": (2, 3), "betas": (2, 10)}


class Hi4DReader(Reader):
    """Hi4D's `pairXX/actionXX/{meta.npz, smpl/000XXX.npz}`: one file a frame.

    The authors give no split of motions; ours holds whole pairs out.

    Args:
        root: the folder with `pair00`, `pair01` and so on.
        test_pairs: pairs held out for testing (ours).
        val_pairs: pairs held out for validation (ours).

    Raises:
        DataError: no pairs; says what was found.
        ValueError: a pair is in two splits.
    """

    name = "hi4d"
    title = "Hi4D"
    source = "https://yifeiyin04.github.io/Hi4D"
    licence = "non-commercial scientific research only, by form; no redistribution"
    fake = "magnet.datamodules.fakes.hi4d"
    family = "smpl"
    layout = (
        ("pairXX/ACTION/meta.npz", "first and last frame, genders"),
        ("pairXX/ACTION/smpl/FRAME.npz", "one file a frame, both people"),
    )
    version = 2  # genders are read

    def __init__(
        self, root: str | Path, test_pairs: Sequence[int] = (28, 32, 37), val_pairs: Sequence[int] = (23, 27)
    ) -> None:
        super().__init__(root)
        if both := sorted({*test_pairs} & {*val_pairs}):
            raise ValueError(f"pairs {both} are in both val and test; each pair belongs to one split")
        self.test_pairs, self.val_pairs = frozenset(test_pairs), frozenset(val_pairs)
        if not any(self._pairs()):
            raise DataError(
                f"{self.root}: no folder pairXX; it holds {listing(self.root)}; give the folder of all pairs"
            )

    def found(self) -> list[Take]:
        takes = []
        for number, pair in self._pairs():
            split: Split = "test" if number in self.test_pairs else "val" if number in self.val_pairs else "train"
            for action in sorted(path for path in pair.iterdir() if path.is_dir() and not path.name.startswith(".")):
                frames = sorted((action / "smpl").glob("*.npz"), key=lambda path: natural(path.stem))
                takes.append(Take(name := f"{pair.name}_{action.name}", (action / "meta.npz", *frames), split, name))
        return takes

    def read(self, take: Take) -> Recording:
        """Both people at 30 fps, y up."""
        meta, *files = take.files
        notes, genders = self._check_frames(meta, files)
        frames = [self._frame(path) for path in files]
        arrays = {key: np.stack([frame[key] for frame in frames], axis=1) for key in SHAPES}
        arrays["body_pose"] = arrays["body_pose"][..., :63]
        where = meta.parent / "smpl"
        people = [
            person(f"{where}, person {p}", {key: array[p] for key, array in arrays.items()}, f"person {p}", gender=one)
            for p, one in enumerate(genders)
        ]
        return side_by_side(where, people, 30.0, "+y", notes=notes)

    def _pairs(self) -> list[tuple[int, Path]]:
        found = ((re.fullmatch(r"pair(\d+)", path.name), path) for path in sorted(self.root.iterdir()))
        return [(int(match[1]), path) for match, path in found if match and path.is_dir()]

    def _check_frames(self, meta: Path, files: list[Path]) -> tuple[list[str], list[Any]]:
        """Notes and genders. Frames are those that meta.npz says; whether `end` is one of them is not documented."""
        said = open_npz(meta, ("start", "end", "num_persons"), ("genders",))
        start, end, people = (self._number(meta, said, key) for key in ("start", "end", "num_persons"))
        if people != 2:
            raise DataError(f"{meta}: num_persons is {people}, expected 2; {AGAIN}")
        folder = meta.parent / "smpl"
        if not files:
            raise DataError(f"{folder}: no frames 000XXX.npz; {AGAIN} or leave the take out")
        if strange := [path.name for path in files if not (path.stem.isascii() and path.stem.isdigit())]:
            raise DataError(f"{folder}: {strange[0]} is no frame number, expected 000XXX.npz; {AGAIN}")
        numbers = sorted(int(path.stem) for path in files)
        first, last = numbers[0], numbers[-1]
        gaps = [a + 1 for a, b in pairwise(numbers) if b != a + 1]
        if gaps or first != start or last not in (end, end - 1):
            lacking = f", frame {gaps[0]} is missing" if gaps else ""
            raise DataError(
                f"{folder}: {len(files)} frames from {first} to {last}{lacking}, but meta.npz says {start} to {end}; "
                f"{AGAIN}"
            )
        genders = np.ravel(said["genders"]).tolist() if "genders" in said else []
        notes = [] if last == end else [f"meta.npz's end {end} is one past the last frame"]
        return notes, genders if len(genders) == 2 else [None, None]

    def _number(self, path: Path, said: dict[str, np.ndarray], key: str) -> int:
        value = float(floats(f"{path}: {key}", np.ravel(said[key]), (1,))[0])
        if value != round(value):
            raise DataError(f"{path}: {key} is {value:g}, expected a whole number; {AGAIN}")
        return int(value)

    def _frame(self, path: Path) -> dict[str, Doubles]:
        said = open_npz(path, tuple(SHAPES))
        for key, shape in SHAPES.items():
            if said[key].shape in ((1, *shape[1:]), shape[1:]):
                raise DataError(f"{path}: {key} is {said[key].shape}, of one person: the partner is missing; {AGAIN}")
        return {key: floats(f"{path}: {key}", said[key], shape) for key, shape in SHAPES.items()}


@register_data()
class Hi4D(Prepared):
    """Hi4D from a store that `magnet data prepare hi4d` made: scenes of two people."""

    reader = Hi4DReader
