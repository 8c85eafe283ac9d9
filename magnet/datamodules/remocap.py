"""ReMoCap's LindyHop (ReMoS): couples dancing at 50 fps, as joint positions to be fitted or as ready SMPL-X fits."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal

import numpy as np

from magnet.datamodules.clip import Split
from magnet.datamodules.prepared import Prepared
from magnet.datamodules.reading.arrays import AGAIN, OR_YOURS, open_npz, require
from magnet.datamodules.reading.fields import first_folder, listing, person, pickled_mapping, shortest, side_by_side
from magnet.datamodules.reading.recording import DataError, Reader, Recording, Take
from magnet.datamodules.reading.remocap_track import MAP, RATE, file_like, track
from magnet.datamodules.registry import register_data

PLACES = ("", "LindyHop", "ReMoCap/LindyHop", "data/LindyHop")
PEOPLE = ("0", "1")
PAPER: dict[int, Split] = {
    **dict.fromkeys((3, 5, 7, 9, 10, 16), "train"), 8: "val", 6: "test",
}  # fmt: skip
"""Sequences by number, as the paper's authors use them."""
FIT_ENDINGS = ("npz", "npy", "pkl")


class ReMoCapReader(Reader):
    """ReMoCap/LindyHop/{train,test}/SEQUENCE/{0,1}/ with motion.bvh and csv files of positions in millimetres.

    The authors' README and code name the files differently, so motion_worldpos*.csv, motion_rotation*.csv and any
    sequence folder with a number in its name are accepted. Joints are found by the csv's headings (Hips.X), or else by
    the order of the BVH file. `canonicalize` fits the body to the positions; rotations only check joints and units:
    with some Euler order, motion_offsets.pkl must lead to the positions within 1 cm. Two people's files of unequal
    length are cut to the shorter, with a note, as the authors' process_LindyHop.py does.

    Args:
        root: the folder LindyHop or one above; or one of ready fits.
        split: "official" by the folders train and test, the last training sequence kept back for validation;
            "paper" by the sequences that the paper's authors use.
        fits: folder of ready SMPL-X fits of both people, NUMBER.npz, .npy or .pkl with body_pose, orient, trans and
            betas, each (2, T, ..), such as ReMoS/data/Lindyhop/smplx_data_pose_prior_001; None: root's own files.
        scale: metres a unit of the csv files.
    """

    name = "remocap"
    title = "ReMoCap"
    source = "https://github.com/anindita127/ReMoS"
    licence = "research only, no redistribution"
    fake = "magnet.datamodules.fakes.remocap"
    family = "positions"
    layout = (
        ("ReMoCap/LindyHop/{train,test}/NUMBER/{0,1}/motion.bvh", "the skeleton"),
        ("ReMoCap/LindyHop/{train,test}/NUMBER/{0,1}/motion_worldpos.csv", "positions; motion_worldpose.csv will do"),
        ("ReMoCap/LindyHop/{train,test}/NUMBER/{0,1}/motion_rotations.csv", "not needed, proves joints and units"),
        ("ReMoCap/LindyHop/{train,test}/NUMBER/{0,1}/motion_offsets.pkl", "not needed, the same"),
    )
    version = 2  # notes in whole millimetres

    def __init__(
        self,
        root: str | Path,
        split: Literal["official", "paper"] = "official",
        fits: Path | None = None,
        scale: float = 0.001,
    ) -> None:
        super().__init__(root)
        if split not in ("official", "paper"):
            raise DataError(f"split: got {split!r}, expected 'official' or 'paper': give one of them")
        self.scale, self.paper = scale, split == "paper"
        self.halves = first_folder(self.root, PLACES, "train/*") or first_folder(self.root, PLACES, "test/*")
        self.fits = None if fits is None else Path(fits)
        if self.fits is None and self.halves is None and any(path.stem.isdigit() for path in _fit_files(self.root)):
            self.fits = self.root
        if self.fits is not None and not _fit_files(self.fits):
            raise DataError(f"ReMoCap: no fits such as 16.npz in {self.fits}; give their folder")
        if self.halves is None and self.fits is None:
            raise self._no("sequences train/*/0 and test/*/0")

    def found(self) -> list[Take]:
        """One take per sequence; `read` refuses one with missing files."""
        found: dict[int, tuple[Path, ...]] = {}
        if self.fits is None:
            found = {number: _files(folder) for number, folder in self._folders().items()}
        else:
            for path in _fit_files(self.fits):
                if (number := _number(path)) is not None:
                    found.setdefault(number, (path,))
        return [Take(f"lindyhop_{number:03}", found[number], None, group=str(number)) for number in sorted(found)]

    def official(self) -> dict[str, Split]:
        """By the paper's numbers; or by folder, the last training sequence kept back."""
        splits = PAPER
        if not self.paper:
            if self.halves is None:
                raise self._no("train/ and test/ to split the fits by", f", take split=paper{OR_YOURS}")
            splits = {n: "test" if f.parent.name == "test" else "train" for n, f in self._folders().items()}
            train = sorted(number for number, split in splits.items() if split == "train")
            if len(train) > 1:
                splits[train[-1]] = "val"
        return {str(number): split for number, split in splits.items()}

    def _no(self, wanted: str, hint: str = "") -> DataError:
        return DataError(
            f"ReMoCap: no {wanted} in {self.root}, which holds {listing(self.root)}; give the folder LindyHop{hint}"
        )

    def _folders(self) -> dict[int, Path]:
        """Folder of each sequence, by number."""
        found: dict[int, Path] = {}
        halves = [] if self.halves is None else [self.halves / half for half in ("train", "test")]
        for half in halves:
            for folder in sorted(half.iterdir()) if half.is_dir() else ():
                number = _number(folder)
                if number is None or not folder.is_dir():
                    continue
                if number in found:
                    raise DataError(f"{folder}: has the number of {found[number]}; leave one of the two out")
                found[number] = folder
        return found

    def read(self, take: Take) -> Recording:
        """Positions, or the ready fits, of both people at 50 fps, y up."""
        if self.fits is not None:
            return self._fit(take.files[0])
        folder = take.files[0].parents[1]
        tracks = [track(folder / one, self.scale) for one in PEOPLE]
        positions, rates, notes = zip(*tracks, strict=True)
        if abs(rates[0] - rates[1]) > 0.01 * rates[0]:
            raise DataError(f"{folder}: people were recorded at {rates[0]:g} and {rates[1]:g} fps; {AGAIN}")
        frames, cut = shortest({one: len(places) for one, places in zip(PEOPLE, positions, strict=True)})
        said = [f"{one}: {note}" for one, found in zip(PEOPLE, notes, strict=True) for note in found]
        return Recording(
            fps=rates[0],
            up="+y",
            positions=np.stack([places[:frames] for places in positions], axis=1),
            joints=tuple(MAP),
            persons=PEOPLE,
            notes=(*cut, *said),
        )

    def _fit(self, path: Path) -> Recording:
        keys = ("body_pose", "orient", "trans", "betas")
        held = open_npz(path, keys) if path.suffix == ".npz" else pickled_mapping(path)
        require(path, held, keys)
        people = []
        for p in range(2):
            mine = {}
            for key in keys:
                value = held[key]
                if not isinstance(value, np.ndarray) or value.ndim < 2 or len(value) != 2:
                    got = value.shape if isinstance(value, np.ndarray) else f"a {type(value).__name__}"
                    alone = ": the partner is missing" if isinstance(value, np.ndarray) and len(value) == 1 else ""
                    raise DataError(f"{path}: {key} is {got}, expected (2, T, ..) of both people{alone}; {AGAIN}")
                mine[key] = value[p]
            if mine["body_pose"].ndim == 2:
                mine["body_pose"] = mine["body_pose"][:, :63]  # hands may follow
            people.append(person(f"{path}, person {p}", mine, PEOPLE[p], orient="orient", transl="trans"))
        return side_by_side(path, people, RATE, "+y")


@register_data()
class ReMoCap(Prepared):
    """LindyHop couples of ReMoCap, from a store that `magnet data prepare remocap` made."""

    reader = ReMoCapReader


# -- files -------------------------------------------------------------------------------------


def _number(path: Path) -> int | None:
    match = re.search(r"\d{1,9}", path.stem if path.suffix[1:] in FIT_ENDINGS else path.name)
    return None if match is None else int(match[0])


def _fit_files(folder: Path) -> list[Path]:
    return sorted(path for ending in FIT_ENDINGS for path in folder.glob(f"*.{ending}"))


def _files(sequence: Path) -> tuple[Path, ...]:
    files = []
    for one in PEOPLE:
        folder = sequence / one
        files += [file_like(folder, "*.bvh", "motion.bvh"), file_like(folder, "*worldpos*.csv", "motion_worldpos.csv")]
        files += sorted(folder.glob("*rotation*.csv")) + sorted(folder.glob("*offsets.pkl"))
    return tuple(files)
