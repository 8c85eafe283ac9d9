"""A user's own scenes: AMASS-like npz, SMPL and SMPL-X pickles, and the scenes that magnet writes."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from magnet.datamodules.reading.arrays import AGAIN, Doubles, floats, one_length, open_npz, reported
from magnet.datamodules.reading.fields import gender_of, shape_numbers
from magnet.datamodules.reading.own import OwnReader, require_alone
from magnet.datamodules.reading.own_files import PersonFile, SceneFiles
from magnet.datamodules.reading.recording import DataError, Family, Recording
from magnet.datamodules.reading.smpl_tracks import PosedTrack, of_one_beginning, of_own_axes, on_one_clock
from magnet.datamodules.registry import register_reader
from magnet.export.smpl_clock import frame_numbers
from magnet.export.smpl_keys import (
    OWN_SHAPE,
    PLACE,
    RATE,
    SCALE,
    SHAPE,
    SMPLX_PELVIS,
    WORLD,
    Unreadable,
    in_world,
    rotations,
    there_in_world,
)
from magnet.export.smpl_people import PERSON, PICKLED, held_in, is_posed, one_of, people_in, without_gaps
from magnet.motion.rotations import to_rotvec
from magnet.motion.scene import Scene

WIDTH = 66
"""Numbers of the pelvis and 21 body joints."""
FAMILIES = {69: "smpl", 72: "smpl", 156: "smplh", 165: "smplx"}
"""Whose shape numbers go with so many rotation numbers a frame; 66, the body's alone, may be anybody's."""


@register_reader
class ScenesReader(OwnReader[PosedTrack]):
    """A folder of npz, pkl and pt files of SMPL's family, one person or several each, or of scenes that magnet wrote.

    Keys may have any of the usual names (poses or root_orient and pose_body, trans or transl, betas, mocap_frame_rate
    or fps). Pickles are read without running code in them. SMPL's hand joints and SMPL-X's fingers and face are left
    out.

    Args:
        root: the folder.
        fps: frame rate of files that do not state one.
        **kwargs: as for OwnReader.

    Raises:
        DataError: no such files; says what was found.
        ValueError: a pattern that is none, or a frame rate that is not positive.
    """

    name: ClassVar[str] = "scenes"
    title: ClassVar[str] = "Scenes of SMPL's family"
    fake: ClassVar[str] = "magnet.datamodules.fakes.scenes"
    family: ClassVar[Family] = "any"
    suffixes: ClassVar[tuple[str, ...]] = (".npz", *PICKLED)
    layout: ClassVar[tuple[tuple[str, str], ...]] = (
        ("NAME_{A,B}.npz", "a person each, of SMPL's family; other ways to say who is together are in docs/own.md"),
        ("NAME.pkl", "the same of one or several people, such as {person1: {poses, trans, betas}}; or .pt"),
        ("NAME.npz", "a scene that magnet wrote, or several people in one file"),
    )
    one_person_a_file: ClassVar[bool] = False
    version: ClassVar[int] = 4  # who is in a file in the world and as a camera sees them is one person

    def __init__(self, root: str | Path, fps: float | None = None, **kwargs: Any) -> None:
        super().__init__(root, **kwargs)
        if fps is not None and not fps > 0:
            raise ValueError(f"fps: got {fps:g}, expected more than 0")
        self.fps = fps

    def scenes(self) -> dict[str, SceneFiles]:
        """All but body files, which may lie beside them."""
        return {scene: group for scene, group in self.groups.items() if not _is_body(group.people[0].file)}

    def open(self, person_file: PersonFile, alone: bool) -> tuple[list[PosedTrack], list[str]]:
        """The people in a file."""
        path = person_file.file
        if path.suffix.lower() in PICKLED:
            held: Any = held_in(path)
        else:
            keys = _keys(path)
            if "meta" in keys and not is_posed(dict.fromkeys(keys)):
                return _ours(path)
            held = open_npz(path, (), tuple(keys))
            if len(held) < len(keys) and not any(is_posed(one) for one in (held, *held.values())):
                pickled = ", ".join(key for key in keys if key not in held)
                raise DataError(
                    f"{path}: {pickled} holds pickled objects, which are not read in a npz; save a dict or a list of "
                    "people as .pkl, and arrays of one person, or people first, as .npz"
                )
        people = list(people_in(path, held))
        notes: list[str] = []
        tracks: list[PosedTrack] = []
        names: list[str] = []
        for where, one in people:
            if there_in_world(one):
                notes.append(f"{' and '.join(WORLD)} are taken, not what the camera sees")
            found = list(self._tracks(where, in_world(one), notes))
            lone = alone and len(people) == 1
            numbers, left = frame_numbers(where, one, found[0].frames, len(found), lone)
            notes += left
            tracks += [replace(track, numbers=each) for track, each in zip(found, numbers, strict=True)]
            names += [where if len(found) == 1 else f"{where}, person {p + 1}" for p in range(len(found))]
        tracks, said = on_one_clock(path, tracks, names)
        if len(people) > 1:
            one_length(path, {name: track.frames for name, track in zip(names, tracks, strict=True)})
        require_alone(path, len(tracks), alone)
        return tracks, [*notes, *said]

    def _tracks(self, where: str, held: Mapping[str, Any], notes: list[str]) -> Iterator[PosedTrack]:
        """One person, or several along the first axis."""
        poses, width = _poses(where, held)
        rate = _first(where, held, RATE, None)
        if rate is None and self.fps is None:
            raise DataError(f"{where}: says no frame rate ({', '.join(RATE)}); give --reader.fps, such as 30")
        fps = float(self.fps if rate is None else floats(f"{where}: frame rate", np.ravel(rate)[:1], (1,))[0])  # type: ignore[arg-type]
        several = poses.ndim == 3
        place = _first(where, held, PLACE)
        if np.ndim(place) == poses.ndim:
            one_length(where, {"rotations": poses.shape[-2], "translations": np.shape(place)[-2]})
        places = floats(f"{where}: translations", place, (*poses.shape[:-1], 3), finite=False)
        if SCALE in held:
            places = places / floats(f"{where}: {SCALE}", np.ravel(held[SCALE])[:1], (1,))
        own = bool(_body_of(held)) and OWN_SHAPE in held  # transl is SMPL-X's, the shapes are the open body's
        if own:
            places = places + np.asarray(SMPLX_PELVIS)
        betas = held[OWN_SHAPE] if own else _first(where, held, SHAPE, None)
        if not several:
            poses, places, betas = poses[None], places[None], None if betas is None else [betas]
        if betas is None:
            notes.append("no shape numbers: everybody has the body's mean shape")
        elif len(betas) != len(poses):
            raise DataError(f"{where}: shape numbers of {len(betas)} people for {len(poses)}; {AGAIN}")
        for p in range(len(poses)):
            shape, said = (np.zeros(10), ()) if betas is None else shape_numbers(where, {"betas": _tracked(betas[p])})
            whose = f"{where}, person {p + 1}" if several else where
            (turns, at), tracked, gaps = without_gaps(whose, poses[p, :, :WIDTH], places[p])
            notes.extend((*said, *gaps))
            yield PosedTrack(
                fps=fps,
                poses=turns.reshape(-1, 22, 3),
                place=at,
                betas=shape,
                shapes_of="" if betas is None else FAMILIES.get(width, ""),
                name=str(held.get(PERSON, "")),
                body=_body_of(held),
                at_pelvis=own,
                valid=tracked,
                gender=gender_of(one_of(held.get("gender"), p)),
            )

    def together(self, group: SceneFiles, tracks: list[PosedTrack], notes: list[str]) -> list[PosedTrack]:
        """On one clock, unless a table says when each begins, and the axis that points up in each one's file."""
        files = [person_file.file for person_file in group.people]
        if len(files) > 1 and all(person_file.start is None for person_file in group.people):
            tracks, said = of_one_beginning(files, tracks)
            notes += said
        if any(track.body for track in tracks):  # a scene of ours: y
            return tracks
        tracks, said = of_own_axes(files, tracks)
        notes += said
        return tracks

    def recording(
        self, where: str, tracks: Sequence[PosedTrack], names: Sequence[str], notes: Sequence[str]
    ) -> Recording:
        """Rotations and translations, and the axis that points up in each one's file."""
        kinds = {(track.body, track.at_pelvis) for track in tracks}
        if len(kinds) > 1:
            bodies = {track.body for track in tracks}
            raise DataError(
                f"{self.root / where}: people of different bodies: "
                f"{', '.join(sorted(b or 'SMPL' for b in bodies))}; export them for one body"
            )
        ((body, at_pelvis),) = kinds
        families = sorted({track.shapes_of for track in tracks} - {""})
        if len(families) > 1:
            raise DataError(
                f"{self.root / where}: people whose shape numbers are of different bodies: {', '.join(families)}; "
                "export them for one body"
            )
        poses = np.stack([track.poses for track in tracks], axis=1)
        place = np.stack([track.place for track in tracks], axis=1)
        ups = tuple(track.up for track in tracks)
        genders = tuple(track.gender or "neutral" for track in tracks) if any(track.gender for track in tracks) else ()
        return Recording(
            fps=tracks[0].fps,
            up=tracks[0].up,
            ups=ups if len(set(ups)) > 1 else (),
            poses=poses,
            transl=None if at_pelvis else place,
            pelvis=place if at_pelvis else None,
            body=body,
            shapes_of=families[0] if families else "",
            betas=np.stack([track.betas for track in tracks]),
            valid=np.stack([track.valid for track in tracks], axis=1),
            persons=tuple(
                n or track.name or f"person {p + 1}" for p, (n, track) in enumerate(zip(names, tracks, strict=True))
            ),
            notes=tuple(dict.fromkeys(notes)),
            genders=genders,
            said_fps=tracks[0].said_fps,
        )


