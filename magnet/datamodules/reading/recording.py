"""Readers of data sets and what they give: takes as files hold them, before `canonicalize`."""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from magnet.datamodules.clip import Split
from magnet.errors import DataError as DataError

if TYPE_CHECKING:
    from torch import Tensor

    from magnet.body import Body
    from magnet.motion.scene import Scene

Floats = NDArray[np.floating]
Axis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
Family = Literal["smplx", "smpl", "positions", "any"]
"""What files hold: shape numbers of SMPL-X or SMPL, positions that a body is fitted to, or this and that."""
Gender = Literal["neutral", "male", "female"]
GENDERS: tuple[Gender, ...] = get_args(Gender)


def signed(up: str) -> Axis:
    """An up axis with its sign: +z for z."""
    return up if up.startswith("-") else f"+{up}"  # type: ignore[return-value]


@dataclass(frozen=True)
class Take:
    """One scene of a download, found by its file names alone.

    Args:
        name: unique within the data set, such as "Jive_005_001".
        files: what `read` will open; with `also`, their sizes and times decide whether a prepared clip is still good.
        split: by the data set's official rule; None: the rule leaves it out.
        group: takes of one group never stand in different splits.
        also: what `read` opens besides where it is there, such as a table of all takes' roles.
    """

    name: str
    files: tuple[Path, ...]
    split: Split | None
    group: str = ""
    also: tuple[Path, ...] = ()


class PosedSkeleton(Protocol):
    """One person's skeleton, which knows how it is brought onto a body."""

    def onto(self, body: Body, up: Axis, fps: float) -> tuple[Scene, Tensor]:
        """The person on `body`, y up, at `fps`: a scene with B = P = 1, and how far joints are off, (T,) metres.

        Raises:
            ValueError: the body does not fit.
        """
        ...


class FitHints(Protocol):
    """What a recording tells of the rotations of joints; it depends on the body that is fitted."""

    def __call__(self, rest: Tensor) -> tuple[Tensor, Tensor]:
        """Rotations from a body's rest pose, and weights of the positions.

        Args:
            rest: (22, 3) joints of the body in its mean shape.

        Returns:
            (T, P, 22, 3, 3) in the file's world, NaN where they are not known; (T, P, M) how much each position counts.
        """
        ...


@dataclass(frozen=True)
class Recording:
    """One take of P people at its native rate, axes and units already in metres and radians.

    Either rotations (`poses`, `transl`, `betas`) of SMPL's family or world positions (`positions`, `joints`) to be
    fitted. Shapes are checked when built.

    Raises:
        DataError: shapes do not fit, or neither kind of motion is there.
    """

    fps: float
    up: Axis  # as the data set declares it; `canonicalize` checks it against the motion
    poses: Floats | None = None  # (T, P, 22, 3) axis-angle, pelvis first
    transl: Floats | None = None  # (T, P, 3) SMPL's transl, not the pelvis
    betas: Floats | None = None  # (P, 10)
    pelvis: Floats | None = None  # (T, P, 3) the pelvis joint itself, in place of `transl`
    body: str = ""  # id of the body that `betas` belong to; "": SMPL's family, which the user names
    shapes_of: str = ""  # family of bodies (`magnet.body.family`) that `betas` belong to, where only the files tell it
    positions: Floats | None = None  # (T, P, M, 3) world
    joints: tuple[int, ...] = ()  # (M,) which of the 22 joints `positions` are of
    hints: FitHints | None = None  # rotations beside `positions` at 30 frames a second, for the fit
    valid: NDArray[np.bool_] | None = None  # (T, P), False where tracking failed
    persons: tuple[str, ...] = ()  # names or roles, such as "leader", which a store keeps
    notes: tuple[str, ...] = field(default=())  # what was found where the layout leaves a doubt
    genders: tuple[Gender, ...] = ()  # (P,) of the body that each one's `betas` belong to; (): not known
    skeletons: tuple[PosedSkeleton, ...] = ()  # (P,) with rotations, which say more of a body than `positions`
    ups: tuple[Axis, ...] = ()  # (P,) of each one's file, in place of `up`, where rotations come from different worlds
    said_fps: float | None = None  # of the files, where `fps` is another because motion was resampled on the way

    def __post_init__(self) -> None:
        place = self.transl if self.pelvis is None else self.pelvis
        if self.poses is not None and place is not None and self.betas is not None:
            T, P = self.poses.shape[:2]
            expected = {"poses": (T, P, 22, 3), "betas": (P, 10)}
            expected["transl" if self.pelvis is None else "pelvis"] = (T, P, 3)
        elif self.positions is not None and self.joints:
            T, P = self.positions.shape[:2]
            expected = {"positions": (T, P, len(self.joints), 3)}
        else:
            raise DataError("a recording needs poses, transl and betas, or positions and joints: mend the reader")
        if self.valid is not None:
            expected["valid"] = (T, P)
        for name, want in expected.items():
            if (got := np.shape(getattr(self, name))) != want:
                raise DataError(
                    f"{name}: got {got}, expected {want} for {T} frames of {P} people; take the file as it was "
                    "published"
                )
        for name in ("persons", "genders", "skeletons", "ups"):
            words = getattr(self, name)
            if words and len(words) != P:
                raise DataError(
                    f"{name}: got {len(words)} ({', '.join(map(str, words))}), expected one for each of {P} "
                    "people: mend the reader"
                )
        if strange := [gender for gender in self.genders if gender not in GENDERS]:
            raise DataError(f"genders: got {strange[0]!r}, expected one of {', '.join(GENDERS)}: mend the reader")
        if not T or not P:
            raise DataError(f"a recording of {T} frames and {P} people, expected at least one of each; leave it out")

    @property
    def frames(self) -> int:
        motion = self.poses if self.poses is not None else self.positions
        assert motion is not None
        return len(motion)


