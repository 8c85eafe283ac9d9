"""Scenes read from files, of one person each or of all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from magnet.body import Body, load_body, on_floor
from magnet.body.floor import counting, level, lowest, off_their_floor, standing
from magnet.body.joints import HIPS
from magnet.export.cutting import rates_note, shared_frames, together
from magnet.export.formats import WRITTEN
from magnet.export.gltf_file import GLTF
from magnet.export.joints_read import load_joints
from magnet.export.npz_files import is_ours, read_people
from magnet.export.read_options import Reading
from magnet.export.retarget import load_rigs
from magnet.export.rig_files import RIGS
from magnet.export.smpl_people import PICKLED
from magnet.export.unread import advice_for
from magnet.export.upright import WARNING
from magnet.files import regular
from magnet.motion.resample import resampled
from magnet.motion.rotations import to_rotvec
from magnet.motion.scene import Scene

TABLE = ".csv"
ARRAYS = (".npz", *PICKLED)
READ = (*ARRAYS, *RIGS, TABLE)
"""Suffixes that can be read."""
UNSEEN = 0.0005
"""Metres by which people are moved without a word."""
STILL, STEPS, LONG = 0.015, 0.3, 2.0
"""Metres over the ground in which a pelvis stays, and radians through which both thighs swing, for so many seconds or
more, of nobody in their own place: of CMU's takes, in 1,493 stretches of two seconds, who swings them so goes 3.6 cm
or more, and who stays swings them by 0.16 at most."""


@dataclass(frozen=True)
class Read:
    """A scene from files, the body its shapes belong to, and notes on how it was read."""

    scene: Scene
    body: Body
    notes: tuple[str, ...]


def read(
    paths: str | Path | Sequence[str | Path], body: str | Path | Body | None = None, options: Reading | None = None
) -> Read:
    """Read a scene from a Scene npz, or SMPL's npz, pkl and pt, BVH, GLB, FBX or CSV files; several are several people.

    Args:
        body: the scene's body model, or its file; None: the open one.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: what cannot be read, or files that do not go together; says what to do.
    """
    files = [Path(paths)] if isinstance(paths, str | Path) else [Path(path) for path in paths]
    options = options or Reading()
    suffixes = {file.suffix.lower() for file in files}
    if not suffixes or not (suffixes <= set(ARRAYS) or suffixes == {TABLE} or suffixes <= set(RIGS)):
        names = ", ".join(file.name or str(file) for file in files) or "nothing"
        also = sorted(suffixes & {*WRITTEN, ".usd"} - set(READ))
        only = f"; {', '.join(also)} can be written but not read: keep an .npz of the scene beside it" if also else ""
        arrays, rigs = f"{', '.join(ARRAYS[:-1])} and {ARRAYS[-1]}", ", ".join(RIGS)
        raise ValueError(
            f"cannot read {names}: expected {arrays}, or {TABLE} files alone, or files of skeletons "
            f"({rigs}){only}{advice_for(suffixes)}"
        )
    for file in files:
        if not file.exists():
            raise FileNotFoundError(f"{file}: no such file")
        regular(file)
    body = body if isinstance(body, Body) else load_body("open" if body is None else body)
    if suffixes <= set(RIGS):
        return _from_rigs(files, body, options)
    if options.clip is not None:
        raise ValueError(f"{files[0]}: clip: chooses an animation of a .glb")
    return _from_tables(files, body, options) if suffixes == {TABLE} else _from_arrays(files, body, options)


def _from_rigs(files: Sequence[Path], body: Body, options: Reading) -> Read:
    """People by the skeletons of other programs."""
    if options.in_fps is not None:
        said = f"a {min(file.suffix.lower() for file in files)} says its own, --fps resamples"
        raise ValueError(f"in_fps: is for {', '.join((*ARRAYS, TABLE))} files that say no frame rate; {said}")
    imported = load_rigs(files, body, **vars(options))
    notes = [*(str(source) for source in imported.sources), *rates_note(imported.rates, imported.scene.fps)]
    if abs(imported.floor) >= UNSEEN:
        way = f"{'lowered' if imported.floor > 0 else 'raised'} by {100 * abs(imported.floor):.1f} cm"
        notes.append(f"everybody was {way} onto the floor; --keep_floor leaves them")
    return Read(imported.scene, body, (*notes, *_floor_note(imported.scene, body), *in_place(imported.scene)))


def _from_arrays(files: Sequence[Path], body: Body, options: Reading) -> Read:
    """Scenes of ours, and people by the keys of SMPL's family."""
    if options.joints:
        kinds = ", ".join((*RIGS, TABLE))
        raise ValueError(f"{files[0]}: joint: is for {kinds}; in arrays joints are where SMPL-X has them")
    people = read_people(files, body, options)
    scenes, foreign = [one.scene for one in people], [one.foreign for one in people]
    notes = list(dict.fromkeys(note for one in people for note in one.notes))  # people of one file share some
    if len(people) == 1:
        scene = scenes[0] if options.fps is None else resampled(scenes[0], options.fps)
    else:
        for one in people:
            if one.scene.scenes != 1:
                raise ValueError(
                    f"{one.where}: holds {one.scene.scenes} scenes; several files are several people of one scene"
                )
        scene = together(scenes, [one.where for one in people], fps=options.fps, trim=options.trim)
    notes += rates_note([one.fps for one in scenes], scene.fps)
    return _grounded(scene, body, notes, () if options.keep_floor else foreign)


