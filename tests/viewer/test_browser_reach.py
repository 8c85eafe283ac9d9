"""The page in a notebook, on a phone, enlarged, and for people who see little or do not want things to move."""

from __future__ import annotations

import itertools

import pytest

from magnet.export.motion import Motion
from magnet.export.page.html import save_html

pytestmark = [pytest.mark.browser, pytest.mark.slow]

CONTRAST = """(id) => {
  const light = (colour) => {
    const parts = colour.match(/[0-9.]+/g).slice(0, 3).map((value) => value / 255);
    const [r, g, b] = parts.map((x) => (x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4));
    return 0.05 + 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const own = getComputedStyle(document.getElementById(id));
  const clear = own.backgroundColor === "rgba(0, 0, 0, 0)";
  const under = clear ? getComputedStyle(document.body).backgroundColor : own.backgroundColor;
  const [a, b] = [light(own.color), light(under)];
  return Math.max(a, b) / Math.min(a, b);
}"""
"""The contrast of a text with what it stands on, as WCAG has it."""


def test_pages_of_a_notebook_begin_in_sight_wait_out_of_it_and_begin_anew_without_their_picture(
    page, handshake, tmp_path
) -> None:
    shown = Motion.of(handshake).show(style="skeleton")._repr_html_()
    notebook = tmp_path / "notebook.html"
    notebook.write_text(f"{shown}<div style='height:3000px'></div>{shown}", encoding="utf-8")
    page.goto(notebook.as_uri())
    first, last = page.frames[1:]
    first.wait_for_function("window.player && player.drawn > 2")
    assert last.evaluate("window.player === undefined")
    page.locator("iframe").nth(1).scroll_into_view_if_needed()
    last.wait_for_function("window.player && player.drawn > 2")
    first.wait_for_function("!player.seen")
    drawn = first.evaluate("player.drawn")
    before = last.evaluate("player.drawn")
    last.wait_for_function(f"player.drawn > {before + 5}")
    assert first.evaluate("player.drawn") == drawn
    first.evaluate("player.picture.gl.getExtension('WEBGL_lose_context').loseContext()")  # as of the oldest of many
    page.locator("iframe").nth(0).scroll_into_view_if_needed()
    first.wait_for_function("window.player && player.drawn > 2 && !player.picture.gl.isContextLost()")


def test_who_asks_for_less_motion_starts_it_by_hand(page, handshake, body, tmp_path) -> None:
    page.emulate_media(reduced_motion="reduce")
    page.goto(save_html(handshake, tmp_path / "a.html", body, styles=("skeleton",)).as_uri())
    page.wait_for_function("window.player && player.drawn > 0")  # stopped, it draws no more
    assert page.evaluate("[player.playing, player.frame]") == [False, 0]
    page.keyboard.press(" ")
    page.wait_for_function("player.frame > 2")


def test_labels_of_five_takes_do_not_hide_each_other(page, handshake, body, tmp_path) -> None:
    five = handshake.repeat(5).replace(names=())
    path = save_html(five, tmp_path / "a.html", body, context=32, styles=("skeleton",), title="scene")
    page.set_viewport_size({"width": 900, "height": 520})  # of a notebook's output
    page.goto(path.as_uri())
    page.wait_for_function("window.player && player.drawn > 2")
    page.locator("#time").fill("40")
    page.wait_for_function("document.getElementById('labels').innerText.includes('scene · 5: generated')")
    boxes = [page.locator("#labels div").nth(k).bounding_box() for k in range(5)]
    for left, right in itertools.pairwise(boxes):
        assert left["x"] + left["width"] <= right["x"] + 1


def test_of_an_enlarged_page_the_people_and_every_control_can_be_come_to(page, handshake, body, tmp_path) -> None:
    page.set_viewport_size({"width": 320, "height": 180})  # 1280 x 720 at 400 %
    page.goto(save_html(handshake, tmp_path / "a.html", body, title="Two people").as_uri())
    page.wait_for_function("window.player && player.drawn > 2")
    assert page.locator("canvas").bounding_box()["height"] >= 100
    heading, time = (page.locator(name).bounding_box() for name in ("h1", "#time"))
    assert heading["y"] + heading["height"] < time["y"]
    page.locator("#from").scroll_into_view_if_needed()
    box = page.locator("#from").bounding_box()
    assert box["y"] + box["height"] <= 180 and box["x"] + box["width"] <= 320


def test_text_is_whole_dark_enough_and_the_picture_has_a_name(page, handshake, body, tmp_path) -> None:
    title = "Two people who meet and shake hands, with more words than a phone has room for in a line"
    page.set_viewport_size({"width": 390, "height": 700})
    path = save_html(handshake, tmp_path / "a.html", body, context=32, styles=("skeleton",), title=title)
    page.goto(path.as_uri())
    page.wait_for_function("window.player && document.getElementById('state').textContent")
    heading, state = (page.locator(name).bounding_box() for name in ("h1", "#state"))
    assert heading["x"] + heading["width"] <= 390 - 16
    assert state["y"] >= heading["y"] + heading["height"]
    assert page.get_by_role("img", name=title).count() == 1
    for name in ("state", "play", "back", "clock"):
        assert page.evaluate(CONTRAST, name) >= 4.5, name
