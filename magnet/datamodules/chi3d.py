"""CHI3D: pairs of people in contact, SMPL-X as rotation matrices at 50 fps, z up."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from magnet.datamodules.clip import Split
from magnet.datamodules.prepared import Prepared
from magnet.datamodules.reading.arrays import AGAIN, Doubles, floats, hashed_split, open_json, require
from magnet.datamodules.reading.fields import listing, person, side_by_side
from magnet.datamodules.reading.recording import DataError, Reader, Recording, Take
from magnet.datamodules.registry import register_data
from magnet.motion.rotations import to_rotvec
from magnet.unpickle import mapping

SHAPES = {"transl": (3,), "global_orient": (1, 3, 3), "body_pose": (21, 3, 3), "betas": (10,)}
"""Of each key, after (2, T)."""
FOLDERS = ("train", "test")
PEOPLE = ("with markers", "without markers")


class CHI3DReader(Reader):
    """CHI3D's `chi3d/{train,test}/<pair>/smplx/<action>.json`: rotation matrices (2, T, J, 3, 3).

    The authors do not publish the motion of their own test pairs (s01, s05). So `test_pairs` of the training folder
    are for testing, and a tenth of the other takes, by a hash of their names, for validation. Motion in the test
    folder, if there is any, is for testing as well.

    Args:
        root: the folder `chi3d`, or the one above.
        test_pairs: pairs held out for testing (ours).
    """

    name = "chi3d"
    title = "CHI3D"
    source = "http://vision.imar.ro/ci3d"
    licence = "non-commercial research only, by form; no redistribution"
    fake = "magnet.datamodules.fakes.chi3d"
    family = "smplx"
    layout = (("chi3d/train/sXX/smplx/ACTION.json", "both people; train may lie in --root itself"),)

    def __init__(self, root: str | Path, test_pairs: Sequence[str] = ("s03",)) -> None:
        super().__init__(root)
        self.test_pairs = frozenset(test_pairs)
        self.folder = self.root / "chi3d" if (self.root / "chi3d").is_dir() else self.root
        if not any(self.folder.glob("*/*/smplx")):
            raise DataError(
                f"{self.folder}: no train/sXX/smplx; it holds {listing(self.folder)}; give the download's folder chi3d"
            )

    def found(self) -> list[Take]:
        takes = []
        for folder in FOLDERS:
            for path in sorted(self.folder.glob(f"{folder}/*/smplx/*.json")):
                pair = path.parent.parent.name
                name = f"{pair}_{path.stem}"
                held = folder == "test" or pair in self.test_pairs
                split: Split = "test" if held else hashed_split(name, test=0.0)
                takes.append(Take(name, (path,), split, name))
        return takes

    def read(self, take: Take) -> Recording:
        """The person with markers and the one without, at 50 fps, z up."""
        (path,) = take.files
        said = mapping(path, open_json(path))
        require(path, said, tuple(SHAPES))
        if lonely := [key for key in SHAPES if isinstance(said[key], list) and len(said[key]) == 1]:
            raise DataError(f"{path}: {', '.join(lonely)} of one person: the partner is missing; {AGAIN}")
        arrays = {key: floats(f"{path}: {key}", said[key], (2, "T", *shape)) for key, shape in SHAPES.items()}
        for key in ("global_orient", "body_pose"):
            arrays[key] = axis_angle(f"{path}: {key}", arrays[key])
        people = [
            person(f"{path}, {name}", {key: array[p] for key, array in arrays.items()}, name)
            for p, name in enumerate(PEOPLE)
        ]
        return side_by_side(path, people, 50.0, "+z")


def axis_angle(where: object, matrices: Doubles) -> Doubles:
    """Rotation vectors of rotation matrices. (..., 3, 3) -> (..., 3)

    Raises:
        DataError: some are no rotations.
    """
    off = np.abs(matrices @ np.swapaxes(matrices, -1, -2) - np.eye(3)).max(axis=(-1, -2))
    wrong = (off > 1e-2) | (np.linalg.det(matrices) < 0)
    if wrong.any():
        raise DataError(
            f"{where}: {int(wrong.sum())} of {wrong.size} matrices are no rotations (off by up to {off.max():.2g}); "
            f"expected orthonormal right-handed 3 x 3 matrices; {AGAIN}"
        )
    return to_rotvec(torch.from_numpy(matrices)).numpy()


@register_data()
class CHI3D(Prepared):
    """CHI3D from a store that `magnet data prepare chi3d` made: scenes of two people."""

    reader = CHI3DReader
