"""Files of skeletons in motion by their suffix: BVH, GLB, and FBX through Blender."""

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
from magnet.export.rig_motion import RigMotion
from magnet.files import regular


def read_rigs(path: str | Path, start: int = 0, end: int | None = None) -> list[RigMotion]:
    """Everybody in one file of `RIGS`.

    Args:
        path: the file.
        start, end: the frames that are kept, from 0, without `end`; None: to the last.

    Raises:
        FileNotFoundError: there is no such file.
        ImportError: an FBX, and no Blender.
        ValueError: what cannot be read; says what to do.
    """
    path = Path(path)
    return RIGS[path.suffix.lower()](path, start, end)


def _bvh(path: Path, start: int, end: int | None) -> list[RigMotion]:
    return [read_bvh(path, start=start, end=end)]


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
            return read_glb(glb)
        except ValueError as error:
            raise ValueError(str(error).replace(str(glb), path)) from error


RIGS: dict[str, Callable[[Path, int, int | None], list[RigMotion]]] = {".bvh": _bvh, ".glb": read_glb, ".fbx": _fbx}
"""Suffixes, and what reads them."""
