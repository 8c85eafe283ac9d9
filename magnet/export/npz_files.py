"""Scenes from npz and pkl files, of magnet or of other programs, a file a person or one for all."""

from __future__ import annotations

import contextlib
import zipfile
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from magnet.body import Body
from magnet.export.cutting import kept_frames, require_one_clock
from magnet.export.npz import clear_axes, is_open, read_smplx, require_own_rate, scene_of, stance_in, unit_against
from magnet.export.read_options import Reading
from magnet.export.rig import UP
from magnet.export.smpl_clock import FRAMES, Numbers, SharedClock, frame_numbers, require_one_beginning, shared_clock
from magnet.export.smpl_keys import posed
from magnet.export.smpl_people import HELD, PICKLED, gap_note, held_in, people_in
from magnet.export.upright import agreed, axis_of, said, told_against
from magnet.files import load_npz
from magnet.motion.scene import Scene


@dataclass(frozen=True)
class NpzFile:
    """A scene of ours or SMPL-X's keys, told apart by what they hold."""

    where: str  # the file, and who of it
    scene: Scene
    notes: list[str]
    foreign: bool  # another program wrote it
    up: str  # axis of the file
    numbers: tuple[Numbers | None, ...] = ()  # of each person's frames, where another program's file has them

    @property
    def name(self) -> str:
        """The file's name, and who of it."""
        return Path(self.where).name

    def upright(self, up: str) -> NpzFile:
        """The same where another axis of the file points up."""
        turn = torch.eye(4, dtype=torch.float64)
        turn[:3, :3] = torch.from_numpy(UP[up] @ UP[self.up].T)  # of whole numbers, so nothing is rounded
        return replace(self, up=up, scene=self.scene.replace(T_world_root=turn.float() @ self.scene.T_world_root))


def is_ours(path: Path) -> bool:
    """Whether a file is a scene as we save it; not if it cannot be read."""
    try:
        with load_npz(path) as file:
            return _ours(set(file.files))
    except Exception:  # a damaged archive may raise anything, and whoever reads it says so
        return False


def _ours(keys: set[str]) -> bool:
    return "meta" in keys and not posed(keys)


def read_people(files: Sequence[Path], body: Body, options: Reading) -> list[NpzFile]:
    """Read the npz and pkl files of one scene, other programs' with the axis that suits them together.

    People whose frames are numbered are laid on each other by these, as `magnet data prepare` does; frames in which
    somebody was not seen hold who was seen before, and are not valid. files: one for each person, or one for all.

    Returns:
        Of each file everybody, or, where a file of objects holds people by name, each of them.

    Raises:
        ValueError: a file that cannot be read, or of another body; an option that a file of ours contradicts; no such
            frames, or numbers of frames that do not go together.
    """
    up, unit, start, end = options.up, options.unit, options.start, options.end
    people = [one for file in files for one in _read(file, body, options, alone=len(files) == 1)]
    if up is None and len(people) > 1:
        people = _of_one_axis(people, body)
    warned = told_against(up, [axis for one in people for axis in clear_axes(one.scene, up)]) if up else []
    warned += unit_against([one.scene for one in people], unit) if unit else []
    people = [replace(people[0], notes=[*people[0].notes, *warned]), *people[1:]] if warned else people
    require_one_clock([one.where for one in people], [one.scene.fps for one in people], start, end)
    # Cut last: the whole file tells which way is up.
    kept = [kept_frames(one.where, one.scene.frames, start, end) for one in people]
    people = [
        replace(
            one,
            scene=one.scene.slice(part.start, part.stop),
            numbers=tuple(None if each is None else each[part] for each in one.numbers),
        )
        for one, part in zip(people, kept, strict=True)
    ]
    return _on_one_clock(people)


def _on_one_clock(people: Sequence[NpzFile]) -> list[NpzFile]:
    """Files with everybody at their moments, where numbers of frames tell these."""
    numbers: list[Numbers | None] = []
    names: list[str] = []
    for one in people:
        alone = len(one.numbers) == 1
        numbers += one.numbers
        names += [one.name if alone else f"{one.name}, person {p + 1}" for p in range(len(one.numbers))]
    if len({one.scene.fps for one in people}) > 1:
        begun = {one.name: _first(one) for one in people}
        require_one_beginning(people[0].where, begun, "cut each alone to one beginning: magnet export --start")
        return [each for one in people for each in _on_one_clock([one])]
    clock = shared_clock(people[0].where, numbers, names, HELD)
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
    if scene.valid is not None:
        seen &= scene.valid[0, at].all(dim=1)
    person = torch.arange(scene.agents)
    return scene.replace(
        body_rot=scene.body_rot[:, at, person],
        T_world_root=scene.T_world_root[:, at, person],
        valid=None if bool(seen.all()) else seen[None],
        given=None,
    )


