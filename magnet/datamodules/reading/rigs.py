"""A user's own files of skeletons in motion, of any program: people brought onto the body by their joints' names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from magnet.body import Body
from magnet.body.joints import HEAD, JOINT_NAMES, NECK, PELVIS
from magnet.datamodules.reading.own import OwnReader
from magnet.datamodules.reading.recording import Axis, DataError, Family, Recording, signed
from magnet.export.rests import with_doubts
from magnet.export.retarget import TARGETS, onto
from magnet.export.rig import UP, Skeleton, understood_together
from magnet.export.rig_motion import RigMotion
from magnet.motion.resample import resample_points, resample_rotations, resample_valid
from magnet.motion.rotations import from_quat, to_quat
from magnet.motion.scene import Scene

Unit = Literal["m", "cm", "mm", "inch", "foot"]
LIMBS = sorted(set(TARGETS) - {NECK})
LIKELY_SHAPE = 5.0
"""Largest shape number: unusual proportions are left as a residual rather than fitted by an impossible body."""
SHOWN = 12


@dataclass(frozen=True)
class RigTrack:
    """One person of a file: a skeleton with its motion, and the options it is read with."""

    file: RigMotion
    unit: str | None
    joints: dict[str, str]
    worst: float
    said_fps: float
    up: str | None = None  # its own axis, where files of one scene differ in it: the recording is y up then

    @property
    def fps(self) -> float:
        return self.file.fps

    @property
    def frames(self) -> int:
        return self.file.frames

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Frames that the file has. (T,)"""
        return np.ones(self.frames, dtype=bool) if self.file.tracked is None else self.file.tracked

    def slice(self, start: int, stop: int) -> RigTrack:
        part = slice(start, stop)
        place, local, valid = self.file.place[part], self.file.local[part], self.valid[part]
        return replace(self, file=replace(self.file, place=place, local=local, tracked=valid))

    def resampled(self, fps: float) -> RigTrack:
        """Rotations relative to the parent by slerp, positions by straight lines."""
        if self.fps == fps:
            return self
        quat = to_quat(torch.from_numpy(self.file.local))
        local = from_quat(resample_rotations(quat, self.fps, fps)).numpy()
        place = resample_points(torch.from_numpy(self.file.place), self.fps, fps).numpy()
        valid = resample_valid(self.valid[:, None], self.fps, fps)[:, 0]
        return replace(self, file=replace(self.file, place=place, local=local, fps=fps, tracked=valid))

    def onto(self, body: Body, up: Axis, fps: float) -> tuple[Scene, Tensor]:
        """The person on `body`; fitted, unless the skeleton is the body's own."""
        (skeleton,) = _skeletons([self.resampled(fps)], self.up or up.lstrip("+"))
        scene, _ = onto(skeleton, body, self.worst, LIKELY_SHAPE)
        ours = skeleton.naming.joints
        joints = [joint for joint in LIMBS if joint in ours]
        theirs = [ours[joint] for joint in joints]
        off = body.joints(scene)[0, :, 0, joints] - torch.from_numpy(skeleton.at[:, theirs]).float()
        return scene, off.norm(dim=-1).mean(dim=-1)


def _skeletons(tracks: Sequence[RigTrack], up: str | None = None) -> list[Skeleton]:
    """Skeletons of one scene in metres, y up; the up axis is `up`, or what the format says, or found from the files."""
    prescribed = {track.file.up for track in tracks}
    up = up or (prescribed.pop() if len(prescribed) == 1 else None)
    try:
        return understood_together([track.file for track in tracks], tracks[0].unit, up, tracks[0].joints)
    except ValueError as error:
        raise DataError(str(error)) from error


