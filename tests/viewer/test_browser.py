"""The viewer and the page in a real headless Chromium; screenshots are kept in runs/viewer."""

from __future__ import annotations

import contextlib
import io
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from magnet.body import Body
from magnet.motion.scene import Scene
from magnet.synthesis.generate import synthesize
from magnet.testing import tiny_denoiser
from magnet.viewer.html import save_html
from magnet.viewer.takes import take

pytestmark = [pytest.mark.browser, pytest.mark.slow]

SHOTS = Path(__file__).parents[2] / "runs" / "viewer"
SIZE = {"width": 800, "height": 500}
FLAGS = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-background-networking",
    "--no-first-run",
    "--disable-component-update",
    "--disable-sync",
    "--disable-quic",
)


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """Debian's Chromium, driven by Playwright, with a profile of its own."""
    api = pytest.importorskip("playwright.sync_api", reason='needs playwright: pip install "magnet-motion[browser]"')
    path = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if path is None:
        pytest.skip("needs Chromium: apt-get install chromium")
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, headless=True, args=list(FLAGS))
        try:
            yield browser
        finally:
            browser.close()


@pytest.fixture
def page(chromium: Any) -> Iterator[Any]:
    """An empty page; errors in its scripts fail the test."""
    errors: list[str] = []
    page = chromium.new_page(viewport=SIZE, accept_downloads=True)
    page.set_default_timeout(60_000)
    page.on("pageerror", lambda error: errors.append(str(error)))
    yield page
    page.close()
    assert not errors


@pytest.fixture(scope="module")
def handshake(body: Body) -> Scene:
    """Two people who meet and shake hands, 128 frames."""
    return synthesize("handshake", 2, 128, torch.Generator().manual_seed(3), body).scene


def wait(done: Callable[[], Any], seconds: float = 90.0) -> Any:
    """What `done` returns, as soon as that is true."""
    end = time.monotonic() + seconds
    while not (result := done()):
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.1)
    return result


def shot(page: Any, name: str) -> np.ndarray:
    """A screenshot, kept. -> (H, W, 3) 0 to 255"""
    from PIL import Image

    SHOTS.mkdir(parents=True, exist_ok=True)
    raw = page.screenshot(path=SHOTS / f"{name}.png")
    return np.asarray(Image.open(io.BytesIO(raw)).convert("RGB")).astype(int)


def blue(image: np.ndarray) -> np.ndarray:
    """Pixels of the first person."""
    return (image[..., 2] > image[..., 0] + 60) & (image[..., 2] > 90)


def orange(image: np.ndarray) -> np.ndarray:
    """Pixels of the second person."""
    return (image[..., 0] > image[..., 2] + 70) & (image[..., 0] > 110)


def upright(mask: np.ndarray) -> bool:
    """Whether what is marked is taller than wide."""
    rows, columns = np.nonzero(mask)
    return bool(np.ptp(np.quantile(rows, [0.02, 0.98])) > 1.2 * np.ptp(np.quantile(columns, [0.02, 0.98])))


# -- the page ----------------------------------------------------------------------------------


