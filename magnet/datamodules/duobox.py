"""DuoBox (Ready-to-React): two people boxing at 120 fps, as SMPL-X fits or as the bare skeleton they came from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from magnet.datamodules.clip import Split
from magnet.datamodules.prepared import Prepared
from magnet.datamodules.reading.arrays import one_length
from magnet.datamodules.reading.fields import (
    first_folder,
    listing,
    natural,
    person,
    pickled_mapping,
    rows,
    side_by_side,
)
from magnet.datamodules.reading.recording import DataError, Reader, Recording, Take
from magnet.datamodules.registry import register_data
from magnet.unpickle import mapping

from magnet.body.joints import (  # isort: skip
    HEAD, L_ANKLE, L_ELBOW, L_FOOT, L_HIP, L_KNEE, L_SHOULDER, L_WRIST, NECK, PELVIS, R_ANKLE, R_ELBOW, R_FOOT, R_HIP,
    R_KNEE, R_SHOULDER, R_WRIST, SPINE1, SPINE3,
)  # fmt: skip

RATE = 120.0
Form = Literal["auto", "fit", "skeleton"]
THINNING, UNIT, SKIPPED = 4, 4, 4
"""120 to 30 fps; frames that the authors' parts are multiples of; frames before their first, whose speed is unknown."""
TRAIN, VALIDATION = 0.8, 0.1
"""Of a take, its first part; of that, its last."""
PARTS: dict[str, Split] = {"tr": "train", "va": "val", "te": "test"}
PLACES = ("", "DuoBox", "data/DuoBox")
FITS, SKELETONS = "fbx_fit_smpl", "fbx_export_joints"
FILES: dict[Form, tuple[str, ...]] = {
    "auto": (f"{SKELETONS}/*.npy", f"{FITS}/*.pkl", f"{FITS}/*.npy"),
    "fit": (f"{FITS}/*.pkl", f"{FITS}/*.npy"),
    "skeleton": (f"{SKELETONS}/*.npy",),
}
"""Of a take that several have, the last one's file is read."""

MOTIVE = (
    "Hips", "Spine", "Spine1", "Neck", "Head", "LeftShoulder", "LeftArm", "LeftForeArm", "LeftHand", "RightShoulder",
    "RightArm", "RightForeArm", "RightHand", "LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToeBase", "RightUpLeg",
    "RightLeg", "RightFoot", "RightToeBase",
)  # fmt: skip
PARENTS = (-1, 0, 1, 2, 3, 2, 5, 6, 7, 2, 9, 10, 11, 0, 13, 14, 15, 0, 17, 18, 19)
MAP = {
    PELVIS: "Hips", L_HIP: "LeftUpLeg", R_HIP: "RightUpLeg", SPINE1: "Spine", L_KNEE: "LeftLeg", R_KNEE: "RightLeg",
    L_ANKLE: "LeftFoot", R_ANKLE: "RightFoot", SPINE3: "Spine1", L_FOOT: "LeftToeBase", R_FOOT: "RightToeBase",
    NECK: "Neck", HEAD: "Head", L_SHOULDER: "LeftArm", R_SHOULDER: "RightArm", L_ELBOW: "LeftForeArm",
    R_ELBOW: "RightForeArm", L_WRIST: "LeftHand", R_WRIST: "RightHand",
}  # fmt: skip
"""Our joint: MOTIVE's, the 19 pairs of DuoBox's authors (reactmotion/utils/skeleton.py): the pelvis and 18 more.

Spine2 and the collars have no counterpart; the authors leave MOTIVE's Left- and RightShoulder out."""


