"""What `magnet view` shows: takes out of files, a page of them, the steps of a denoising, a model that plays live."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch

from magnet import checkpoints
from magnet.body.base import Body, load_body
from magnet.body.floor import open_body
from magnet.cli import scene_files
from magnet.cli.kept_checkpoints import checkpoint_of
from magnet.cli.named_files import require_there
from magnet.denoiser.core import DenoiserCore
from magnet.errors import counted
from magnet.export.page.html import save_html
from magnet.export.page.takes import ShownTake
from magnet.export.read_options import Reading
from magnet.export.reading import shared
from magnet.generation.live import Live
from magnet.generation.trace import record
from magnet.motion.scene import Scene
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.sampling.grid import Grid
from magnet.sampling.options import SamplerOptions
from magnet.tasks import registry
from magnet.tasks.base import schedule_of
from magnet.viewer.live_app import LiveApp
from magnet.viewer.reading import read_takes
from magnet.viewer.scene_view import RenderOptions
from magnet.viewer.watch import Viewer, default_render_options

EXAMPLE = "duet"
"""Scene that a live model goes on from where nothing is said: its couple stays together (docs/viewer.md)."""


def write_page(options: argparse.Namespace) -> int:
    """Write a page that plays everything. Returns the exit code."""
    takes, body = read_files(options)
    truth = truth_of(options, body, takes[0].scene.fps)
    styles = (options.style,) if options.style else None
    path = save_html(takes, options.html, body, truth=None if truth is None else truth.scene, styles=styles)
    print(f"written: {path} ({path.stat().st_size / 1e6:.1f} MB)")
    return 0


def viewer(options: argparse.Namespace) -> Viewer:
    """A viewer of files, or of the denoising of what goes on from one."""
    takes, body = read_files(options)
    if options.record is not None:
        record_denoising(options, takes[0].scene)
        takes, _ = read_takes([options.record], body, options.context)
    truth = truth_of(options, body, takes[0].scene.fps)
    render = default_render_options(takes, options.style, not options.no_shadows)
    return Viewer(takes, body, truth, options.host, options.port, render)


def live_app(options: argparse.Namespace) -> LiveApp:
    """A viewer in which a model plays."""
    registry.get(options.task)
    folder = checkpoints.FOLDER / "duet" / "scenes"
    body = load_body(options.body or "open")
    start, began = None, None
    if options.files:
        takes, body = read_files(options)
        start = takes[0].scene
    own = body.id != open_body().id  # no example has it
    examples = {} if own else {path.stem: path for path in sorted(folder.glob("*.npz"))}
    if start is None and options.people is None and examples:
        start, began = Scene.load(examples[EXAMPLE]), EXAMPLE
    model = DenoiserCore.load(checkpoint_of(options.ckpt_path))
    scene_files.say_other_body(model, body.id)
    generator = torch.Generator().manual_seed(options.seed)
    live = Live(model, 2 if options.people is None else options.people, start, generator=generator, body=body.id)
    live.settings.task, live.settings.sampler = options.task, sampler_options(options)
    live.settings.steps, live.settings.guidance = live.settings.sampler.steps, live.settings.sampler.guidance
    render = RenderOptions(style=options.style or "body", shadows=not options.no_shadows)
    return LiveApp(live, body, options.host, options.port, render, examples=examples, example=began)


def how_read(options: argparse.Namespace) -> tuple[Reading, Reading]:
    """How FILEs and --truth are read."""
    truth = [options.truth] if options.truth else options.files
    of_files, of_truth = shared(scene_files.reading(options), options.files, truth)
    return of_files, of_truth


def read_files(options: argparse.Namespace) -> tuple[list[ShownTake], Body]:
    """The takes in FILEs, and their body."""
    require_there(options.files)
    how, _ = how_read(options)
    body = load_body(options.body or "open")
    takes, body = read_takes(options.files, body, options.context, options.samples, how, print)
    longest = max(each.scene.frames for each in takes)
    if options.context > longest:
        raise ValueError(f"--context {options.context}: got {counted(longest, 'frame')}; give {longest} or less")
    return takes, body


def truth_of(options: argparse.Namespace, body: Body, fps: float) -> ShownTake | None:
    """The first scene of --truth, if it is given."""
    if not options.truth:
        return None
    _, how = how_read(options)
    truth = read_takes([options.truth], body, 0, 1, how, lambda note: print(f"--truth: {note}"))[0][0]
    if abs(truth.scene.fps - fps) > 1e-3:
        raise ValueError(f"--truth has {truth.scene.fps:g} frames a second, the scenes {fps:g}: magnet export --fps")
    return truth


def record_denoising(options: argparse.Namespace, scene: Scene) -> None:
    """Write the steps in which a model goes on from a scene."""
    scene_files.require_unread(Path(options.record), [*options.files, *filter(None, [options.truth])], [1])
    task = registry.get(options.task)()
    given = options.context // TOKEN_FRAMES
    try:  # before a model is loaded
        schedule_of(task, Grid(given + max(options.frames // TOKEN_FRAMES, 1), scene.agents, given))
    except ValueError as error:
        raise ValueError(f"--record, of which --context {options.context} frames are given: {error}") from error
    model = DenoiserCore.load(checkpoint_of(options.ckpt_path))
    scene_files.say_other_body(model, scene.body)
    generator = torch.Generator().manual_seed(options.seed)
    recording = record(model, scene, task, options.context, options.frames, sampler_options(options), generator)
    print(f"written: {recording.save(options.record)}")


def sampler_options(options: argparse.Namespace) -> SamplerOptions:
    """How to sample, as --sampler and --steps say."""
    steps = scene_files.WATCHED_STEPS if options.sampler is None and options.steps is None else options.steps
    said: dict[str, Any] = {} if steps is None else {"steps": steps}
    if options.live and options.sampler is None:  # live partners are not settled, and keep apart at least
        said["apart"] = "light"
    return SamplerOptions.preset(options.sampler or "default", **said)
