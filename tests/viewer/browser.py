"""What tests in a real browser share: waiting, looking, pressing."""

from __future__ import annotations

import contextlib
import io
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magnet.body import Body
from magnet.export.page.takes import ShownTake
from magnet.generation.live import Live
from magnet.testing import tiny_denoiser

SHOTS = Path(__file__).parents[2] / "runs" / "viewer"
STAGE = np.s_[:350, :480]
"""Of a screenshot, what lies beside the panel and above the timeline of two people, whose tracks have their colours."""


def wait(done: Callable[[], Any], seconds: float = 300.0) -> Any:
    """What `done` returns, as soon as that is true."""
    end = time.monotonic() + seconds
    while not (result := done()):
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.1)
    return result


def shot(page: Any, name: str, part: Any = None) -> np.ndarray:
    """A screenshot of a page or a part of it, kept. -> (H, W, 3) 0 to 255"""
    from PIL import Image

    undisturbed(page)
    SHOTS.mkdir(parents=True, exist_ok=True)
    raw = (part or page).screenshot(path=SHOTS / f"{name}.png")
    return np.asarray(Image.open(io.BytesIO(raw)).convert("RGB")).astype(int)


def blue(image: np.ndarray) -> np.ndarray:
    """Pixels of the first person."""
    return (image[..., 2] > image[..., 0] + 60) & (image[..., 2] > 90)


def orange(image: np.ndarray, least: int = 70) -> np.ndarray:
    """Pixels of the second person; with `least` 130 only where the motion was not given."""
    return (image[..., 0] > image[..., 2] + least) & (image[..., 0] > 110)


def undisturbed(page: Any, seconds: float = 0.0) -> None:
    """Close the notice that there is no GPU, if it comes within so many seconds."""
    notice = page.get_by_text("Software WebGL").locator("xpath=ancestor::*[.//button][1]").locator("button")
    with contextlib.suppress(Exception):
        if seconds:
            notice.wait_for(timeout=1000 * seconds)
        if notice.count():
            notice.dispatch_event("click")
            notice.wait_for(state="detached", timeout=30_000)


def grey(image: np.ndarray) -> np.ndarray:
    """Pixels of ghosts."""
    return (np.ptp(image, axis=-1) < 25) & (image.mean(axis=-1) > 120) & (image.mean(axis=-1) < 225)


def pale_orange(image: np.ndarray) -> np.ndarray:
    """Pixels of the second person where the motion was given."""
    red, green, blue = np.moveaxis(image, -1, 0)
    return (red > 190) & (red - blue > 22) & (red - blue < 110) & (green > blue)


def upright(mask: np.ndarray) -> bool:
    """Whether what is marked is taller than wide."""
    rows, columns = np.nonzero(mask)
    return bool(np.ptp(np.quantile(rows, [0.02, 0.98])) > 1.2 * np.ptp(np.quantile(columns, [0.02, 0.98])))


# -- the viewer ----


@contextlib.contextmanager
def shown(stage: Any, page: Any) -> Iterator[Any]:
    """A viewer that runs, and its page loaded."""
    thread = stage.start()
    try:
        page.goto(f"http://127.0.0.1:{stage.port}")
        page.get_by_role("button", name="Pause").wait_for()
        wait(lambda: stage.server.get_clients())
        undisturbed(page, 10.0)
        yield page
    finally:
        stage.stop()
        thread.join(timeout=10)


@contextlib.contextmanager
def watched(
    page: Any, takes: list[ShownTake], body: Body, truth: ShownTake | None = None, style: Any = None
) -> Iterator[Any]:
    """A viewer of takes, without true shadows, and its page loaded."""
    pytest.importorskip("viser")
    from magnet.viewer.watch import Viewer, default_render_options

    viewer = Viewer(takes, body, truth, port=0, render=default_render_options(takes, style, shadows=False))
    with shown(viewer, page):
        yield viewer


@contextlib.contextmanager
def played(page: Any, live: Live, body: Body) -> Iterator[Any]:
    """A model that plays live and has gone on from its first frames, without true shadows, and its page loaded."""
    pytest.importorskip("viser")
    from magnet.generation.live import FIRST
    from magnet.viewer.live_app import LiveApp
    from magnet.viewer.scene_view import RenderOptions

    app = LiveApp(live, body, port=0, render=RenderOptions(shadows=False))
    with shown(app, page):
        wait(lambda: live.scene.frames > FIRST)
        yield app