class RigReader(OwnReader[RigTrack]):
    """A folder of files of skeletons; names, a pattern or a table say which belong to one scene.

    Units, up axis and which joint is which are found in each file, as `magnet export` finds them.

    Args:
        root: the folder.
        unit: of lengths; None: found from the length of the legs.
        joints: file of lines `OUR_NAME THEIR_NAME`, such as `left_hip Bone12`, for joints that no naming scheme knows.
        worst_fit: largest mean distance of limb joints from the file's, in metres; takes with a worse fit are refused.
        **kwargs: as for OwnReader.

    Raises:
        DataError: no such files; says what was found.
        ValueError: a line of `joints` that is no pair of names, or a pattern that is none.
    """

    family: ClassVar[Family] = "positions"

    def __init__(
        self,
        root: str | Path,
        unit: Unit | None = None,
        joints: Path | None = None,
        worst_fit: float = 0.04,
        **kwargs: Any,
    ) -> None:
        super().__init__(root, **kwargs)
        self.unit, self.worst_fit = unit, worst_fit
        self.joints = {} if joints is None else read_joints(Path(joints))

    def track(self, file: RigMotion) -> RigTrack:
        """A person, with the options of this reader."""
        return RigTrack(file, self.unit, self.joints, self.worst_fit, file.fps)

    def recording(
        self, where: str, tracks: Sequence[RigTrack], names: Sequence[str], notes: Sequence[str]
    ) -> Recording:
        """Skeletons, and the joints by which axis, unit and rate are checked."""
        skeletons = with_doubts(_skeletons(tracks))
        differ = len({skeleton.up for skeleton in skeletons}) > 1
        if differ:  # no one axis is all files': everybody is turned to y up by that of the own file
            tracks = [replace(track, up=one.up) for track, one in zip(tracks, skeletons, strict=True)]
        ours = [skeleton.naming.joints | {PELVIS: skeleton.chain[0]} for skeleton in skeletons]
        wanted = {PELVIS, HEAD, *LIMBS}
        joints = sorted(wanted.intersection(*ours))
        said = dict.fromkeys(_said(track, skeleton) for track, skeleton in zip(tracks, skeletons, strict=True))
        places = [
            skeleton.at[:, [numbers[joint] for joint in joints]] @ UP["y" if differ else skeleton.up]  # the files' axes
            for skeleton, numbers in zip(skeletons, ours, strict=True)
        ]
        return Recording(
            fps=tracks[0].fps,
            up="+y" if differ else signed(skeletons[0].up),
            positions=np.stack(places, axis=1),
            joints=tuple(joints),
            valid=np.stack([track.valid for track in tracks], axis=1),
            persons=tuple(
                name or track.file.person or track.file.path.stem for name, track in zip(names, tracks, strict=True)
            ),
            notes=(*notes, *said),
            skeletons=tuple(replace(track, unit=one.unit) for track, one in zip(tracks, skeletons, strict=True)),
            said_fps=tracks[0].said_fps,
        )


def _said(track: RigTrack, skeleton: Skeleton) -> str:
    """How a file was read, in words that are the same for files of one kind."""
    naming, names = skeleton.naming, skeleton.file.names
    used = {*naming.joints.values(), *skeleton.chain}
    rest = [name for number, name in enumerate(names) if number not in used]
    more = f", ... {len(rest)} in all" if len(rest) > SHOWN else ""
    unused = f"; not used: {', '.join(rest[:SHOWN])}{more}" if rest else ""
    return (
        f"names of {naming.scheme}, {len(naming.joints)} joints; {skeleton.unit}, {signed(skeleton.up)} up, "
        f"{track.said_fps:g} fps{unused}{''.join(f'; {note}' for note in skeleton.notes)}"
    )


def read_joints(path: Path) -> dict[str, str]:
    """Lines `OUR_NAME THEIR_NAME`; theirs may hold spaces. A # begins a comment.

    Raises:
        ValueError: no such file, or a line that is no pair, or not of our joints; names it.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: cannot be read as lines OUR_NAME THEIR_NAME ({error})") from error
    found: dict[str, str] = {}
    for number, line in enumerate(lines, 1):
        words = line.partition("#")[0].replace("=", " ").split(maxsplit=1)
        if not words:
            continue
        if len(words) != 2 or words[0] not in JOINT_NAMES or words[0] in found:
            raise ValueError(
                f"{path}, line {number}: got {line.strip()!r}, expected OUR_NAME THEIR_NAME, ours once and of "
                f"{', '.join(JOINT_NAMES)}"
            )
        found[words[0]] = words[1].strip()
    return found
