"""InterHuman: two people interacting, SMPL-H fits at 59.94 fps."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from magnet.datamodules.clip import SPLITS, Split
from magnet.datamodules.prepared import Prepared
from magnet.datamodules.reading.arrays import AGAIN, OR_YOURS, floats, listed_splits, open_names
from magnet.datamodules.reading.fields import listing, natural, person, pickled_mapping, side_by_side
from magnet.datamodules.reading.recording import DataError, Reader, Recording, Take
from magnet.datamodules.registry import register_data
from magnet.unpickle import mapping

RATE = 59.94
PEOPLE = ("person1", "person2")


class InterHumanReader(Reader):
    """InterHuman's `motions/<id>.pkl` with the split lists `split/{train,val,test,ignore_list}.txt`.

    Each pickle holds frames, mocap_framerate and two people's trans (T, 3), root_orient (T, 3), pose_body (T, 63) and
    betas (10). The processed person1 and person2 npy (T, 492) are not read: they have no root rotation and no shape.

    Args:
        root: the folder with `motions`.
        fps: frame rate of the recordings; files that state another rate are refused.
    """

    name = "interhuman"
    title = "InterHuman"
    source = "https://github.com/tr3e/InterGen"
    licence = "CC BY-NC-SA 4.0, by request; no redistribution"
    fake = "magnet.datamodules.fakes.interhuman"
    family = "smpl"
    layout = (
        ("motions/ID.pkl", "the raw motions, not motions_processed"),
        ("split/{train,val,test,ignore_list}.txt", "the official lists"),
    )
    shapes_of = ("smplh", "smpl")
    version = 2  # genders are read

    def __init__(self, root: str | Path, fps: float = RATE) -> None:
        super().__init__(root)
        self.fps = float(fps)
        if not (self.root / "motions").is_dir():
            raise DataError(
                f"{self.root}: no folder motions with pickles; it holds {listing(self.root)}; unpack motions.zip there "
                "(motions_processed lacks root rotations and shapes and is not read)"
            )

    def found(self) -> list[Take]:
        paths = sorted((self.root / "motions").glob("*.pkl"), key=lambda path: natural(path.stem))
        return [Take(path.stem, (path,), None, path.stem) for path in paths]

    def official(self) -> dict[str, Split]:
        """By the lists, less ignore_list.txt."""
        folder = next((at for at in (self.root / "split", self.root) if (at / "train.txt").is_file()), None)
        if folder is None:
            raise DataError(
                f"{self.root / 'split'}: no train.txt; put the download's lists train, val and test there{OR_YOURS}"
            )
        splits = listed_splits({split: folder / f"{split}.txt" for split in SPLITS})
        ignored = folder / "ignore_list.txt"
        for name in open_names(ignored) if ignored.is_file() else ():
            splits.pop(name, None)
        return splits

    def read(self, take: Take) -> Recording:
        """Both people at 59.94 fps, z up."""
        (path,) = take.files
        said = pickled_mapping(path)
        if lacking := [name for name in PEOPLE if said.get(name) is None]:
            raise DataError(
                f"{path}: the partner {' and '.join(lacking)} is missing; it has {', '.join(said)}; {AGAIN}"
            )
        notes = self._rate(path, said)
        keys = {"orient": "root_orient", "body": "pose_body", "transl": "trans"}
        held = {name: mapping(f"{path}, {name}", said[name]) for name in PEOPLE}
        people = [person(f"{path}, {name}", one, name, gender=one.get("gender"), **keys) for name, one in held.items()]
        scene = side_by_side(path, people, self.fps, "+z", notes=notes)
        frames = said.get("frames")
        if isinstance(frames, int | np.integer) and frames != scene.frames:
            raise DataError(f"{path}: says {frames} frames, but people have {scene.frames}; {AGAIN}")
        return scene

    def _rate(self, path: Path, said: Mapping[str, Any]) -> list[str]:
        if "mocap_framerate" not in said:
            return [f"no frame rate in the file, {self.fps:g} is taken"]
        rate = float(floats(f"{path}: mocap_framerate", np.ravel(said["mocap_framerate"]), (1,))[0])
        if abs(rate - self.fps) > 0.01 * self.fps:
            raise DataError(
                f"{path}: mocap_framerate is {rate:g}, expected {self.fps:g}; if the recordings really are of "
                f"{rate:g} frames a second, give --reader.fps {rate:g}"
            )
        return []


@register_data()
class InterHuman(Prepared):
    """InterHuman from a store that `magnet data prepare interhuman` made: scenes of two people."""

    reader = InterHumanReader
