"""Scenes written to files of every kind: a file's suffix says which."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from magnet.body import Body, load_body
from magnet.checks import require_number
from magnet.errors import warn_user
from magnet.export.bones import BoneOptions
from magnet.export.bvh import Unit, paths_of, person_file, save_bvh
from magnet.export.drawing import Size, Style, require_size
from magnet.export.fbx import blender, save_fbx
from magnet.export.glb import save_glb
from magnet.export.joints_csv import save_csv
from magnet.export.npz import each_of, save_smplx
from magnet.export.onto_rig import RigOptions, save_onto
from magnet.export.page.html import save_html
from magnet.export.picture import contact_sheet
from magnet.export.read_options import MOST_FPS
from magnet.export.usd import require_usd, save_usd
from magnet.export.video import PICTURES, Report, render_video, require_av
from magnet.export.vrma import save_vrma
from magnet.motion.resample import resampled
from magnet.motion.scene import Scene, require_rotations

USD = (".usdc", ".usda", ".usdz")
FILM = (640, 480)
"""Pixels of a film's panel."""
MOST_PEOPLE = 1000
"""Numbers of people that are looked for beside a file of somebody."""


@dataclass(frozen=True)
class WriteOptions:
    """The arguments of `write`."""

    body: Body
    fps: float
    unit: Unit
    smplx: bool
    context_frames: int
    style: Style
    title: str | None
    progress: bool | Report
    bones: BoneOptions
    size: Size = FILM
    each: bool = False

    @property
    def look(self) -> dict[str, Any]:
        """What pictures and pages take."""
        return {"body": self.body, "context_frames": self.context_frames, "style": self.style, "title": self.title}


@dataclass(frozen=True)
class Format:
    """A kind of file that can be written.

    Attributes:
        write: writes the file and returns the paths written.
        batch: one file holds several scenes; else each scene gets a file.
        own_rate: it chooses its frames itself; else the scene is resampled to the requested rate first.
        nan: it may hold numbers that are not finite.
        ready: raises ImportError where what writes it is not here; known before there is a scene.
    """

    write: Callable[[Scene, Path, WriteOptions], Sequence[Path]]
    batch: bool = False
    own_rate: bool = False
    nan: bool = False
    ready: Callable[[], object] = lambda: None


def _write_page(scene: Scene, path: Path, o: WriteOptions) -> Sequence[Path]:
    # A body's skin is only written where the page itself thinks it may be.
    styles: Any = None if o.style == "body" else (o.style,)
    return [save_html(scene, path, o.body, context=o.context_frames, title=o.title or "", styles=styles)]


def _write_film(scene: Scene, path: Path, o: WriteOptions) -> Sequence[Path]:
    return [render_video(scene, path, fps=o.fps, size=o.size, progress=o.progress, **o.look)]


WRITTEN: dict[str, Format] = {
    ".npz": Format(  # the scene itself; with smplx, SMPL-X's conventional keys
        lambda all, to, o: save_smplx(all, to, o.body, apart=o.each) if o.smplx else [all.save(to)],
        batch=True,
        nan=True,
    ),
    # A skeleton a person, one file each.
    ".bvh": Format(lambda one, to, o: save_bvh(one, to, o.body, unit=o.unit, names=o.bones.names)),
    ".glb": Format(lambda one, to, o: [save_glb(one, to, o.body, o.bones)]),  # everybody skinned and animated
    ".vrma": Format(lambda one, to, o: save_vrma(one, to, o.body)),  # for VRM avatars, a file a person
    ".fbx": Format(lambda one, to, o: [save_fbx(one, to, o.body, o.bones)], ready=blender),  # the same, by Blender
    **dict.fromkeys(USD, Format(lambda one, to, o: [save_usd(one, to, o.body, o.bones)], ready=require_usd)),
    ".csv": Format(lambda all, to, o: [save_csv(all, to, o.body)], batch=True),  # a table of joint positions
    ".html": Format(_write_page, batch=True),  # a page that plays the scene, by itself
    **dict.fromkeys(PICTURES, Format(_write_film, batch=True, own_rate=True)),
    ".mp4": Format(_write_film, batch=True, own_rate=True, ready=require_av),
    ".png": Format(lambda all, to, o: [contact_sheet(all, to, **o.look)], batch=True, own_rate=True),  # of moments
}
"""Suffixes that can be written, and how."""