def test_the_page_plays_scrubs_and_changes_its_look_without_any_network(page, handshake, body, tmp_path) -> None:
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    path = save_html(handshake, tmp_path / "a.html", body, context=32, truth=handshake.cut(0, 60), title="Two people")
    page.goto(path.as_uri())
    page.wait_for_function("window.player && player.drawn > 2")
    start = page.evaluate("player.time")
    page.wait_for_function(f"player.time !== {start}")
    assert page.title() == "Two people"
    assert {url.split(":")[0] for url in asked} == {"file"}

    page.evaluate("document.getElementById('truth').click()")
    page.select_option("#from", "front")
    page.locator("#time").fill("60")
    assert page.evaluate("[player.frame, player.playing]") == [60, False]
    assert page.inner_text("#state") == "generated"
    drawn = page.evaluate("player.drawn")
    page.wait_for_function(f"player.drawn > {drawn + 1}")
    meeting = shot(page, "page_body")
    canvas = slice(40, 380)
    assert blue(meeting)[canvas].sum() > 600
    assert orange(meeting)[canvas].sum() > 600
    assert upright(orange(meeting)[canvas])

    for style in ("capsules", "skeleton"):
        page.select_option("#style", style)
        drawn = page.evaluate("player.drawn")
        page.wait_for_function(f"player.drawn > {drawn + 1}")
        assert orange(shot(page, f"page_{style}"))[canvas].sum() > 150
    page.locator("#time").fill("3")
    page.wait_for_function("document.getElementById('state').textContent === 'given'")
    page.keyboard.press("ArrowRight")
    assert page.evaluate("player.frame") == 4
    page.click("#play")
    page.wait_for_function("player.frame > 4")


def test_the_page_draws_what_the_body_says(page, handshake, body, tmp_path) -> None:
    path = save_html(handshake, tmp_path / "a.html", body)
    page.goto(path.as_uri())
    page.wait_for_function("window.player && player.drawn > 0")
    places = page.evaluate("(player.motion.pose(1, 40), Array.from(player.motion.places))")
    truth = body.joints(handshake)[0, 40, 1].numpy()
    np.testing.assert_allclose(np.reshape(places, (22, 3)), truth, atol=1e-3)


# -- the viewer --------------------------------------------------------------------------------


@contextlib.contextmanager
def shown(stage: Any, page: Any) -> Iterator[Any]:
    """A viewer that runs, and its page loaded."""
    thread = stage.start()
    try:
        page.goto(f"http://127.0.0.1:{stage.port}")
        page.get_by_role("button", name="Pause").wait_for()
        wait(lambda: stage.server.get_clients())
        with contextlib.suppress(Exception):  # the notice that there is no GPU
            page.get_by_text("Software WebGL").locator("xpath=ancestor::*[.//button][1]").locator("button").click(
                timeout=15000
            )
        yield page
    finally:
        stage.stop()
        thread.join(timeout=10)


def choose(page: Any, label: str, value: str) -> None:
    """Pick from a drop-down list of the panel."""
    row = page.get_by_text(label, exact=True).locator("xpath=ancestor::*[.//input][1]")
    row.locator("input").first.click()
    page.get_by_role("option", name=value, exact=True).click()


def drag_handle(page: Any, image: np.ndarray) -> None:
    """Drag the green square between a handle's arrows some way over the floor."""
    red, green, blue = np.moveaxis(image, -1, 0)
    rows, columns = np.nonzero((green > red + 60) & (green > blue + 40) & (np.arange(image.shape[1]) < 480))
    assert len(rows) > 30, "no handle in sight"
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


def settled(page: Any, seconds: float = 3.0) -> None:
    """Software rendering takes its time."""
    page.wait_for_timeout(1000 * seconds)


def test_files_play_pause_step_and_scrub(page, handshake, body) -> None:
    pytest.importorskip("viser")
    from magnet.viewer.watch import Viewer, first_look

    takes = [take("handshake", handshake, 32)]
    truth = take("truth", handshake.cut(4))
    viewer = Viewer(takes, body, truth, port=0, look=first_look(takes, shadows=False))
    with shown(viewer, page):
        first = viewer.shown
        wait(lambda: viewer.shown != first)
        page.get_by_role("button", name="Pause").click()
        wait(lambda: not viewer.clock.playing)
        viewer.clock.seek(60)
        wait(lambda: viewer.shown == 60)
        page.get_by_role("button", name="+1", exact=True).click()
        wait(lambda: viewer.shown == 61)
        field = page.get_by_text("frame", exact=True).locator("xpath=ancestor::*[.//input][1]").locator("input").last
        field.fill("66")
        field.press("Enter")
        wait(lambda: viewer.shown == 66)
        page.get_by_text("ground truth", exact=True).wait_for()
        settled(page, 4)
        image = shot(page, "watch_body")
        assert blue(image)[:, :480].sum() > 500
        assert orange(image)[:, :480].sum() > 500
        assert page.get_by_text("standing feet").is_visible()
        page.get_by_text("shadows", exact=True).locator("xpath=ancestor::*[.//input][1]").locator("input").click()
        wait(lambda: viewer.look.shadows)


