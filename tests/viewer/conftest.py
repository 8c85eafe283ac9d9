"""Scenes, a body and a browser for the viewer's tests."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from typing import Any

import pytest
import torch

from magnet.body import Body, load_body
from magnet.extras import installing
from magnet.generation.live import Live
from magnet.motion.scene import Scene
from magnet.synthesis.generate import synthesize
from magnet.testing import random_scene, tiny_denoiser
from magnet.viewer.server import start
from tests.viewer.browser import Panel

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


@pytest.fixture(scope="session")
def body() -> Body:
    return load_body("open")


@pytest.fixture
def duet(generator: torch.Generator) -> Scene:
    """One scene of two people, 24 frames."""
    return random_scene(1, 24, 2, generator)


@pytest.fixture
def server() -> Iterator[Any]:
    """viser's, on any port."""
    pytest.importorskip("viser")
    server = start("127.0.0.1", 0, "test")
    yield server
    server.stop()


@pytest.fixture
def app(body: Body, handshake: Scene) -> Iterator[Any]:
    """The live viewer of a small model, that goes on from 64 frames of two people; nobody looks."""
    pytest.importorskip("viser")
    from magnet.viewer.live_app import LiveApp

    model = tiny_denoiser(max_agents=2, window=16)
    live = Live(model, start=handshake.slice(0, 64), generator=torch.Generator().manual_seed(1))
    live.settings.steps = 2
    app = LiveApp(live, body, port=0)
    yield app
    app.stop()


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """Debian's Chromium, driven by Playwright, with a profile of its own."""
    api = pytest.importorskip("playwright.sync_api", reason=f"needs playwright: {installing('browser')}")
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
    page.set_default_timeout(300_000)
    page.on("pageerror", lambda error: errors.append(str(error)))
    yield page
    page.close()
    assert not errors


@pytest.fixture
def panel(page: Any) -> Panel:
    return Panel(page)


@pytest.fixture(scope="session")
def handshake(body: Body) -> Scene:
    """Two people who meet and shake hands, 128 frames."""
    return synthesize("handshake", 2, 128, torch.Generator().manual_seed(3), body).scene
