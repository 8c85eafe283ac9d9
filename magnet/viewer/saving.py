"""Takes as files, for the viewer's downloads."""

from __future__ import annotations

import io
import tempfile
import zipfile
from pathlib import Path

from magnet.body.base import Body
from magnet.export import formats
from magnet.export.page.takes import ShownTake
from magnet.motion.scene import Scene

FORMATS = tuple(s.removeprefix(".") for s in formats.WRITTEN if s not in (".fbx", *formats.USD))
"""Formats of downloads; those that need Blender or a rare package are left to `magnet export`."""


def saved(take: ShownTake, body: Body, kind: str, truth: Scene | None = None) -> tuple[str, bytes]:
    """A take as a file: its suffix without the dot, and its content. Several files, such as BVH, become a zip.

    Raises:
        ImportError: the format needs an optional package; says which.
        ValueError: another format; viser passes on whatever a client sends, and this one names a file.
    """
    if kind not in FORMATS:
        raise ValueError(f"format: got {kind!r}, expected {', '.join(FORMATS)}")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"scene.{kind}"
        if kind == "html":
            from magnet.export.page.html import save_html

            written = [save_html([take], path, body, truth=truth)]
        elif kind in ("gif", "mp4"):
            from magnet.export.video import render_video

            look = {"fps": 15.0, "size": (480, 360)} if kind == "gif" else {"fps": take.scene.fps}
            written = [render_video(take.scene, path, context_frames=0, body=body, ghosts=truth, **look)]
        else:
            written = formats.write(take.scene, path, body)
        if len(written) == 1:
            return kind, written[0].read_bytes()
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
            for each in written:
                archive.write(each, each.name)
        return "zip", packed.getvalue()
