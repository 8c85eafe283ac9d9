"""DD100 (Duolando): a hundred minutes of couples dancing ten genres, one file a dancer."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal

import numpy as np

from magnet.datamodules.clip import Split
from magnet.datamodules.prepared import Prepared
from magnet.datamodules.reading.arrays import one_length
from magnet.datamodules.reading.fields import (
    PersonMotion,
    first_folder,
    gender_of,
    listing,
    pickled_mapping,
    rows,
    shape_numbers,
    side_by_side,
)
from magnet.datamodules.reading.recording import DataError, Reader, Recording, Take
from magnet.datamodules.registry import register_data

RATE = 30.0
ROLES = ("follower", "leader")
"""By the last number of a file's name: 00, 01."""
PLACES = ("", "data/motion/smplx/all", "motion/smplx/all", "smplx/all", "all")
NAME = re.compile(r"(?P<take>(?P<genre>[A-Za-z]+)_(?P<choreography>\d+)_\d+)_(?P<role>0[01])\.npy")
SAME = 1e-3
"""Radians that `global_orient` may differ from the first joint of `poses`."""


class DD100Reader(Reader):
    """SMPL-X files of DD100: `[GENRE]_[CHOREOGRAPHY]_[TAKE]_00.npy` the follower, `_01.npy` the leader.

    The authors split by choreography: test are 9 and 10 of Ballet and those divisible by 5 of every other genre. They
    have no validation split; choreographies whose number ends in 4 are kept back from training for it.

    Args:
        root: folder of the files, or one above it that holds data/motion/smplx/all.
        validation: False leaves the official training split whole and validation empty.
        orient: where to take the root's orientation from, should `global_orient` and `poses` say different things.
    """

    name = "dd100"
    title = "DD100"
    source = "https://github.com/lisiyao21/Duolando"
    licence = "NTU S-Lab License 1.0: non-commercial"
    fake = "magnet.datamodules.fakes.dd100"
    family = "smplx"
    layout = (
        (
            "data/motion/smplx/all/GENRE_CHOREO_TAKE_{00,01}.npy",
            "00 the follower, 01 the leader, such as Jive_005_001_00.npy",
        ),
    )
    version = 2  # genders are read

    def __init__(
        self, root: str | Path, validation: bool = True, orient: Literal["same", "global_orient", "poses"] = "same"
    ) -> None:
        super().__init__(root)
        if orient not in ("same", "global_orient", "poses"):
            raise DataError(f"orient: got {orient!r}, expected 'same', 'global_orient' or 'poses': give one of them")
        folder = first_folder(self.root, PLACES, "*_0[01].npy")
        if folder is None:
            raise DataError(
                f"DD100: no files such as Jive_005_001_00.npy in {self.root}, which holds {listing(self.root)}; give "
                "the folder data/motion/smplx/all, not the preprocessed pos3d and rotmat, which lack body shapes"
            )
        self.folder, self.validation, self.orient = folder, validation, orient

    def found(self) -> list[Take]:
        """One take per pair of files; `read` refuses one that lacks the partner's file."""
        found: dict[str, re.Match[str]] = {}
        for path in sorted(self.folder.iterdir()):
            if match := NAME.fullmatch(path.name):
                found.setdefault(match["take"], match)
        return [
            Take(
                name=name,
                files=tuple(self.folder / f"{name}_{role:02}.npy" for role in range(len(ROLES))),
                split=self.split(match["genre"], int(match["choreography"])),
                group=f"{match['genre']}_{match['choreography']}",
            )
            for name, match in found.items()
        ]

    def split(self, genre: str, choreography: int) -> Split:
        """By the authors' rule, and our validation."""
        test = choreography in (9, 10) if genre == "Ballet" else choreography % 5 == 0
        if test:
            return "test"
        return "val" if self.validation and choreography % 10 == 4 else "train"

    def read(self, take: Take) -> Recording:
        """Follower and leader at 30 fps, z up; lengths are cut to the shorter with a note."""
        people = [self._person(path, role) for path, role in zip(take.files, ROLES, strict=True)]
        return side_by_side(self.folder / take.name, people, RATE, "+z", cut=True)

    def _person(self, path: Path, role: str) -> PersonMotion:
        held = pickled_mapping(path)
        poses, transl = rows(path, held, "poses", 165), rows(path, held, "transl", 3)
        lengths = {"poses": len(poses), "transl": len(transl)}
        if self.orient != "poses" and ("global_orient" in held or self.orient == "global_orient"):
            first = rows(path, held, "global_orient", 3)
            one_length(path, lengths | {"global_orient": len(first)})
            apart = float(np.abs(first - poses[:, :3]).max())
            if apart > SAME and self.orient == "same":
                raise DataError(
                    f"{path}: global_orient and poses[:, :3] differ by up to {apart:.3g} radians, expected the same; "
                    "look which stands upright and give --reader.orient global_orient or poses"
                )
            poses = np.concatenate([first, poses[:, 3:]], axis=1)
        frames = one_length(path, lengths)
        shape, notes = shape_numbers(path, held)
        meta = held.get("meta")
        gender = gender_of(meta.get("gender")) if isinstance(meta, dict) else None
        return PersonMotion(poses[:, :66].reshape(frames, 22, 3), transl, shape, role, notes, gender)


@register_data()
class DD100(Prepared):
    """Couples of DD100, from a store that `magnet data prepare dd100` made."""

    reader = DD100Reader
