"""Files of skeletons in motion by their suffix: BVH, glTF and VRM, and FBX through Blender."""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from magnet.export.bvh_read import read_bvh
from magnet.export.cutting import kept_frames
from magnet.export.fbx import converted
from magnet.export.glb_read import read_glb
from magnet.export.gltf_file import GLTF
from magnet.export.rig_motion import RigMotion
from magnet.export.smpl_people import HELD, gap_note
from magnet.files import regular


def read_rigs(path: str | Path, start: int = 0, end: int | None = None, clip: str | None = None) -> list[RigMotion]:
    """Everybody in one file of `RIGS`.

    Args:
        path: the file.
        start, end: the frames that are kept, from 0, without `end`; None: to the last.
        clip: the animation of a GLB that is read, by its name; None: the first that moves somebody.

    Raises:
        FileNotFoundError: there is no such file.
        ImportError: an FBX, and no Blender.
        ValueError: what cannot be read; says what to do.
    """
    path = Path(path)
    if clip is None:
        return RIGS[path.suffix.lower()](path, start, end)
    if path.suffix.lower() not in GLTF:
        raise ValueError(f"{path}: clip: chooses an animation of a .glb; a .bvh has one, of an .fbx write a .glb")
    return read_glb(path, start, end, clip)


def _bvh(path: Path, start: int, end: int | None) -> list[RigMotion]:
    file = read_bvh(path, True, start, end)
    lost = () if file.tracked is None else gap_note(file.path.name, file.tracked, HELD)
    return [replace(file, notes=(*file.notes, *lost))]


def _fbx(path: Path, start: int, end: int | None) -> list[RigMotion]:
    facts = regular(path).stat()
    people = _fbx_as_it_was(str(path), facts.st_mtime_ns, facts.st_size)
    kept = kept_frames(path, people[0].frames, start, end)
    return [replace(each, path=path, place=each.place[kept], local=each.local[kept]) for each in people]


@functools.lru_cache(maxsize=2)
def _fbx_as_it_was(path: str, changed: int, size: int) -> list[RigMotion]:
    """Everybody in an FBX, which Blender takes seconds to open: whoever checks and cuts a file asks for it again."""
    with tempfile.TemporaryDirectory() as folder:
        glb = converted(Path(path), Path(folder) / "scene.glb")
        try:
            people = read_glb(glb)
        except ValueError as error:
            raise ValueError(str(error).replace(str(glb), path)) from error
        return [replace(people[0], notes=(*people[0].notes, *_takes(glb))), *people[1:]]


def _takes(glb: Path) -> list[str]:
    """Notes on the takes of an FBX that are not read, which the script that made a GLB of it lists beside it."""
    listed = glb.with_name(f"{glb.name}.takes")
    left: dict[tuple[str, str], list[str]] = {}
    for line in listed.read_text(encoding="utf-8").splitlines() if listed.exists() else []:
        who, kept, other = line.split("\t")
        left.setdefault((who, kept), []).append(repr(other))
    return [f"of {who} the take {kept!r} is read, not {', '.join(others)}" for (who, kept), others in left.items()]


RIGS: dict[str, Callable[[Path, int, int | None], list[RigMotion]]] = {
    ".bvh": _bvh,
    **dict.fromkeys(GLTF, read_glb),
    ".fbx": _fbx,
}
"""Suffixes, and what reads them."""
