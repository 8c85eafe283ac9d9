"""AIOZ-GDANCE: groups of up to seven dancers, SMPL poses at 30 fps without shapes."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from magnet.datamodules.clip import SPLITS, Split
from magnet.datamodules.prepared import Prepared
from magnet.datamodules.reading.arrays import AGAIN, Doubles, floats, hashed_split, listed_splits, open_names, require
from magnet.datamodules.reading.fields import PersonMotion, listing, pickled_mapping, side_by_side
from magnet.datamodules.reading.recording import DataError, Reader, Recording, Take
from magnet.datamodules.registry import register_data

LARGEST = 7
LIST = "split_sequence_names.txt"
SHAPELESS = "no shapes in this data set: everybody has the body's mean shape"


class AIOZReader(Reader):
    """AIOZ-GDANCE's `motions_smpl/<sequence>.pkl`: smpl_poses (P, T, 72) and root_trans (P, T, 3).

    Splits are the lists {train,val,test}_split_sequence_names.txt where they are there. The first parts of the
    download had only split_sequence_names.txt, which names sequences and no splits: then each video, the sequence
    without its first and last frame, goes to one split by a hash of its name.

    Args:
        root: the folder with `motions_smpl`.
    """

    name = "aioz"
    title = "AIOZ-GDANCE"
    source = "https://github.com/aioz-ai/AIOZ-GDANCE"
    licence = "non-commercial scientific research only"
    fake = "magnet.datamodules.fakes.aioz"
    family = "smpl"
    layout = (
        ("motions_smpl/NAME.pkl", "one file a sequence"),
        ("{train,val,test}_split_sequence_names.txt", "the official lists"),
    )

    def __init__(self, root: str | Path) -> None:
        super().__init__(root)
        if not (self.root / "motions_smpl").is_dir():
            raise DataError(
                f"{self.root}: no folder motions_smpl; it holds {listing(self.root)}; give the folder that has it"
            )

    def found(self) -> list[Take]:
        paths = sorted((self.root / "motions_smpl").glob("*.pkl"), key=lambda path: path.stem)
        return [Take(path.stem, (path,), None, path.stem) for path in paths]

    def official(self) -> dict[str, Split]:
        """By the lists, or else by a hash of the video."""
        lists = {split: self.root / f"{split}_{LIST}" for split in SPLITS}
        if any(path.is_file() for path in lists.values()):
            return listed_splits(lists, _listed)
        names = {take.name for take in self.found()}
        if (self.root / LIST).is_file():
            names &= set(map(_listed, open_names(self.root / LIST)))
        # Sequences are named after their video, first and last frame: x_100_400 is of x.
        return {name: hashed_split(re.sub(r"_\d+_\d+$", "", name)) for name in names}

    def read(self, take: Take) -> Recording:
        """All dancers at 30 fps, y up, of the mean shape."""
        (path,) = take.files
        said = pickled_mapping(path)
        require(path, said, ("smpl_poses", "root_trans"))
        trans = floats(f"{path}: root_trans", said["root_trans"], ("people", "T", 3))
        if len(trans) > LARGEST:
            raise DataError(
                f"{path}: root_trans {trans.shape} would be {len(trans)} people, expected up to {LARGEST}: people come "
                f"first, then frames; {AGAIN}"
            )
        poses = self._poses(path, said)
        if poses.shape[:2] != trans.shape[:2]:
            raise DataError(
                f"{path}: people and frames are {poses.shape[:2]} of smpl_poses, but {trans.shape[:2]} of root_trans: "
                f"a partner is missing or the lengths are unequal; {AGAIN}"
            )
        people = [PersonMotion(poses[p], trans[p], np.zeros(10), f"dancer {p + 1}") for p in range(len(trans))]
        return side_by_side(path, people, 30.0, "+y", notes=[SHAPELESS])

    def _poses(self, path: Path, said: Mapping[str, Any]) -> Doubles:
        """(P, T, 22, 3); some releases keep the root's rotations apart and leave the hands out."""
        poses = floats(f"{path}: smpl_poses", said["smpl_poses"], ("people", "T", "72"))
        if "smpl_orients" in said:
            orients = floats(f"{path}: smpl_orients", said["smpl_orients"], (*poses.shape[:2], 3))
            poses = np.concatenate([orients, poses], axis=-1)
        if poses.shape[2] not in (66, 72):
            raise DataError(
                f"{path}: smpl_poses are {poses.shape}, expected (people, frames, 72) for 24 joints, or 63 or 69 "
                f"beside smpl_orients; {AGAIN}"
            )
        return poses[..., :66].reshape(*poses.shape[:2], 22, 3)


def _listed(line: str) -> str:
    """The first column without an extension."""
    return line.split(",")[0].strip().removesuffix(".pkl")


@register_data()
class AIOZ(Prepared):
    """AIOZ-GDANCE from a prepared store: scenes of up to seven people.

    Args:
        path: the store's folder.
        max_agents: slots P of every batch.
        **kwargs: as for Prepared.
    """

    reader = AIOZReader

    def __init__(self, path: str = "", max_agents: int = 7, **kwargs: Any) -> None:
        super().__init__(path=path, max_agents=max_agents, **kwargs)
