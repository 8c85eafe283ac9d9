"""People out of files of SMPL's family: their motion, the clock of numbered frames, and each file's up axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from magnet.body import load_body
from magnet.datamodules.reading.arrays import Doubles, floats
from magnet.datamodules.reading.recording import Axis, DataError, Gender
from magnet.export.npz import stance_in
from magnet.export.rig import UP
from magnet.export.smpl_keys import SMPLX_PELVIS
from magnet.export.upright import agreed, axis_of, said
from magnet.motion.frames import rigid
from magnet.motion.resample import resample_points, resample_rotations, resample_valid
from magnet.motion.rotations import from_rotvec, quat_from_rotvec, quat_to_rotvec
from magnet.motion.scene import Scene

Numbers = NDArray[np.int64]

FRAMES = "frame_ids"
"""Under which trackers say which frames of a video somebody was seen in."""
LONGEST = 1_000_000
"""Frames between the first and the last one of a file that are believed: nine hours at 30 a second."""


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
    first: int | None = None  # number of its first frame, where the file numbers them
    up: Axis = "+y"  # of its own file

    @property
    def frames(self) -> int:
        return len(self.poses)

    def slice(self, start: int, stop: int) -> PosedTrack:
        part = slice(start, stop)
        return replace(self, poses=self.poses[part], place=self.place[part], valid=self.valid[part])

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
        )


# -- one clock ---------------------------------------------------------------------------------


def frame_numbers(where: object, held: Mapping[str, Any], frames: int, person: int) -> Numbers | None:
    """Which frames of a video a person's frames are, (T,); None: the file does not say, or not by numbers.

    Args:
        where: for messages.
        held: what the file has of one person, or of several along the first axis.
        frames: T.
        person: which of several.

    Raises:
        DataError: not one whole number a frame, or they do not rise.
    """
    value = np.asarray(held.get(FRAMES))
    if value.dtype.kind not in "iuf" or not value.size:  # names of pictures, say
        return None
    if value.shape == (frames, 1):
        value = value[:, 0]
    given = floats(f"{where}: {FRAMES}", value[person] if value.ndim == 2 else value, (frames,))
    with np.errstate(invalid="ignore"):
        numbers = given.astype(np.int64)
    if (given != numbers).any() or (np.diff(given) <= 0).any() or np.ptp(given) >= LONGEST:
        raise DataError(
            f"{where}: {FRAMES}: got {given[0]:g} to {given[-1]:g} for {frames} frames, expected whole numbers that "
            f"rise from frame to frame, by less than {LONGEST:,} in all; mend them, or leave them out"
        )
    return numbers


def on_one_clock(
    path: Path, tracks: Sequence[PosedTrack], numbers: Sequence[Numbers | None], names: Sequence[str]
) -> tuple[list[PosedTrack], list[str]]:
    """People of one file from the frame that the last of them begins with to the one that the first of them ends with.

    Frames between these in which a person was not seen are not valid.

    Args:
        path: the file.
        tracks: its people.
        numbers: of each one's frames.
        names: of the people, for messages.

    Returns:
        The people, and what should be known of them.

    Raises:
        DataError: only some have numbers, or they share no frame.
    """
    known = [one for one in numbers if one is not None]
    if not known:
        return list(tracks), []
    if len(known) < len(tracks):
        lack = ", ".join(name for name, one in zip(names, numbers, strict=True) if one is None)
        raise DataError(f"{path}: {FRAMES} say when others were seen, but {lack} has none; give everybody theirs")
    spans = [f"{one[0]} to {one[-1]}" for one in known]
    first, last = max(one[0] for one in known), min(one[-1] for one in known)
    if first > last:
        raise DataError(f"{path}: people were never seen together: {FRAMES} {', '.join(spans)}; save them apart")
    step = max(int(np.gcd.reduce(np.concatenate([one - known[0][0] for one in known]))), 1)
    clock = np.arange(first, last + 1, step)
    notes = [f"{path}: {FRAMES} rise by {step}: frames are taken for neighbours"] if step > 1 else []
    if len(set(spans)) > 1:
        notes.append(f"{path}: {FRAMES} are {', '.join(spans)}: cut to what all have, {first} to {last}")
    aligned = []
    for track, one, name in zip(tracks, known, names, strict=True):
        at = np.searchsorted(one, clock, side="right") - 1
        seen = one[at] == clock
        aligned.append(
            replace(track, poses=track.poses[at], place=track.place[at], valid=track.valid[at] & seen, first=int(first))
        )
        if lost := int((~seen).sum()):
            notes.append(f"{name}: {lost} of {len(clock)} frames are not in {FRAMES}, taken as not tracked: cut out")
    return aligned, notes


def require_one_beginning(files: Sequence[Path], tracks: Sequence[PosedTrack]) -> None:
    """Refuse files of one scene whose frames have other numbers at their beginnings: they are laid on each other there.

    Args:
        files: of the scene.
        tracks: the person of each.

    Raises:
        DataError: they begin with different numbers.
    """
    begun = {file.name: track.first for file, track in zip(files, tracks, strict=True) if track.first is not None}
    if len(set(begun.values())) > 1:
        raise DataError(
            f"{files[0]}: {FRAMES} of its scene's files begin at {', '.join(f'{n} ({f})' for f, n in begun.items())}: "
            "say when each begins, in seconds, by `start` in a table (docs/own.md), or save the people in one file"
        )


# -- what points up ----------------------------------------------------------------------------


def of_own_axes(files: Sequence[Path], tracks: Sequence[PosedTrack]) -> tuple[list[PosedTrack], list[str]]:
    """People with the axis that points up in each one's file, as `magnet export` finds it: somebody may lie.

    Args:
        files: of one scene: one for each person, or one for all.
        tracks: its people.

    Returns:
        The people; and what is said of files in which somebody lies or that have different axes.
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
    return [replace(track, up=_signed(up)) for track, up in zip(tracks, ups, strict=True)], notes


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


def _signed(up: str) -> Axis:
    return up if up.startswith("-") else f"+{up}"  # type: ignore[return-value]
