"""The page of its own in a real headless Chromium: dark where the system is, and at rest where nothing moves."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
import torch

from magnet.export.page.html import save_html
from magnet.export.page.palette import agent_colours, dim, pale
from tests.viewer.browser import shot

pytestmark = [pytest.mark.browser, pytest.mark.slow]

ASKED = """
window.asked = 0;
const ask = requestAnimationFrame;
window.requestAnimationFrame = (tick) => { asked++; return ask(tick); };
"""
A_WHILE = "new Promise((done) => setTimeout(() => done([player.drawn, asked]), 300))"


def ground(page: Any) -> float:
    """How light the upper left corner of the picture of people is, 0 to 255."""
    from PIL import Image

    raw = page.screenshot(clip={"x": 2, "y": 60, "width": 8, "height": 8})
    return float(np.asarray(Image.open(io.BytesIO(raw)).convert("L")).mean())


def near(image: np.ndarray, colour: np.ndarray) -> int:
    """Pixels about as red, green and blue to each other as a colour, and about as light."""
    return int((np.abs(image - colour.astype(int)).max(axis=-1) < 24).sum())


@pytest.fixture
def answered(page, handshake, body, tmp_path) -> Any:
    """A page of a given person 2, to whom person 1 was made, that stands at frame 30."""
    given = torch.zeros(1, handshake.frames, 2, dtype=torch.bool)
    given[:, :, 1] = True
    page.add_init_script(ASKED)
    path = save_html(handshake.replace(given=given), tmp_path / "a.html", body, truth=handshake.slice(0, 60))

    def opened(scheme: str) -> Any:
        page.emulate_media(color_scheme=scheme)
        page.goto(path.as_uri())
        page.wait_for_function("window.player && player.drawn > 0")
        page.locator("#time").fill("30")
        page.click("#truth")
        page.wait_for_function("!player.awake")
        return page

    return opened


def test_given_people_are_pale_on_a_light_page_and_dim_on_a_dark_one_and_the_legend_says_so(answered: Any) -> None:
    inks = {"pale": pale(agent_colours([1]))[0], "dim": dim(agent_colours([1]))[0]}
    for scheme, said, other in (("light", "pale", "dim"), ("dark", "dim", "pale")):
        page = answered(scheme)
        assert page.locator("#givens").inner_text() == f"{said}: given"
        image = shot(page, f"page_{scheme}")[60:380]
        assert near(image, inks[said]) > max(150, 3 * near(image, inks[other]))
        assert (ground(page) > 200) == (scheme == "light")
        rgb = ", ".join(str(part) for part in inks[said])
        assert f"rgb({rgb})" in page.evaluate("document.getElementById('time').style.background")


def test_a_page_is_dressed_anew_where_the_system_goes_dark_or_prints(answered: Any) -> None:
    page = answered("light")
    for media, scheme, light in ((None, "dark", False), ("print", "dark", True), ("screen", "dark", False)):
        page.emulate_media(media=media, color_scheme=scheme)
        page.wait_for_function(f"player.picture.faint === '{'pale' if light else 'dim'}'")
        assert (ground(page) > 200) == light


def test_words_on_a_dark_page_and_on_a_light_one_can_be_read(answered: Any) -> None:
    contrast = """([ink, ground]) => {
      const style = getComputedStyle(document.documentElement);
      const light = ([name]) => {
        const hex = style.getPropertyValue(name).replace("#", "").replace(/^(.)(.)(.)$/, "$1$1$2$2$3$3");
        const parts = hex.match(/../g).slice(0, 3).map((part) => parseInt(part, 16) / 255);
        const [r, g, b] = parts.map((x) => (x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4));
        return 0.2126 * r + 0.7152 * g + 0.0722 * b + 0.05;
      };
      const [a, b] = [light([ink]), light([ground])];
      return Math.max(a, b) / Math.min(a, b);
    }"""
    for scheme in ("light", "dark"):
        page = answered(scheme)
        for ink, grounds in (("--text", ("--far", "--bar", "--button")), ("--soft", ("--far",))):
            for each in grounds:
                assert page.evaluate(contrast, [ink, each]) > 4.5, (scheme, ink, each)  # WCAG's AA


def test_a_page_that_stands_still_draws_nothing_and_asks_for_no_frame_until_something_changes(answered: Any) -> None:
    page = answered("light")
    still = page.evaluate(A_WHILE)
    assert page.evaluate(A_WHILE) == still
    page.mouse.move(300, 200)
    page.wait_for_function("!player.awake")
    assert page.evaluate("player.drawn") == still[0]
    changes = {
        "frame": lambda: page.keyboard.press("ArrowRight"),
        "zoom": lambda: page.mouse.wheel(0, 100),
        "turn": lambda: page.keyboard.press("Shift+ArrowRight"),
        "checkbox": lambda: page.click("#truth"),
        "look": lambda: page.select_option("#style", "skeleton"),
        "camera": lambda: page.select_option("#from", "above"),
        "size": lambda: page.set_viewport_size({"width": 700, "height": 480}),
        "theme": lambda: page.emulate_media(color_scheme="dark"),
    }
    for what, change in changes.items():
        drawn = page.evaluate("player.drawn")
        change()
        page.wait_for_function(f"player.drawn > {drawn}")
        page.wait_for_function("!player.awake")
        assert page.evaluate(A_WHILE) == page.evaluate(A_WHILE), what
    page.click("#play")
    page.wait_for_function("player.frame > 33 && player.awake")


def test_the_clock_of_a_page_ends_after_its_last_frame_as_the_viewers_does(answered: Any) -> None:
    page = answered("light")
    ends = "(at) => (player.seek(127), player.time = at, player.playing = true, player.advance(0.01), player.frame)"
    assert page.evaluate(ends, 127.5) == 127
    assert page.evaluate(ends, 127.9) == 0