def _from_tables(files: Sequence[Path], body: Body, options: Reading) -> Read:
    """People by the positions of their joints, on a body and on the floor."""
    read_so = [load_joints(file, body, options) for file in files]
    scenes, notes = [scene for scene, *_ in read_so], [note for _, note, *_ in read_so]
    rates = [scene.fps for scene in scenes]
    parts, cut = shared_frames(files, [scene.frames for scene in scenes], rates, [begin for *_, begin in read_so])
    scenes = [scene.slice(part.start or 0, part.stop) for scene, part in zip(scenes, parts, strict=True)]
    scene = together(scenes, [str(file) for file in files], fps=options.fps, trim=options.trim or bool(cut))
    notes += [*cut, *rates_note(rates, scene.fps)]
    return _grounded(scene, body, notes, () if options.keep_floor else [not ours for _, _, ours, _ in read_so])


def shared(options: Reading, *groups: Sequence[str | Path]) -> list[Reading]:
    """Options for files that are read apart from each other, as bodies for people are: each takes what suits its kind.

    What suits none of them stays, so that reading it says so.
    """
    suits: list[set[str]] = [set().union(*(_suits(Path(path)) for path in files)) for files in groups]
    anywhere, plain = set().union(*suits), Reading()
    return [replace(options, **{name: getattr(plain, name) for name in anywhere - names}) for names in suits]


def _suits(file: Path) -> set[str]:
    """The options that only some kinds of file take, and this one does."""
    if file.suffix.lower() in RIGS:
        return {"unit", "up", "joints", *(["clip"] if file.suffix.lower() in GLTF else [])}
    if file.suffix.lower() == TABLE:
        return {"unit", "up", "joints", "in_fps"}
    return set() if is_ours(file) else {"unit", "up", "in_fps"}


def warned(notes: Sequence[str]) -> list[str]:
    """The warnings among the notes of what was read, a line each."""
    lines = [line.strip() for note in notes for line in note.splitlines()]
    return [line.removeprefix(WARNING) for line in lines if line.startswith(WARNING)]


def _grounded(scene: Scene, body: Body, notes: Sequence[str], foreign: Sequence[bool]) -> Read:
    """Put the people of other programs' files onto the floor, which such files have at any height.

    foreign: of each file, whether another program wrote it. Beside a file of ours, whose floor is known, people are
    only moved where they are far from it; if there are none, nobody is.
    """
    if any(foreign) and (all(foreign) or level(scene, body)):
        moved = on_floor(scene, body)
        down = (scene.T_world_root - moved.T_world_root)[..., 1, 3].transpose(1, 2)[scene.present]
        metres = float(down.mean()) if down.numel() else 0
        if abs(metres) >= UNSEEN:
            way = "lowered" if metres > 0 else "raised"
            far = f"{100 * abs(metres):.1f} cm" if abs(metres) < 1 else f"{abs(metres):.2f} m"
            notes = [*notes, f"everybody was {way} by {far} onto the floor; --keep_floor leaves them"]
        heights = standing(lowest(moved, body), counting(moved)).flatten().tolist() if moved.frames else []
        notes = [*notes, *(off_their_floor(heights) if moved.scenes == 1 else []), *in_place(moved)]
        return Read(moved, body, tuple(notes))
    return Read(scene, body, (*notes, *_floor_note(scene, body)))


def _floor_note(scene: Scene, body: Body) -> list[str]:
    metres = level(scene, body)
    if not metres:
        return []
    where = f"{abs(metres):.2f} m {'over' if metres > 0 else 'under'} y = 0, where models have their floor"
    return [f"everybody stands {where}; `magnet export --on_floor` puts them on it"]


def in_place(scene: Scene) -> list[str]:
    """A warning of people whose legs walk and whose pelvis stays where it is, as programs export motion in place."""
    if scene.frames < LONG * scene.fps:
        return []
    over = scene.T_world_root[..., [0, 2], 3]
    still = ((over.amax(dim=1) - over.amin(dim=1)) < STILL).all(dim=-1)  # (B, P)
    hips = [joint - 1 for joint in HIPS]  # `body_rot` lacks the pelvis
    swing = to_rotvec(scene.body_rot[:, :1, :, hips].mT @ scene.body_rot[:, :, :, hips]).norm(dim=-1).amax(dim=1)
    found = (still & (swing > STEPS).all(dim=-1) & scene.present).any(dim=0).nonzero()[:, 0].tolist()
    if not found:
        return []
    who = f"person {found[0]}" if len(found) == 1 else f"people {', '.join(map(str, found))}"
    return [
        f"{WARNING}{who}: legs walk but the pelvis stays in one place; if that was exported so, export it again with "
        "the movement of the root"
    ]