class DuoBoxReader(Reader):
    """DuoBox's fbx_fit_smpl/*.npy and fbx_export_joints/*.npy, each file two people by name.

    As the authors do it, a take's first 80 % train and its last 20 % test. The last 10 % of the former validate. One
    take of a file becomes several here: 000_ma_jab_liu_defense_tr0 to _tr3 (training, four phases of 120 fps thinned
    to 30), _va0 and _te0 (one phase each, for phases are near copies). No frame of any phase is in two splits.

    Args:
        root: the folder of the two, or the one above.
        form: "auto" takes the SMPL-X fit of a take, or its skeleton, which is then fitted, if there is no SMPL-X fit.
        phases: of training, 1 to 4; the authors use 4.
        validation: False leaves the official training part whole and validation empty.
    """

    name = "duobox"
    title = "DuoBox"
    source = "https://github.com/zju3dv/ready_to_react"
    licence = "by request form, no licence published: research only, no redistribution"
    fake = "magnet.datamodules.fakes.duobox"
    family = "smplx"
    layout = (
        ("fbx_fit_smpl/TAKE.npy", "SMPL-X fits of both people"),
        ("fbx_export_joints/TAKE.npy", "their skeletons, for takes without a fit"),
    )

    def __init__(self, root: str | Path, form: Form = "auto", phases: int = 4, validation: bool = True) -> None:
        super().__init__(root)
        if form not in FILES:
            raise DataError(f"form: got {form!r}, expected 'auto', 'fit' or 'skeleton': give one of them")
        if not 1 <= phases <= THINNING:
            raise DataError(f"phases: got {phases}, expected 1 to {THINNING}: give one of them")
        self.form, self.phases, self.validation = form, phases, validation
        wanted = {"auto": (FITS, SKELETONS), "fit": (FITS,), "skeleton": (SKELETONS,)}[form]
        folder = next((found for one in wanted if (found := first_folder(self.root, PLACES, f"{one}/*"))), None)
        if folder is None:
            raise DataError(
                f"DuoBox: no files in {' or '.join(f'{one}/' for one in wanted)} under {self.root}, which holds "
                f"{listing(self.root)}; give the folder that holds {FITS} and {SKELETONS}"
            )
        self.folder = folder

    def found(self) -> list[Take]:
        """Every file's parts and phases."""
        files = {path.stem: path for pattern in FILES[self.form] for path in sorted(self.folder.glob(pattern))}
        parts = [f"tr{phase}" for phase in range(self.phases)] + ["va0"] * self.validation + ["te0"]
        return [
            Take(f"{name}_{part}", (files[name],), PARTS[part[:2]], group=f"{name}_{part[:2]}")
            for name in sorted(files, key=natural)
            for part in parts
        ]

    def read(self, take: Take) -> Recording:
        """One part and phase of a take at 120 fps, z up; the authors use every fourth frame."""
        path, part = take.files[0], take.name.rsplit("_", 1)[-1]
        held = pickled_mapping(path)
        if path.parent.name == SKELETONS:
            return self._skeleton(path, held, part)
        if len(held) != 2:
            raise DataError(f"{path}: holds {', '.join(held) or 'nobody'}, expected two people by name")
        people = [person(f"{path}, {name}", mapping(f"{path}, {name}", one), name) for name, one in held.items()]
        whole = side_by_side(path, people, RATE, "+z")
        assert whole.poses is not None and whole.transl is not None
        shown = self.frames(path, whole.frames, part)
        return replace(whole, poses=whole.poses[shown], transl=whole.transl[shown])

    def _skeleton(self, path: Path, held: Mapping[str, Any], part: str) -> Recording:
        names = tuple(key.removesuffix("_position") for key in held if key.endswith("_position"))
        if len(names) != 2:
            raise DataError(
                f"{path}: has {', '.join(held) or 'nothing'}, expected NAME_position of two people; take the file "
                "as it was published"
            )
        joints, columns = tuple(MAP), [MOTIVE.index(name) for name in MAP.values()]
        people = []
        for name in names:
            places = rows(path, held, f"{name}_position", 3 * len(MOTIVE))
            people.append(places.reshape(-1, len(MOTIVE), 3)[:, columns])
        total = one_length(path, {name: len(places) for name, places in zip(names, people, strict=True)})
        positions = np.stack(people, axis=1)[self.frames(path, total, part)]
        return Recording(fps=RATE, up="+z", positions=positions, joints=joints, persons=names)

    def frames(self, where: object, total: int, part: str) -> slice:
        """Frames of a file that belong to a part such as "tr2".

        Raises:
            DataError: no such part, or the take is too short to have it.
        """
        kind, phase = part[:2], int(part[2:]) if part[2:].isdigit() else -1
        if kind not in PARTS or not 0 <= phase < THINNING:
            raise DataError(f"{where}: no part {part!r}, expected tr0 to tr3, va0 or te0: give one of them")

        def whole(phase: int) -> int:
            return len(range(phase, total - SKIPPED, THINNING)) // UNIT * UNIT

        def train(phase: int) -> int:
            return int(whole(phase) * TRAIN) // UNIT * UNIT

        # The last phase is the shortest: up to its end for all, and validation before that.
        kept = int(train(THINNING - 1) * (1 - VALIDATION)) // UNIT * UNIT if self.validation else train(phase)
        first, last = {"tr": (0, kept), "va": (kept, train(0)), "te": (train(0), whole(0))}[kind]
        if last <= first:
            raise DataError(f"{where}: {total} frames are too few to be split; leave the take out")
        start = SKIPPED + phase + THINNING * first
        return slice(start, start + THINNING * (last - first - 1) + 1)


@register_data()
class DuoBox(Prepared):
    """Boxing couples of DuoBox, from a store that `magnet data prepare duobox` made."""

    reader = DuoBoxReader
