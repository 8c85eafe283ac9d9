"""Films of scenes: people on a floor, given motion in pink, several scenes side by side."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from magnet.body import Body
from magnet.export.cast import Cast, Scenes, cast, casts
from magnet.export.drawing import (
    CONTEXT,
    INK,
    PALE,
    Array,
    Camera,
    Canvas,
    Size,
    Style,
    View,
    drawable,
    font,
    plan_views,
    require_size,
)
from magnet.export.figures import add_ghosts, add_shadows
from magnet.extras import installing
from magnet.files import whole
from magnet.motion.scene import FPS, Scene

Report = Callable[[int, int], None]
"""Told after each frame: frames done, frames in all."""

PICTURES = (".mp4", ".gif", ".webp")
"""Suffixes of films."""
PINK = CONTEXT[0]
GENERATED = (72, 84, 106)
PAGE = (255, 255, 255)


def render_video(
    scenes: Scenes,
    path: str | Path,
    *,
    context_frames: int,
    body: Body | None = None,
    style: Style = "skeleton",
    fps: float = FPS,
    size: Size = (640, 480),
    title: str | None = None,
    ghosts: Scene | None = None,
    camera: Camera | None = None,
    trail: float = 1.5,
    speed: float = 1.0,
    progress: bool | Report = False,
) -> Path:
    """Write a film of one scene, or of several side by side at one scale and from one side. Returns the path written.

    Args:
        scenes: a scene, each of its B a panel, or labelled scenes; all of one length and frame rate.
        path: .mp4 (needs PyAV), .gif or .webp.
        context_frames: number of first frames given to the model, if the scene does not say; they are pink and marked
            in the time bar.
        body: the scenes' body model; the packaged one if None.
        style: `skeleton` strokes, `capsules` mannequins, the `body`'s own skin, or a `light` one of fewer triangles.
        fps: frames a second of the film; frames of the scene are repeated or left out. A .gif or .webp has at most 50,
            so above that some are left out, evenly: viewers slow down frames of less than 20 ms.
        size: pixels of one panel, even numbers.
        ghosts: a scene (B = 1) drawn pale in every panel, such as the ground truth.
        trail: seconds of each pelvis's path that are drawn on the floor.
        speed: seconds of the scene per second of the film.
        progress: True for a progress bar, or a function called with (done, all) after each frame.

    Raises:
        ValueError: unknown suffix, odd size, no frame rate, or scenes that cannot be drawn; says which and why.
        ImportError: .mp4 without PyAV.
    """
    path = Path(path)
    if path.suffix.lower() not in PICTURES:
        raise ValueError(f"{path.name}: cannot write a file with suffix {path.suffix!r}; use {', '.join(PICTURES)}")
    require_size(size)
    for name, value in (("fps", fps), ("speed", speed)):
        if not value > 0:
            raise ValueError(f"{name}: got {value:g}, expected more than 0")
    film = Film(scenes, context_frames, body, style, fps, size, title, ghosts, camera or Camera(), trail, speed)
    with whole(path) as part, _reporting(progress, path.name) as report:
        {".mp4": _write_mp4, ".gif": _write_gif, ".webp": _write_webp}[path.suffix.lower()](film, part, report)
    return path


class Film:
    """The frames of a film, drawn on request."""

    def __init__(
        self,
        scenes: Scenes,
        context_frames: int,
        body: Body | None,
        style: Style,
        fps: float,
        size: Size,
        title: str | None,
        ghosts: Scene | None,
        camera: Camera,
        trail: float,
        speed: float = 1.0,
    ) -> None:
        self.labels, self.casts = casts(scenes, context_frames, body, style)
        self.fps, self.size, self.trail, self.speed = fps, size, trail, speed
        self.title = None if title is None else drawable(title)
        self.scene_fps = self.casts[0].scene.fps
        self.ghost = None if ghosts is None else cast(ghosts, self.casts[0].body, "skeleton").joints
        if self.ghost is not None and len(self.ghost) != self.casts[0].frames:
            raise ValueError(f"ghosts have {len(self.ghost)} frames, the scenes {self.casts[0].frames}; cut them alike")
        groups = [c.joints for c in self.casts]
        if self.ghost is not None:
            groups = [np.concatenate([joints, self.ghost], axis=1) for joints in groups]
        self.views = plan_views(groups, camera, size, self.scene_fps)
        duration = self.casts[0].frames / self.scene_fps
        self.frames = max(1, round(duration * fps / speed))
        self.columns = len(self.casts) if len(self.casts) <= 3 else math.ceil(math.sqrt(len(self.casts)))
        self.rows = math.ceil(len(self.casts) / self.columns)
        self.header = 0 if title is None else round(0.08 * size[1] / 2) * 2
        self.context_end = self.casts[0].context
        self.size_all = (self.columns * size[0], self.rows * size[1] + self.header)

    def draw(self, index: int) -> Image.Image:
        """Frame `index` of the picture."""
        frame = min(int(index * self.speed * self.scene_fps / self.fps + 1e-6), self.casts[0].frames - 1)
        page = Image.new("RGB", self.size_all, PAGE)
        gap = 1 if len(self.casts) > 1 else 0
        for i, people in enumerate(self.casts):
            panel = paint(people, self.views[i][frame], frame, self.ghost, round(self.trail * self.scene_fps))
            corner = (i % self.columns * self.size[0], i // self.columns * self.size[1] + self.header)
            inner = panel.crop((gap, gap, self.size[0] - gap, self.size[1] - gap))
            page.paste(inner, (corner[0] + gap, corner[1] + gap))
            if self.labels[i]:
                place = (corner[0] + 0.028 * self.size[0], corner[1] + 0.03 * self.size[1])
                ImageDraw.Draw(page).text(place, self.labels[i], fill=INK, font=font(0.040 * self.size[1]))
        if self.title:
            middle = (self.size_all[0] / 2, self.header / 2)
            ImageDraw.Draw(page).text(middle, self.title, fill=INK, font=font(0.046 * self.size[1]), anchor="mm")
        self._time_bar(page, frame)
        return page

    def _time_bar(self, page: Image.Image, frame: int) -> None:
        """A bar from the first to the last frame: known part pink, a knob at now, and what now is."""
        unit = self.size[1] / 480
        left, right, y = 18 * unit, page.width - 18 * unit, page.height - 17 * unit
        last = max(self.casts[0].frames - 1, 1)
        at = left + (right - left) * frame / last
        border = left + (right - left) * min(self.context_end / last, 1.0)
        what = "context" if frame < self.context_end else "generated"
        if all(each.known[frame].all() for each in self.casts) and what == "generated":
            what = "keyframe"
        scale = 2  # the bar alone is drawn larger and shrunk, for smooth ends
        upper = int(y - 8 * unit)
        strip = page.crop((0, upper, page.width, upper + max(int(16 * unit), 1)))
        strip = strip.resize((strip.width * scale, strip.height * scale))
        draw = ImageDraw.Draw(strip)
        middle, half = strip.height / 2, 2.5 * unit * scale

        def bar(start: float, stop: float, colour: tuple[int, int, int]) -> None:
            if stop > start:
                box = (start * scale, middle - half, stop * scale, middle + half)
                draw.rounded_rectangle(box, radius=half, fill=colour)

        bar(left, right, (214, 218, 226))
        bar(left, border, (250, 196, 220))
        bar(left, at, GENERATED)
        bar(left, min(at, border), PINK)
        knob = 6 * unit * scale
        now = GENERATED if what == "generated" else PINK
        box = (at * scale - knob, middle - knob, at * scale + knob, middle + knob)
        draw.ellipse(box, fill=now, outline=PAGE, width=scale)
        page.paste(strip.reduce(scale), (0, upper))
        words = ImageDraw.Draw(page)
        face = font(15 * unit)
        if self.context_end:
            words.text((left, y - 16 * unit), what, fill=now, font=face, anchor="ls")
        seconds = (frame - self.context_end + 1 if self.context_end else frame) / self.scene_fps
        words.text((right, y - 16 * unit), stamp(seconds, bool(self.context_end)), fill=PALE, font=face, anchor="rs")


def stamp(seconds: float, signed: bool) -> str:
    """As "-0.5 s", "+0.0 s", or without a sign."""
    return f"{round(seconds, 1) + 0.0:{'+' if signed else ''}.1f} s"  # -0.0 + 0.0 is 0.0


def paint(people: Cast, view: View, frame: int, ghost: Array | None = None, trail: int = 0) -> Image.Image:
    """One panel: floor, shadows, trails, ghosts, people."""
    canvas = Canvas.of(view)
    canvas.floor()
    joints = people.joints[frame]
    if trail:
        start = max(0, frame - trail)
        for p in range(joints.shape[0]):
            way = people.joints[start : frame + 1 : 2, p, 0]
            own = people.colours[start : frame + 1 : 2, p][1:]
            age = np.linspace(0.10, 0.55, len(own))[:, None]
            canvas.trail(way, age * own + (1 - age) * np.array((232, 236, 242)))
    add_shadows(canvas, joints)
    if ghost is not None:
        add_ghosts(canvas, ghost[frame])
    people.draw(canvas, frame)
    return canvas.finished()


# -- files -------------------------------------------------------------------------------------


SHORTEST = 20
"""Milliseconds of a frame of .gif and .webp, at least: browsers show shorter ones more slowly than they say."""


def _frames(film: Film, report: Report, shown: Sequence[int] | None = None) -> Iterator[Image.Image]:
    shown = range(film.frames) if shown is None else shown
    for done, index in enumerate(shown, start=1):
        yield film.draw(index)
        report(done, len(shown))


def require_av() -> None:
    """Refuse where PyAV is not installed."""
    if importlib.util.find_spec("av") is None:
        raise ImportError(f".mp4 needs PyAV: {installing('video')}; .gif and .webp do not")


def _write_mp4(film: Film, path: Path, report: Report) -> None:
    require_av()
    import av

    with av.open(str(path), "w") as container:
        rate = Fraction(film.fps).limit_denominator(1001)
        stream = container.add_stream("libx264", rate=rate, options={"crf": "20", "preset": "veryfast"})
        stream.width, stream.height = film.size_all
        stream.pix_fmt = "yuv420p"
        for image in _frames(film, report):
            container.mux(stream.encode(av.VideoFrame.from_image(image)))
        container.mux(stream.encode())


def _write_gif(film: Film, path: Path, report: Report) -> None:
    # One palette from the start, the middle and the end, so that colours do not flicker.
    probes = [np.asarray(film.draw(i)) for i in sorted({0, film.frames // 2, film.frames - 1})]
    palette = Image.fromarray(np.concatenate(probes)).quantize(200, method=Image.Quantize.MEDIANCUT)
    shown, lasting = _timed(film, 10)
    images = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in _frames(film, report, shown))
    next(images).save(path, save_all=True, append_images=images, duration=lasting, loop=0, disposal=1)


def _write_webp(film: Film, path: Path, report: Report) -> None:
    shown, lasting = _timed(film, 1)
    first, *rest = _frames(film, report, shown)
    first.save(path, save_all=True, append_images=rest, duration=lasting, loop=0, quality=75, method=2)


def _timed(film: Film, tick: int) -> tuple[list[int], list[int]]:
    """The frames that are shown, none for less than `SHORTEST`, and milliseconds of each.

    Milliseconds are rounded to ticks so that errors do not add up.
    """
    step = max(1, math.ceil(SHORTEST * film.fps / 1000 - 1e-6))
    shown = list(range(0, film.frames, step))
    ends = np.round(np.array([*shown, film.frames]) * 1000 / film.fps / tick) * tick
    if len(shown) > 1 and ends[-1] - ends[-2] < SHORTEST:  # the last is part of the one before it
        shown, ends = shown[:-1], np.delete(ends, -2)
    return shown, np.maximum(np.diff(ends), SHORTEST).astype(int).tolist()


@contextmanager
def _reporting(progress: bool | Report, name: str) -> Iterator[Report]:
    if callable(progress):
        yield progress
    elif not progress:
        yield lambda done, total: None
    else:
        frames = (MofNCompleteColumn(), TextColumn("frames"), TimeRemainingColumn())
        with Progress(TextColumn("{task.description}"), BarColumn(), *frames) as bar:
            task = bar.add_task(f"drawing {name}", total=None)
            yield lambda done, total: bar.update(task, completed=done, total=total)
