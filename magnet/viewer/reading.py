"""Reads files as takes for the viewer."""

from __future__ import annotations

import json
import shlex
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path

from magnet.body.base import Body, load_body
from magnet.export.page.takes import SAMPLES, ShownTake, take, takes
from magnet.export.read_options import Reading
from magnet.export.reading import read, shared
from magnet.export.trace import DenoisingTrace
from magnet.files import DAMAGED, load_npz
from magnet.motion.scene import Scene


def read_takes(
    paths: Sequence[str | Path],
    body: Body | None = None,
    context: int = 0,
    samples: int = SAMPLES,
    options: Reading | None = None,
    say: Callable[[str], object] = lambda note: None,
) -> tuple[list[ShownTake], Body]:
    """The takes in several files, and their body.

    body: the user's; by default the open one. options: for reading; each file takes what suits its kind. say: is called
    with every note on how a file was read.

    Raises:
        FileNotFoundError: no such file.
        ValueError: a file that cannot be read, files of different frame rates or bodies; says which and what to do.
    """
    body = body or load_body("open")
    found: list[tuple[Path, ShownTake]] = []
    hows = shared(options or Reading(), *([path] for path in paths))
    for path, how in zip(map(Path, paths), hows, strict=True):
        scene, recording, notes = read_scene(path, body, how)
        for note in notes:
            say(note if len(paths) == 1 or path.name in note else f"{path.name}: {note}")
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
    if len(paths) > 1 and all(int(each.scene.present.sum()) == 1 for _, each in found):
        together = f"magnet export {shlex.join(map(str, paths))} together.npz"
        say(f"each file is a scene of its own; if they are people of one: {together}, then view it")
    return [each for _, each in found], body


def read_scene(path: Path, body: Body, options: Reading) -> tuple[Scene, DenoisingTrace | None, tuple[str, ...]]:
    """A scene file, a SMPL-X npz, a BVH or a recording of denoising steps; and notes on how it was read.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not one of these, damaged, or of another body; no such frames, or a part of a recording of steps.
    """
    if path.suffix.lower() == ".npz" and zipfile.is_zipfile(path) and is_trace(path):
        recording = DenoisingTrace.load(path)
        if recording.scene.body != body.id:
            raise ValueError(f"{path}: made for body {recording.scene.body!r}; give its file with --body MODEL.npz")
        if options != Reading():
            raise ValueError(
                f"{path}: a recording of denoising is shown whole and as it is; leave out --start, --end and what else "
                "says how files are read"
            )
        return recording.scene, recording, ()
    try:
        got = read(path, body, options)
        return got.scene, None, got.notes
    except (KeyError, TypeError, *DAMAGED) as error:
        raise ValueError(f"{path}: not readable as a scene ({error!r}); copy or download it again") from error


def is_trace(path: Path) -> bool:
    """Whether an npz holds denoising steps.

    Raises:
        ValueError: the archive is damaged.
    """
    try:
        with load_npz(path) as file:
            return "meta" in file.files and "recording" in json.loads(str(file["meta"]))
    except (OSError, TypeError, ValueError, *DAMAGED) as error:
        raise ValueError(f"{path}: not readable ({error}); copy or download it again") from error