def _of_one_axis(people: Sequence[NpzFile], body: Body) -> list[NpzFile]:
    """People of several files with the axis that suits them together: somebody may lie."""
    if len({one.up for one in people}) == 1 or any(one.scene.scenes != 1 for one in people):
        return list(people)
    stances = [stance_in(one.scene, body, one.up, not one.foreign) for one in people]
    ups = agreed(stances)
    turned = [one if one.up == up else one.upright(up) for one, up in zip(people, ups, strict=True)]
    return [
        replace(one, notes=[*one.notes, *(f"{one.name}: {note}" for note in said(stances, ups, k))])
        for k, one in enumerate(turned)
    ]


def _read(path: Path, body: Body, options: Reading, alone: bool) -> list[NpzFile]:
    """What a file holds, and how it was read. alone: no other file is of the scene"""
    how = (options.up, options.unit, options.in_fps)
    if path.suffix.lower() in PICKLED:
        there = list(people_in(path, held_in(path)))
        read = [_foreign(path, where, one, scene_of(where, one, body, *how), body, options.up) for where, one in there]
        if options.up is None:
            read = _of_one_world(read)
        return [_numbered(one, held, alone and len(there) == 1) for one, (_, held) in zip(read, there, strict=True)]
    if not zipfile.is_zipfile(path):
        raise ValueError(f"{path}: not a readable npz (no archive, or cut short); copy or download it again")
    try:
        with load_npz(path) as file:
            keys = set(file.files)
    except Exception as error:  # a damaged archive may raise anything
        raise ValueError(f"{path}: not a readable npz ({error}); copy or download it again") from error
    if _ours(keys):
        return [_own(path, body, options)]
    one = _foreign(path, str(path), keys, read_smplx(path, body, *how), body, options.up)
    held = {}
    if FRAMES in keys:
        with load_npz(path) as file, contextlib.suppress(ValueError):  # pickled, such as names of pictures
            held = {FRAMES: file[FRAMES]}
    return [_numbered(one, held, alone)]


def _own(path: Path, body: Body, options: Reading) -> NpzFile:
    """A scene as we save it."""
    if options.up not in (None, "y"):
        raise ValueError(
            f"{path}: up axis {options.up!r} is for other programs' files; in a scene of magnet y points up"
        )
    if options.unit not in (None, "m"):
        unit = f"unit {options.unit!r} is for other programs' files"
        raise ValueError(f"{path}: {unit}; lengths of a scene of magnet are metres")
    scene = Scene.load(path)
    require_own_rate(path, scene.fps, options.in_fps)
    if scene.body != body.id:
        raise ValueError(
            f"{path}: its shapes belong to body {scene.body!r}, not {body.id!r}; give its file: --body FILE"
        )
    return NpzFile(str(path), scene, [], False, "y", (None,) * scene.agents)


def _foreign(
    path: Path, where: str, keys: Collection[str], read: tuple[Scene, str], body: Body, up: str | None
) -> NpzFile:
    """A scene under SMPL-X's keys, and what should be known of it. up: as it was asked for"""
    (scene, found), name, notes = read, Path(where).name, list[str]()
    ours = {"body", "surface_model_type"} <= set(keys)
    if scene.valid is not None:
        notes += gap_note(name, scene.valid[0].numpy(), HELD)
    if up is None and found not in ("y", "z"):
        notes.append(f"{name}: people stand along {found}, which is taken for up; if they lie, say --up=y")
    if not ours and is_open(body):
        notes.append(
            f"{path.name}: SMPL-X's shapes mean nothing to the open body, which keeps its average shape; --body FILE "
            "names theirs"
        )
    return NpzFile(where, scene, notes, not ours, found)


def _of_one_world(people: Sequence[NpzFile]) -> list[NpzFile]:
    """People of one file, who share their world and so the axis along which most of them stand."""
    torsos = [one.scene.T_world_root[0, ..., :3, 1].double().mean(dim=(0, 1)).numpy() @ UP[one.up] for one in people]
    up = axis_of(np.mean(torsos, axis=0))
    return [one if one.up == up else one.upright(up) for one in people]


def _numbered(one: NpzFile, held: Mapping[str, Any], alone: bool) -> NpzFile:
    """With the numbers of each person's frames, where a file has them. alone: nobody else is in the scene"""
    numbers, notes = frame_numbers(one.where, held, one.scene.frames, one.scene.agents, alone)
    return replace(one, numbers=numbers, notes=[*one.notes, *notes])