def test_the_look_changes_and_the_scene_is_saved(page, handshake, body, tmp_path) -> None:
    pytest.importorskip("viser")
    from magnet.viewer.watch import Viewer, first_look

    takes = [take("one", handshake, 32), take("two", handshake)]
    viewer = Viewer(takes, body, port=0, look=first_look(takes, shadows=False))
    with shown(viewer, page):
        viewer.clock.playing = False
        viewer.clock.seek(64)
        choose(page, "people", "capsules")
        wait(lambda: viewer.look.style == "capsules")
        settled(page)
        assert orange(shot(page, "watch_capsules"))[:, :480].sum() > 300
        choose(page, "people", "skeleton")
        wait(lambda: viewer.look.style == "skeleton")
        settled(page)
        assert orange(shot(page, "watch_skeleton"))[:, :480].sum() > 60
        page.get_by_text("Save", exact=True).click()
        page.get_by_role("button", name=".npz").click()
        with page.expect_download() as download:
            page.get_by_text("one.npz").first.click()
        download.value.save_as(tmp_path / "one.npz")
        assert torch.equal(Scene.load(tmp_path / "one.npz").T_world_root, handshake.T_world_root)


def test_a_model_plays_live_switches_task_is_steered_restarts_and_saves(page, body, tmp_path) -> None:
    pytest.importorskip("viser")
    from magnet.viewer.live import FIRST, Live
    from magnet.viewer.play import Playground
    from magnet.viewer.troupe import Look

    live = Live(shipped(), people=2, generator=torch.Generator().manual_seed(1))
    live.settings.steps = 10
    playground = Playground(live, body, port=0, look=Look(shadows=False))
    with shown(playground, page):
        wait(lambda: live.scene.frames > FIRST)
        choose(page, "task", "motion_control")
        wait(lambda: live.settings.task == "motion_control")
        choose(page, "whom", "person 2")
        wait(lambda: 1 in live.settings.goals)
        assert live.settings.fields["target"] == (0,)
        grown = live.scene.frames
        wait(lambda: live.scene.frames > grown)
        playground.follow = playground.clock.playing = False
        settled(page)
        goal = live.settings.goals[1]
        drag_handle(page, shot(page, "live_handle"))
        wait(lambda: live.settings.goals[1] != goal)
        playground.clock.playing = True
        grown = live.scene.frames
        wait(lambda: live.scene.frames > grown + 32)
        settled(page)
        shot(page, "live_steered")
        choose(page, "whom", "nobody")
        choose(page, "task", "agentic_async")
        wait(lambda: live.settings.task == "agentic_async")
        page.get_by_text("offset of turns", exact=True).wait_for()
        choose(page, "guidance", "history")
        wait(lambda: live.settings.guidance.kind == "history")
        choose(page, "task", "partner_inpainting")
        page.get_by_text("cannot be played live").wait_for()
        choose(page, "task", "joint_future")
        version = live.version
        page.get_by_role("button", name="Restart from this frame").click()
        wait(lambda: live.version > version)
        playground.clock.playing = False
        settled(page)
        image = shot(page, "live")
        assert blue(image)[:, :480].sum() + orange(image)[:, :480].sum() > 500


def shipped() -> Any:
    """The weights that come with the package, or an untrained model where there are none."""
    from magnet.denoiser.module import Denoiser

    try:
        return Denoiser.load()
    except ValueError:
        return tiny_denoiser(max_agents=4, window=16)
