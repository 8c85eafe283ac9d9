"""Scenes from npz files, of magnet or of other programs, a file a person or one for all."""

from __future__ import annotations

import contextlib
import zipfile
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from magnet.body import Body
from magnet.export.cutting import kept_frames, require_one_clock
from magnet.export.npz import clear_axes, is_open, read_smplx, require_own_rate, stance_in, unit_against
from magnet.export.smpl_clock import FRAMES, Numbers, SharedClock, frame_numbers, require_one_beginning, shared_clock
from magnet.export.smpl_keys import posed
from magnet.export.upright import agreed, said, told_against
from magnet.files import load_npz
from magnet.motion.scene import Scene


@dataclass(frozen=True)
class NpzFile:
    """A scene of ours or SMPL-X's keys, told apart by what they hold."""

    scene: Scene
    notes: list[str]
    foreign: bool  # another program wrote it
    up: str  # axis of the file
    numbers: tuple[Numbers | None, ...] = ()  # of each person's frames, where another program's file has them


def is_ours(path: Path) -> bool:
    """Whether a file is a scene as we save it; not if it cannot be read."""
    try:
        with load_npz(path) as file:
            return _ours(set(file.files))
    except Exception:  # a damaged archive may raise anything, and whoever reads it says so
        return False


def _ours(keys: set[str]) -> bool:
    return "meta" in keys and not posed(keys)


def read_people(
    files: Sequence[Path],
    body: Body,
    up: str | None,
    unit: str | None,
    in_fps: float | None,
    start: int = 0,
    end: int | None = None,
) -> list[NpzFile]:
    """Read the npz files of one scene, other programs' with the axis that suits them together.

    People whose frames are numbered are laid on each other by these, as `magnet data prepare` does; frames in which
    somebody was not seen hold who was seen before, and are not valid.

    Args:
        files: one for each person, or one for all.
        body, up, unit, in_fps: as in `magnet.export.npz.read_smplx`.
        start, end: the frames that are read, from 0, without `end`; None: to the last.

    Raises:
        ValueError: a file that cannot be read, or of another body; an option that a file of ours contradicts; no such
            frames, or numbers of frames that do not go together.
    """
    people = [_read(file, body, up, unit, in_fps) for file in files]
    if up is None and len(people) > 1:
        people = _of_one_axis(files, people, body, unit, in_fps)
    warned = told_against(up, [axis for one in people for axis in clear_axes(one.scene, up)]) if up else []
    warned += unit_against([one.scene for one in people], unit) if unit else []
    people = [replace(people[0], notes=[*people[0].notes, *warned]), *people[1:]] if warned else people
    require_one_clock(files, [one.scene.fps for one in people], start, end)
    # Cut last: the whole file tells which way is up.
    kept = [kept_frames(file, one.scene.frames, start, end) for file, one in zip(files, people, strict=True)]
    people = [
        replace(
            one,
            scene=one.scene.slice(part.start, part.stop),
            numbers=tuple(None if each is None else each[part] for each in one.numbers),
        )
        for one, part in zip(people, kept, strict=True)
    ]
    return _on_one_clock(files, people)


def _on_one_clock(files: Sequence[Path], people: Sequence[NpzFile]) -> list[NpzFile]:
    """Files with everybody at their moments, where numbers of frames tell these."""
    numbers: list[Numbers | None] = []
    names: list[str] = []
    for file, one in zip(files, people, strict=True):
        alone = len(one.numbers) == 1
        numbers += one.numbers
        names += [file.name if alone else f"{file.name}, person {p + 1}" for p in range(len(one.numbers))]
    if len({one.scene.fps for one in people}) > 1:
        begun = {file.name: _first(one) for file, one in zip(files, people, strict=True)}
        require_one_beginning(files[0], begun, "cut each alone to one beginning: magnet export --start")
        return list(people)
    clock = shared_clock(files[0], numbers, names, "they hold the pose before, and are not valid")
    if clock is None:
        return list(people)
    found, first = [], 0
    for one in people:
        own = slice(first, first + len(one.numbers))
        found.append(replace(one, scene=_at(one.scene, clock, own)))
        first = own.stop
    return [replace(found[0], notes=[*found[0].notes, *clock.notes]), *found[1:]]