class Reader(ABC):
    """How one data set lies on disk. A subclass also has a `fake` that writes a tiny one in the same layout.

    Options that are files or folders are annotated as `Path`: what they hold, and not what they are called, decides
    whether a prepared take is still good.

    Args:
        root: the folder of the download.

    Raises:
        DataError: nothing of the data set's layout is under `root`; says what was looked for and found.
    """

    name: ClassVar[str]  # on the command line, such as "duobox"
    title: ClassVar[str]  # as its authors write it
    source: ClassVar[str]  # address where to ask for it
    licence: ClassVar[str]  # who may use it, in one line
    family: ClassVar[Family] = "smplx"
    layout: ClassVar[tuple[tuple[str, str], ...]] = ()  # what must lie where in `root`: pattern, what it is
    shapes_of: ClassVar[tuple[str, ...]] = ()  # families of bodies that shape numbers belong to; (): `family`'s
    fake: ClassVar[str] = ""  # module of a made-up download: `scenes(takes, frames, seed)`, `write_scenes(out, scenes)`
    own: ClassVar[bool] = False  # recordings of a user's own, which any folder of such files may be
    version: ClassVar[int] = 1  # raise it whenever the same files would be read otherwise

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root)
        if not self.root.is_dir():
            raise DataError(f"{self.title}: {self.root} is not a folder; ask for the data at {self.source}")

    @classmethod
    def write_fake(cls, out: Path, takes: int = 4, frames: int = 90, seed: int = 0) -> None:
        """Write a made-up download of so many takes and frames at 30 fps into a folder.

        Raises:
            ValueError: the data set brings no fake.
        """
        if not cls.fake:
            raise ValueError(f"{cls.title} brings no made-up download; ask for the data at {cls.source}")
        fake = importlib.import_module(cls.fake)
        fake.write_scenes(out, fake.scenes(takes, frames, seed))

    @abstractmethod
    def found(self) -> list[Take]:
        """All takes in a fixed order; opens no motion and no list of splits. Names alone may tell the split."""

    def official(self) -> Mapping[str, Split] | None:
        """The split of each group by the data set's lists or rule; None: `found` tells. Not asked where the user does.

        Raises:
            DataError: a list is missing or damaged.
        """
        return None

    def takes(self) -> list[Take]:
        """All takes with their official splits."""
        found, splits = self.found(), self.official()
        return found if splits is None else [replace(take, split=splits.get(take.group)) for take in found]

    def summary(self) -> list[str]:
        """What was found by names alone that a user should see; of data sets with a fixed layout nothing."""
        return []

    @abstractmethod
    def read(self, take: Take) -> Recording:
        """Open a take's files.

        Raises:
            DataError: a file is truncated, lacks a key, has another shape or holds NaN; never a bare numpy error.
        """