class Panel:
    """The viewer's controls, as a hand uses them."""

    def __init__(self, page: Any) -> None:
        self.page = page

    def field(self, label: str) -> Any:
        """The inputs beside a label."""
        return self.page.get_by_text(label, exact=True).locator("xpath=ancestor::*[.//input][1]").locator("input")

    def choose(self, label: str, value: str) -> None:
        """Pick from a drop-down list."""
        option = self.page.get_by_role("option", name=value, exact=True)

        def picked() -> bool:
            """A list may close again while the panel is still being laid out."""
            self.field(label).first.click()
            with contextlib.suppress(Exception):
                option.click(timeout=10_000)
                return True
            return False

        wait(picked)

    def enter(self, label: str, value: object) -> None:
        """Type a number into a field or beside a slider."""
        number = self.field(label).last
        number.fill(str(value))
        number.press("Enter")

    def tick(self, label: str) -> None:
        """Click a checkbox."""
        self.field(label).click()

    def press(self, name: str) -> None:
        """Press a button."""
        self.page.get_by_role("button", name=name, exact=True).click()

    def look_from(self, name: str) -> None:
        """Stand where a preset says; while people play, the camera moves as far away as a machine's speed has it."""
        self.page.get_by_text(name, exact=True).click()

    def downloaded(self, kind: str, name: str, folder: Path) -> Path:
        """Save the take as a format, from the open folder Save; the file that the browser gets."""
        self.choose("format", kind)
        with self.page.expect_download() as download:
            self.press("Download")
        assert download.value.suggested_filename == name
        path = folder / name
        download.value.save_as(path)
        return path


def keyframe_at(page: Any, panel: Panel, app: Any, frame: int) -> None:
    """Pause, go to a frame, and add the first keyframe there."""
    panel.press("Pause")
    wait(lambda: not app.clock.playing)
    app.clock.seek(frame)
    wait(lambda: app.shown == frame)
    page.get_by_text("Keyframes", exact=True).click()
    panel.press("Add keyframe here")
    wait(lambda: len(app.live.keys) == 1)


def drag_handle(page: Any, name: str, moved: Callable[[], bool]) -> None:
    """Drag the green square between a handle's arrows some way over the floor, until it has `moved`."""

    def dragged() -> bool:
        image = shot(page, name)
        red, green, blue = np.moveaxis(image, -1, 0)
        rows, columns = np.nonzero((green > red + 60) & (green > blue + 40) & (np.arange(image.shape[1]) < 480))
        if len(rows) <= 30:  # not drawn yet
            page.wait_for_timeout(1000)
            return False
        # The square is the densest place; the ring is thin.
        near = (np.abs(rows[:, None] - rows) < 8) & (np.abs(columns[:, None] - columns) < 8)
        middle = near.sum(axis=1).argmax()
        x, y = float(columns[middle]), float(rows[middle])
        page.mouse.move(x, y)
        page.mouse.down()
        for step in range(1, 9):
            page.mouse.move(x + 9 * step, y + 3 * step)
            page.wait_for_timeout(150)
        page.mouse.up()
        page.wait_for_timeout(1500)
        return moved()

    wait(dragged)


def seen(page: Any, name: str, right: Callable[[np.ndarray], Any]) -> np.ndarray:
    """A screenshot of the stage, taken again until it looks right: rendering without a GPU is slow."""

    def stage() -> np.ndarray | None:
        page.wait_for_timeout(2000)
        image = shot(page, name)[STAGE]
        return image if right(image) else None

    end = time.monotonic() + 300
    while (image := stage()) is None:
        assert time.monotonic() < end, f"{name}.png does not look right"
    return image


def shipped() -> Any:
    """The weights that come with the package, or an untrained model where there are none."""
    from magnet.denoiser.module import Denoiser

    try:
        return Denoiser.load()
    except ValueError:
        return tiny_denoiser(max_agents=4, window=16)
