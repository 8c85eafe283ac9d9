"""Files of skeletons in motion by their suffix: BVH, GLB, and FBX through Blender."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from magnet.export.bvh_read import read_bvh
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
    with tempfile.TemporaryDirectory() as folder:
        glb = converted(regular(path), Path(folder) / "scene.glb")
        try:
            people = read_glb(glb, start, end)
        except ValueError as error:
            raise ValueError(str(error).replace(str(glb), str(path))) from error
        return [replace(person, path=path) for person in people]


RIGS: dict[str, Callable[[Path, int, int | None], list[RigMotion]]] = {".bvh": _bvh, ".glb": read_glb, ".fbx": _fbx}
"""Suffixes, and what reads them."""