# -- files -------------------------------------------------------------------------------------


def _keys(path: Path) -> list[str]:
    with reported(path, "an npz archive"), zipfile.ZipFile(path) as file:
        return [name.removesuffix(".npy") for name in file.namelist()]


def _is_body(path: Path) -> bool:
    """Whether a file is a body model, which has a template."""
    try:
        return path.suffix.lower() == ".npz" and "v_template" in _keys(path)
    except DataError:
        return False  # damaged: said when it is read


def _ours(path: Path) -> tuple[list[PosedTrack], list[str]]:
    """People of a scene that magnet wrote, and what should be known of them."""
    with reported(path, "a scene of magnet's"):
        scene = Scene.load(path)
    if scene.scenes != 1:
        raise DataError(
            f"{path}: holds {scene.scenes} scenes, expected one; write each to a file: magnet export {path.name} "
            f"one.npz --scene 0"
        )
    valid = np.ones(scene.frames, dtype=bool) if scene.valid is None else scene.valid[0].numpy()
    tracks: list[PosedTrack] = []
    notes: list[str] = []
    for p in scene.present[0].nonzero()[:, 0].tolist():
        if not scene.betas[0, p].isfinite().all():
            raise DataError(f"{path}: shape numbers hold NaN or infinity; {AGAIN}")
        rotations = torch.cat([scene.T_world_root[0, :, p, None, :3, :3], scene.body_rot[0, :, p]], dim=1).double()
        place = scene.T_world_root[0, :, p, :3, 3].double()
        (turns, at), tracked, gaps = without_gaps(f"{path}, person {p + 1}", rotations.numpy(), place.numpy())
        notes += gaps
        tracks.append(
            PosedTrack(
                fps=scene.fps,
                poses=to_rotvec(torch.from_numpy(turns)).numpy(),
                place=at,
                betas=scene.betas[0, p].double().numpy(),
                valid=valid & tracked,
                body=scene.body,
                at_pelvis=True,
            )
        )
    if not tracks:
        raise DataError(f"{path}: nobody is present in it; {AGAIN}")
    return tracks, notes