APART = (".bvh", ".vrma")
"""Of these, which hold one person."""


def require_writer(path: Path, size: Size | None = None) -> None:
    """Refuse what `write` would refuse once there is a scene: what takes minutes to make is not to be lost.

    Raises:
        ValueError: the pixels of a film's panel cannot be.
        ImportError: Blender or a package is missing; says which.
    """
    suffix = path.suffix.lower()
    WRITTEN[suffix].ready()
    if suffix in PICTURES and size is not None:
        require_size(size)


def write(
    scene: Scene,
    path: str | Path,
    body: Body | None = None,
    *,
    fps: float | None = None,
    unit: Unit = "m",
    smplx: bool = False,
    context_frames: int = 0,
    style: Style = "body",
    title: str | None = None,
    progress: bool | Report = False,
    bones: BoneOptions = BoneOptions(),
    size: Size = FILM,
    each: bool = False,
    rigs: Sequence[str | Path] = (),
    rig_joints: Mapping[str, str] | None = None,
) -> list[Path]:
    """Write a scene in the format of the path's suffix.

    Of several scenes (B > 1), npz and csv hold all, pictures and pages show them side by side, and every other format
    gets a file each: out_scene0.glb ... Returns the paths written.

    Args:
        body: the scene's body model; None: the open one.
        fps: frames a second of what is written; None: the scene's.
        unit: of lengths in BVH.
        smplx: npz with SMPL-X's conventional keys.
        context_frames: how many first frames were given to a model, where the scene does not say; pictures mark them.
        style: how pictures show people: `body`, `light`, `capsules` or `skeleton`.
        title: of pictures.
        progress: True for a bar while films are drawn, or a function called with (done, all).
        bones: names and hierarchy of bones in GLB, FBX and USD; their names in BVH.
        size: pixels of a film's panel, width and height, even numbers.
        each: with smplx, a file per person: out_person0.npz, out_person1.npz ...
        rigs, rig_joints: characters of your own that are moved: see `magnet.export.onto_rig.save_onto`.

    Raises:
        ValueError: a suffix that nothing writes, or a scene that the format cannot hold.
        ImportError: an optional package is missing; says which.
    """
    if not isinstance(title, str | None):
        raise ValueError(f"title: got {title!r}, expected text")
    path, suffix = Path(path), Path(path).suffix.lower()
    if suffix not in WRITTEN:
        raise ValueError(f"{path.name}: cannot write a file with suffix {path.suffix!r}; use {', '.join(WRITTEN)}")
    require_frames(scene)
    kind = WRITTEN[suffix]
    body = body or load_body("open")
    if scene.body != body.id:
        raise ValueError(f"the scene's shapes belong to body {scene.body!r}, not {body.id!r}; give its file: --body")
    if fps is not None:
        require_number("fps", fps, over=0, most=MOST_FPS)
    if smplx or not kind.nan:
        require_finite(scene)
        _warn_of_invalid(scene, path)
    rate = scene.fps if fps is None else fps
    if not kind.own_rate and abs(rate - scene.fps) > 1e-6:
        context_frames = round(context_frames * rate / scene.fps)
        scene = resampled(scene, rate)
    options = WriteOptions(body, rate, unit, smplx, context_frames, style, title, progress, bones, size, each)
    places = places_of(path, scene.scenes, smplx)
    scenes = [scene] if len(places) == 1 else [scene.select([b]) for b in range(scene.scenes)]
    pairs = zip(scenes, places, strict=True)
    if rigs:
        return [made for one, to in pairs for made in save_onto(one, to, body, rigs, RigOptions(joints=rig_joints))]
    return [made for one, to in pairs for made in kind.write(one, to, options)]