def _first(one: NpzFile) -> int | None:
    """The number of a file's first frame."""
    return next((int(each[0]) for each in one.numbers if each is not None), None)


def _at(scene: Scene, clock: SharedClock, people: slice) -> Scene:
    """A file's people at the frames of a clock. people: which of the clock's they are"""
    at = torch.from_numpy(np.stack(clock.at[people], axis=1))  # (T, P)
    seen = torch.from_numpy(np.stack(clock.seen[people], axis=1)).all(dim=1)
    person = torch.arange(scene.agents)
    return scene.replace(
        body_rot=scene.body_rot[:, at, person],
        T_world_root=scene.T_world_root[:, at, person],
        valid=None if bool(seen.all()) else seen[None],
        given=None,
    )


def _of_one_axis(
    files: Sequence[Path], people: Sequence[NpzFile], body: Body, unit: str | None, in_fps: float | None
) -> list[NpzFile]:
    """Somebody may lie in one of the files: then it is read again with the axis of the others."""
    if len({one.up for one in people}) == 1 or any(one.scene.scenes != 1 for one in people):
        return list(people)
    stances = [stance_in(one.scene, body, one.up, not one.foreign) for one in people]
    ups = agreed(stances)
    read = []
    for k, (file, one) in enumerate(zip(files, people, strict=True)):
        again = one if ups[k] == one.up else _read(file, body, ups[k], unit, in_fps)
        read.append(replace(again, notes=[*again.notes, *(f"{file.name}: {note}" for note in said(stances, ups, k))]))
    return read


def _read(path: Path, body: Body, up: str | None, unit: str | None, in_fps: float | None) -> NpzFile:
    """A scene of ours or SMPL-X's keys, and how it was read."""
    if not zipfile.is_zipfile(path):
        raise ValueError(f"{path}: not a readable npz (no archive, or cut short); copy or download it again")
    try:
        with load_npz(path) as file:
            keys = set(file.files)
    except Exception as error:  # a damaged archive may raise anything
        raise ValueError(f"{path}: not a readable npz ({error}); copy or download it again") from error
    if _ours(keys):
        if up not in (None, "y"):
            raise ValueError(f"{path}: up axis {up!r} is for other programs' files; in a scene of magnet y points up")
        if unit not in (None, "m"):
            raise ValueError(
                f"{path}: unit {unit!r} is for other programs' files; lengths of a scene of magnet are metres"
            )
        scene = Scene.load(path)
        require_own_rate(path, scene.fps, in_fps)
        if scene.body != body.id:
            raise ValueError(
                f"{path}: its shapes belong to body {scene.body!r}, not {body.id!r}; give its file: --body FILE"
            )
        return NpzFile(scene, [], False, "y", (None,) * scene.agents)
    scene, found = read_smplx(path, body, up, unit, in_fps)
    note, ours = [], {"body", "surface_model_type"} <= keys
    if up is None and found not in ("y", "z"):
        note.append(f"{path.name}: people stand along {found}, which is taken for up; if they lie, say --up=y")
    if not ours and is_open(body):
        note.append(
            f"{path.name}: SMPL-X's shapes mean nothing to the open body, which keeps its average shape; --body FILE "
            "names theirs"
        )
    return NpzFile(scene, note, not ours, found, _numbers(path, keys, scene))


def _numbers(path: Path, keys: Collection[str], scene: Scene) -> tuple[Numbers | None, ...]:
    """The numbers of each person's frames, where a file has them."""
    held = {}
    if FRAMES in keys:
        with load_npz(path) as file, contextlib.suppress(ValueError):  # pickled, such as names of pictures
            held = {FRAMES: file[FRAMES]}
    return tuple(frame_numbers(path, held, scene.frames, p) for p in range(scene.agents))