def _body_of(held: Mapping[str, Any]) -> str:
    """The body that shape numbers are of, where `magnet.export.npz.save_smplx` says it; others mean something else."""
    return str(held["body"]) if "body" in held and "surface_model_type" in held else ""


def _first(where: str, held: Mapping[str, Any], keys: Sequence[str], *otherwise: Any) -> Any:
    """The value of the first of several keys that is present."""
    for key in keys:
        if held.get(key) is not None:
            return held[key]
    if otherwise:
        return otherwise[0]
    has = ", ".join(sorted(map(str, held))[:20]) or "nothing"
    raise DataError(f"{where}: lacks {' or '.join(keys[:2])}; it has {has}; {AGAIN}")


def _tracked(betas: Any) -> NDArray[Any]:
    """Shape numbers without the rows of frames in which there are none; all of them where that would be nothing."""
    betas = np.asarray(betas)
    if betas.ndim != 2 or betas.dtype.kind != "f":
        return betas
    there = np.isfinite(betas).all(axis=1)
    return betas[there] if there.any() else betas


def _poses(where: str, held: Mapping[str, Any]) -> tuple[Doubles, int]:
    """Axis-angle numbers a frame, (T, D) or (P, T, D), D at least 66; and how many the file has."""
    try:
        whole = rotations(where, held)
    except Unreadable as error:
        raise DataError(str(error)) from error
    except ValueError as error:
        raise DataError(f"{error}; {AGAIN}") from error
    if whole.shape[-1] < WIDTH or 0 in whole.shape:
        none = "; it has no frames" if 0 in whole.shape else ""
        raise DataError(
            f"{where}: rotations: got shape {whole.shape}, expected (frames, {WIDTH} or more) in axis-angle, or people "
            f"first{none}; {AGAIN}"
        )
    return whole, whole.shape[-1]
