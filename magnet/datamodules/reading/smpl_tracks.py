"""People out of files of SMPL's family: their motion, the clock of numbered frames, and each file's up axis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from magnet.body import load_body
from magnet.datamodules.reading.arrays import Doubles
from magnet.datamodules.reading.recording import Axis, Gender, signed
from magnet.export.npz import stance_in
from magnet.export.rig import UP
from magnet.export.smpl_clock import Numbers, require_one_beginning, shared_clock
from magnet.export.smpl_keys import SMPLX_PELVIS
from magnet.export.upright import agreed, axis_of, said
from magnet.motion.frames import rigid
from magnet.motion.resample import resample_points, resample_rotations, resample_valid
from magnet.motion.rotations import from_rotvec, quat_from_rotvec, quat_to_rotvec
from magnet.motion.scene import Scene


@dataclass(frozen=True)
class PosedTrack:
    """One person: T frames of rotations, and where the pelvis or SMPL's translation is."""

    fps: float
    poses: Doubles  # (T, 22, 3) axis-angle, the pelvis's in the world
    place: Doubles  # (T, 3)
    betas: Doubles  # (10,)
    valid: NDArray[np.bool_]  # (T,)
    shapes_of: str = ""  # family of bodies that `betas` are of, where the file tells
    body: str = ""  # id of the very body, where the file says it
    at_pelvis: bool = False  # `place` is the pelvis itself
    gender: Gender | None = None
    name: str = ""
    said_fps: float | None = None
    numbers: Numbers | None = None  # (T,) of its frames, where the file has them and it is not resampled
    first: int | None = None  # the number of the file's first frame
    up: Axis = "+y"  # of its own file

    @property
    def frames(self) -> int:
        return len(self.poses)

    def slice(self, start: int, stop: int) -> PosedTrack:
        part = slice(start, stop)
        numbers = None if self.numbers is None else self.numbers[part]
        return replace(self, poses=self.poses[part], place=self.place[part], valid=self.valid[part], numbers=numbers)

    def resampled(self, fps: float) -> PosedTrack:
        if fps == self.fps:
            return self
        quat = resample_rotations(quat_from_rotvec(torch.from_numpy(self.poses)), self.fps, fps)
        return replace(
            self,
            fps=fps,
            said_fps=self.said_fps or self.fps,
            poses=quat_to_rotvec(quat).numpy(),
            place=resample_points(torch.from_numpy(self.place), self.fps, fps).numpy(),
            valid=resample_valid(self.valid[:, None], self.fps, fps)[:, 0],
            numbers=None,
        )


# -- one clock ---------------------------------------------------------------------------------


def on_one_clock(
    where: object, tracks: Sequence[PosedTrack], names: Sequence[str]
) -> tuple[list[PosedTrack], list[str]]:
    """People from the frame that the last of them begins with to the one that the first of them ends with; and notes.

    Frames between these in which a person was not seen are not valid. Who has no numbers stays as they are. where: the
    file or files; names: of the people; both for messages.
    """
    clock = shared_clock(where, [track.numbers for track in tracks], names)
    if clock is None:
        return list(tracks), []
    aligned = [
        replace(
            track,
            poses=track.poses[at],
            place=track.place[at],
            valid=track.valid[at] & seen,
            numbers=clock.numbers,
            first=int(clock.numbers[0]),
        )
        for track, at, seen in zip(tracks, clock.at, clock.seen, strict=True)
    ]
    return aligned, list(clock.notes)


def of_one_beginning(files: Sequence[Path], tracks: Sequence[PosedTrack]) -> tuple[list[PosedTrack], list[str]]:
    """People of several files, one each, on the clock that their files' numbers tell, as those of one; and notes."""
    if any(track.said_fps not in (None, track.fps) for track in tracks):
        begun = {file.name: track.first for file, track in zip(files, tracks, strict=True)}
        require_one_beginning(files[0], begun, "say when each begins, in seconds, by `start` in a table (docs/own.md)")
        return list(tracks), []
    return on_one_clock(files[0], tracks, [file.name for file in files])


# -- what points up ----------------------------------------------------------------------------


def of_own_axes(files: Sequence[Path], tracks: Sequence[PosedTrack]) -> tuple[list[PosedTrack], list[str]]:
    """People with the axis that points up in each one's file, as `magnet export` finds it: somebody may lie.

    Also notes on files in which somebody lies or that have different axes. files: one for each person, or one for all.
    """
    one_for_all = len(files) < len(tracks)
    ups = [standing(tracks)] * len(tracks) if one_for_all else [standing([track]) for track in tracks]
    notes: list[str] = []
    if len(set(ups)) > 1:
        body = load_body()
        found = [
            stance_in(_scene(track, up, body.id), body, up, sure=False) for track, up in zip(tracks, ups, strict=True)
        ]
        ups = agreed(found)
        notes = [f"{file.name}: {note}" for k, file in enumerate(files) for note in said(found, ups, k)]
    return [replace(track, up=signed(up)) for track, up in zip(tracks, ups, strict=True)], notes


def standing(tracks: Sequence[PosedTrack]) -> str:
    """The axis along which pelvises of a file stand, a key of `magnet.export.rig.UP`."""
    torsos = torch.stack([from_rotvec(torch.from_numpy(track.poses[:, 0]))[..., 1] for track in tracks])
    return axis_of(torsos.mean(dim=(0, 1)).numpy())


def _scene(track: PosedTrack, up: str, body: str) -> Scene:
    """One person in the mean shape, y up."""
    turned = from_rotvec(torch.from_numpy(track.poses))
    M, pelvis = torch.from_numpy(UP[up]), torch.from_numpy(track.place + np.asarray(SMPLX_PELVIS))
    return Scene(
        body_rot=turned[None, :, None, 1:].float(),
        T_world_root=rigid(M @ turned[:, 0], pelvis @ M.T)[None, :, None].float(),
        betas=torch.zeros(1, 1, 10),
        present=torch.ones(1, 1, dtype=torch.bool),
        fps=track.fps,
        body=body,
    )
