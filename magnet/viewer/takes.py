"""Reads files as takes for the viewer."""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path

from magnet.body.base import Body, load_body
from magnet.export.formats import Reading, read
from magnet.export.page.takes import SAMPLES, ShownTake, take, takes
from magnet.export.trace import DenoisingTrace
from magnet.files import load_npz
from magnet.motion.scene import Scene


def read_takes(
    paths: Sequence[str | Path],
    body: Body | None = None,
    context: int = 0,
    samples: int = SAMPLES,
    in_fps: float | None = None,
    start: int = 0,
    end: int | None = None,
) -> tuple[list[ShownTake], Body]:
    """The takes in several files, and their body.

    body: the user's; by default the open one. in_fps: frames a second of npz files that do not say it. start, end: the
    frames that are read, from 0, without `end`; None: to the last.

    Raises:
        FileNotFoundError: no such file.
        ValueError: a file that cannot be read, files of different frame rates or bodies; says which and what to do.
    """
    body = body or load_body("open")
    found: list[tuple[Path, ShownTake]] = []
    for path in map(Path, paths):
        scene, recording = read_scene(path, body, in_fps, start, end)
        here = takes(scene, path.stem, context, samples)
        if recording is not None:
            here = [take(path.stem, scene, context, recording)]
        found += [(path, each) for each in here]
    if not found:
        raise ValueError("no file to show: magnet view FILE...")
    rates = {each.scene.fps: path for path, each in found}
    if len(rates) > 1:
        listed = ", ".join(f"{path.name} has {fps:g}" for fps, path in rates.items())
        raise ValueError(f"mixed frame rates (frames a second): {listed}; show files of one rate at a time")
    return [each for _, each in found], body


def read_scene(
    path: Path, body: Body, in_fps: float | None = None, start: int = 0, end: int | None = None
) -> tuple[Scene, DenoisingTrace | None]:
    """A scene file, a SMPL-X npz, a BVH or a recording of denoising steps.

    in_fps, start, end: as for `read_takes`.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not one of these, damaged, or of another body; no such frames, or a part of a recording of steps.
    """
    if path.suffix.lower() == ".npz" and zipfile.is_zipfile(path) and is_trace(path):
        recording = DenoisingTrace.load(path)
        if recording.scene.body != body.id:
            raise ValueError(f"{path}: made for body {recording.scene.body!r}; give its file with --body MODEL.npz")
        if start or end is not None:
            raise ValueError(f"{path}: a recording of denoising is shown whole; leave out --start and --end")
        return recording.scene, recording
    try:
        return read(path, body, Reading(in_fps=in_fps, start=start, end=end)).scene, None
    except (KeyError, TypeError, EOFError, zlib.error, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: not readable as a scene ({error!r}); copy or download it again") from error


def is_trace(path: Path) -> bool:
    """Whether an npz holds denoising steps.

    Raises:
        ValueError: the archive is damaged.
    """
    try:
        with load_npz(path) as file:
            return "meta" in file.files and "recording" in json.loads(str(file["meta"]))
    except (OSError, ValueError, EOFError, zlib.error, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: not readable ({error}); copy or download it again") from error