def _warn_of_invalid(scene: Scene, path: Path) -> None:
    """Warn of frames that only our own scene files can mark, so that whoever reads the file takes them for motion."""
    if scene.valid is None or not (bad := (~scene.valid).nonzero().tolist()):
        return
    (b, frame), of = bad[0], f"{scene.valid.numel()} frames"
    first = f"frame {frame} of scene {b} first" if scene.scenes > 1 else f"frame {frame} first"
    warn_user(
        f"{path.name}: {len(bad)} of {of}, {first}, are marked as not valid (somebody not tracked, or made up); such a "
        "file has no marks, and holds the scene's poses there like any motion; a .npz of the scene keeps them"
    )


def places_of(path: Path, scenes: int, smplx: bool = False) -> list[Path]:
    """Where `write` puts so many scenes: in one file, or in a file each; people of `APART` have files of theirs.

    path, smplx: as for `write`.
    """
    together = WRITTEN[path.suffix.lower()].batch and not (smplx and path.suffix.lower() == ".npz")
    if scenes == 1 or together:
        return [path]
    return [path.with_name(f"{path.stem}_scene{b}{path.suffix.lower()}") for b in range(scenes)]


def files_of(
    path: Path, slots: Sequence[Sequence[int]], smplx: bool = False, each: bool = False, rigs: bool = False
) -> list[Path]:
    """The files that `write` writes, known before there is a scene. slots: of who is there in each scene"""
    places = places_of(path, len(slots), smplx)
    if smplx and each:
        return [file for place, there in zip(places, slots, strict=True) for file in each_of(place, there)]
    if path.suffix.lower() not in APART and not rigs:
        return places
    return [file for place, there in zip(places, slots, strict=True) for file in paths_of(place, there)]


def left_over(written: Sequence[Path]) -> list[Path]:
    """Files of other people beside those just written, out_person2.bvh beside those of 0 and 1: of another scene."""
    found: list[Path] = []
    for last in (path for path in written if path.stem.rpartition("_person")[2].isdecimal()):
        base, _, number = last.stem.rpartition("_person")
        if sum(path.stem.rpartition("_person")[0] == base for path in written) < 2:
            continue  # somebody alone, whose file the user has called so
        numbered = (person_file(last.with_stem(base), k) for k in itertools.count())
        below = [each for each in itertools.islice(numbered, min(int(number), MOST_PEOPLE)) if each.exists()]
        there = [*below, *itertools.takewhile(Path.exists, numbered)]
        found += [each for each in there if {each}.isdisjoint({*written, *found})]
    return found


def left_over_said(written: Sequence[Path]) -> str:
    """A sentence that names the files of `left_over`; empty if there are none."""
    others = left_over(written)
    one = len(others) == 1
    said = "lies beside what was written and is" if one else "lie beside what was written and are"
    names = ", ".join(path.name for path in others)
    return f"{names}: {said} no part of it; remove {'it' if one else 'them'} if no longer needed" if others else ""


def require_frames(scene: Scene) -> None:
    """Refuse a scene without frames, of which no file could be read again."""
    if not scene.frames:
        raise ValueError(f"the scene has 0 frames of {scene.agents} people: there is nothing to write")


def require_finite(scene: Scene, instead: str = "cut such frames out, or write .npz") -> None:
    """Refuse NaN, which other programs cannot read; only our own scene files may hold it.

    instead: what the message says to do.
    """
    shapes = (~scene.betas.isfinite().all(-1) & scene.present).nonzero().tolist()
    if shapes:
        raise ValueError(f"scene {shapes[0][0]}, agent {shapes[0][1]}: betas, the shape of the body, are not finite")
    finite = scene.T_world_root.flatten(3).isfinite().all(-1) & scene.body_rot.flatten(3).isfinite().all(-1)
    bad = (~finite & scene.present[:, None]).nonzero().tolist()
    if bad:
        b, frame, agent = bad[0]
        raise ValueError(f"scene {b}, agent {agent}: frame {frame} is not finite; {instead}")
    try:
        require_rotations(scene.replace(valid=None), "a frame that is not valid")
    except ValueError as error:
        raise ValueError(f"{error}; {instead}") from error
