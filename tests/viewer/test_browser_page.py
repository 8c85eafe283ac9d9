"""The page of its own in a real headless Chromium; screenshots are kept in runs/viewer."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from magnet.body.contact import deepest
from magnet.body.joints import TOES
from magnet.export.page.html import save_html
from magnet.export.page.light import light
from magnet.synthesis.generate import synthesize
from magnet.testing import random_scene
from tests.viewer.browser import blue, orange, pale_orange, shot, upright

pytestmark = [pytest.mark.browser, pytest.mark.slow]

COUNTED = """
window.calls = 0;
for (const name of ["drawArrays", "drawElements", "drawArraysInstanced", "drawElementsInstanced"]) {
  const draw = WebGL2RenderingContext.prototype[name];
  WebGL2RenderingContext.prototype[name] = function (...given) {
    window.calls++;
    return draw.apply(this, given);
  };
}
"""
CAUGHT = """
const link = WebGL2RenderingContext.prototype.linkProgram;
WebGL2RenderingContext.prototype.linkProgram = function (program) {
  this.transformFeedbackVaryings(program, ["at"], this.SEPARATE_ATTRIBS);
  link.call(this, program);
};
"""
"""Where the vertex shader puts vertices can be read back."""
VERTICES = """([style, frame]) => {
  const { picture, motion, view } = player;
  const { gl } = picture;
  view.style = style;
  player.seek(frame);
  picture.draw(motion, frame, view);
  const { vertexArray, vertices } = picture.mesh(style);
  const people = view.shown.length;
  const places = new Float32Array(3 * vertices * people);
  gl.useProgram(picture.people.program);
  gl.bindVertexArray(vertexArray);
  gl.bindTransformFeedback(gl.TRANSFORM_FEEDBACK, gl.createTransformFeedback());
  gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, gl.createBuffer());
  gl.bufferData(gl.TRANSFORM_FEEDBACK_BUFFER, places.byteLength, gl.DYNAMIC_READ);
  gl.beginTransformFeedback(gl.POINTS);
  gl.drawArraysInstanced(gl.POINTS, 0, vertices, people);
  gl.endTransformFeedback();
  gl.getBufferSubData(gl.TRANSFORM_FEEDBACK_BUFFER, 0, places);
  gl.bindTransformFeedback(gl.TRANSFORM_FEEDBACK, null);
  return Array.from(places);
}"""


def test_the_page_plays_scrubs_and_changes_its_look_without_any_network(page, handshake, body, tmp_path) -> None:
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    path = save_html(handshake, tmp_path / "a.html", body, context=32, truth=handshake.slice(0, 60), title="Two people")
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
    page.wait_for_function("document.getElementById('state').textContent === 'generated'")
    page.wait_for_function("!player.awake")
    meeting = shot(page, "page_body")
    canvas = slice(40, 380)
    assert blue(meeting)[canvas].sum() > 600
    assert orange(meeting)[canvas].sum() > 600
    assert upright(orange(meeting)[canvas])

    for style in ("capsules", "skeleton"):
        page.select_option("#style", style)
        page.wait_for_function("!player.awake")
        assert orange(shot(page, f"page_{style}"))[canvas].sum() > 150
    page.locator("#time").fill("3")
    page.wait_for_function("document.getElementById('state').textContent === 'given'")
    page.keyboard.press("ArrowRight")
    assert page.evaluate("player.frame") == 4
    page.wait_for_function("document.getElementById('time').value === '4'")
    page.click("#play")
    page.wait_for_function("player.frame > 4")
    page.click("#play")  # which has the keys now
    stopped = page.evaluate("player.frame")
    page.keyboard.press("ArrowRight")
    assert page.evaluate("[player.frame, player.playing]") == [stopped + 1, False]


def test_who_comes_back_to_the_page_finds_controls_that_say_how_it_plays(page, handshake, body, tmp_path) -> None:
    page.goto(save_html(handshake, tmp_path / "a.html", body, styles=("skeleton",)).as_uri())
    page.wait_for_function("window.player && player.drawn > 0")
    page.select_option("#speed", "0.25")
    page.click("#loop")
    page.goto("about:blank")
    page.go_back()
    page.wait_for_function("window.player && player.drawn > 0")
    player = page.evaluate("[player.speed, player.loop]")
    assert (
        page.evaluate("[Number(document.getElementById('speed').value), document.getElementById('loop').checked]")
        == player
    )


def test_the_page_draws_what_the_body_says(page, handshake, body, tmp_path) -> None:
    path = save_html(handshake, tmp_path / "a.html", body)
    page.goto(path.as_uri())
    page.wait_for_function("window.player && player.drawn > 0")
    places = page.evaluate("(player.motion.pose(1, 40), Array.from(player.motion.places))")
    truth = body.joints(handshake)[0, 40, 1].numpy()
    np.testing.assert_allclose(np.reshape(places, (22, 3)), truth, atol=1e-3)


@pytest.mark.parametrize("style", ["body", "light"])
def test_each_vertex_of_a_crowd_is_drawn_where_the_body_has_it(page, body, tmp_path, style) -> None:
    crowd = random_scene(1, 6, 12, torch.Generator().manual_seed(3))  # twelve shapes
    page.add_init_script(CAUGHT)
    page.goto(save_html(crowd, tmp_path / "a.html", body, styles=(style,)).as_uri())
    page.wait_for_function("window.player && player.drawn > 0")
    truth = body.vertices(crowd)[0].numpy()
    truth = truth if style == "body" else truth[:, :, light(body).keep]
    for frame in (0, 5):
        places = np.reshape(page.evaluate(VERTICES, [style, frame]), truth[frame].shape)
        np.testing.assert_allclose(places, truth[frame], atol=1e-3)


def test_any_number_of_people_are_drawn_in_three_calls_each_ghost_in_two_and_marks_in_one(page, body, tmp_path) -> None:
    page.add_init_script(COUNTED)
    for people, ghosts in ((2, 0), (40, 0), (3, 2)):
        crowd = random_scene(1, 6, people, torch.Generator().manual_seed(3))
        truth = random_scene(1, 6, ghosts, torch.Generator().manual_seed(4)) if ghosts else None
        page.goto(save_html(crowd, tmp_path / "a.html", body, truth=truth, styles=("light", "skeleton")).as_uri())
        page.wait_for_function("window.player && player.drawn > 0")
        marked = page.evaluate("player.picture.marks.at(2, -1).length") > 0
        for style, marks in (("light", "false"), ("skeleton", "false"), ("light", "true")):
            look = f"view.style = '{style}'; view.marks = {marks};"
            draw = f"{look} calls = 0; picture.draw(player.motion, 2.5, view); return calls;"
            expected = 3 + 2 * ghosts + (marked and marks == "true")
            assert page.evaluate(f"(() => {{ const {{ picture, view }} = player; {draw} }})()") == expected


def test_the_page_shows_takes_side_by_side_and_each_alone(page, handshake, body, tmp_path) -> None:
    three = handshake.repeat(3).replace(names=())
    path = save_html(three, tmp_path / "a.html", body, context=32, styles=("skeleton",), title="Three")
    page.goto(path.as_uri())
    page.wait_for_function("window.player && player.drawn > 2")
    page.locator("#time").fill("60")
    labels = page.locator("#labels div")
    page.wait_for_function("document.getElementById('labels').innerText.includes('Three · 3: generated')")
    all_places = [labels.nth(k).bounding_box()["x"] for k in range(3)]
    assert all_places == sorted(all_places) and all_places[2] - all_places[0] > 200
    shot(page, "page_three")
    page.select_option("#take", "Three · 2")
    page.wait_for_function("!player.awake")
    assert [labels.nth(k).is_visible() for k in range(3)] == [False] * 3
    assert page.locator("#state").inner_text() == "generated"
    alone = shot(page, "page_one_of_three")[40:380]
    columns = (blue(alone) | orange(alone)).any(axis=0).nonzero()[0]
    assert 0 < np.ptp(columns) < 400


def test_the_page_marks_a_given_partner_and_keyframes(page, handshake, body, tmp_path) -> None:
    given = torch.zeros(1, handshake.frames, 2, dtype=torch.bool)
    given[:, :, 1] = True
    given[:, 40:44, 0] = True
    path = save_html(handshake.replace(given=given), tmp_path / "a.html", body, title="An answer")
    page.goto(path.as_uri())
    page.wait_for_function("window.player && player.drawn > 2")
    for frame, said in ((30, "given: person 2"), (41, "given")):
        page.locator("#time").fill(str(frame))
        page.wait_for_function(f"document.getElementById('state').textContent === '{said}'")
    assert page.evaluate("document.getElementById('time').style.height") == "8px"
    page.locator("#time").fill("30")
    page.wait_for_function("!player.awake")
    image = shot(page, "page_given_partner")[40:380]
    assert blue(image).sum() > 300 and pale_orange(image).sum() > 300
    assert orange(image, least=130).sum() < pale_orange(image).sum() / 10


def reddish(image: np.ndarray) -> np.ndarray:
    """Pixels of marks of people who are 10 cm and more in each other."""
    red, green, blue = np.moveaxis(image, -1, 0)
    return (red > 150) & (green < 80) & (blue < 100)


def test_the_page_marks_how_deep_people_are_in_each_other_until_marks_are_off(page, handshake, body, tmp_path) -> None:
    near = handshake.T_world_root.clone()
    near[:, 40:, 1, :3, 3] = near[:, 40:, 0, :3, 3] + torch.tensor([0.05, 0.0, 0.05])
    path = save_html(handshake.replace(T_world_root=near), tmp_path / "a.html", body, title="Too near")
    page.goto(path.as_uri())
    page.wait_for_function("window.player && player.drawn > 2")
    joints = body.joints(handshake.replace(T_world_root=near))[0, 60]
    depth = round(100 * deepest(joints[:1], joints[1:])[0, 0].item())
    assert depth >= 10

    def looked_at(name: str, said: str) -> np.ndarray:
        page.locator("#time").fill("60")
        page.wait_for_function(f"document.getElementById('state').textContent === '{said}'")
        page.wait_for_function("!player.awake")
        return shot(page, name)

    before = looked_at("page_marks", f"{depth} cm in each other")
    assert reddish(before)[40:380].sum() > 100
    rows = reddish(before)[400:].sum(axis=1)  # of the timeline, red from frame 40 of 128 on
    assert (rows > 0.6 * 88 / 128 * 772).sum() >= 4
    page.locator("#marks").click()
    after = looked_at("page_marks_off", "")
    assert reddish(after)[40:380].sum() < 10 and reddish(after)[400:].sum(axis=1).max() < 40


def test_what_marks_mean_is_written_in_the_picture_while_they_are_on(page, handshake, body, tmp_path) -> None:
    near = handshake.T_world_root.clone()
    near[:, 40:, 1, :3, 3] = near[:, 40:, 0, :3, 3] + torch.tensor([0.05, 0.0, 0.05])
    deep = handshake.replace(T_world_root=near)
    for scene, said in ((handshake, False), (deep, True)):
        page.goto(save_html(scene, tmp_path / "a.html", body, styles=("skeleton",)).as_uri())
        page.wait_for_function("window.player && player.drawn > 0")
        words = page.locator("#legend").inner_text()
        assert ("in each other, 5 to 10 cm and more" in words) == said and "hands touch" in words
    page.locator("#marks").click()
    assert not page.locator("#legend").is_visible()


def test_keys_turn_and_zoom_and_those_of_the_browser_are_left_to_it(page, handshake, body, tmp_path) -> None:
    page.goto(save_html(handshake, tmp_path / "a.html", body, styles=("skeleton",)).as_uri())
    page.wait_for_function("window.player && player.drawn > 0")
    page.evaluate("player.seek(60)")
    looks = "[player.view.distance, player.view.azimuth, player.view.elevation]"
    far, around, above = page.evaluate(looks)
    for key in ("+", "Shift+ArrowRight", "Shift+ArrowUp"):
        page.keyboard.press(key)
    nearer, turned, higher = page.evaluate(looks)
    assert nearer < far and turned != around and higher > above
    page.evaluate("addEventListener('keydown', (event) => (window.taken = event.defaultPrevented))")
    for key, taken in (("Alt+ArrowRight", False), ("Control+ArrowRight", False), ("ArrowRight", True)):
        page.keyboard.press(key)
        assert page.evaluate("taken") == taken
    assert page.evaluate("player.frame") == 61
    page.wait_for_function("document.getElementById('time').ariaValueText === '2.03 s of 4.3 s'")


def test_on_paper_people_keep_their_shape_and_without_scripts_the_page_says_what_it_needs(
    page, chromium, handshake, body, tmp_path
) -> None:
    path = save_html(handshake, tmp_path / "a.html", body, styles=("skeleton",)).as_uri()
    page.goto(path)
    page.emulate_media(media="print")
    assert page.evaluate("getComputedStyle(document.getElementById('canvas')).objectFit") == "contain"
    assert not page.locator("#play").is_visible() and page.locator("#time").is_visible()
    bare = chromium.new_page(java_script_enabled=False)
    bare.goto(path)
    assert bare.locator("noscript").is_visible()
    bare.close()


def test_feet_of_a_circle_of_people_are_in_the_picture(page, body, tmp_path) -> None:
    circle = synthesize("circle", 8, 120, torch.Generator().manual_seed(1), body).scene
    page.goto(save_html(circle, tmp_path / "a.html", body, styles=("skeleton",)).as_uri())
    page.wait_for_function("window.player && player.drawn > 0")
    toes = body.joints(circle)[0, 0, :, list(TOES)].flatten(0, 1).tolist()
    page.evaluate("player.seek(0)")
    page.evaluate("player.advance(0)")
    lowest = page.evaluate("(toes) => Math.max(...toes.map((toe) => player.picture.onPage(toe)[1]))", toes)
    assert lowest < page.evaluate("player.picture.canvas.clientHeight")


def test_everybody_is_in_the_picture_of_a_phone_held_upright_or_turned(page, handshake, body, tmp_path) -> None:
    three = handshake.repeat(3).replace(names=())
    page.set_viewport_size({"width": 390, "height": 700})
    page.goto(save_html(three, tmp_path / "a.html", body, styles=("skeleton",)).as_uri())
    for width, height in ((390, 700), (700, 390), (390, 700)):
        page.set_viewport_size({"width": width, "height": height})
        page.wait_for_function(f"window.player && player.drawn > 0 && player.picture.canvas.width === {width}")
        places = page.evaluate(
            "player.view.shown.map(({ index }) => player.picture.onPage(player.motion.root(index, 0)))"
        )
        x, y = np.transpose(places)
        assert x.min() > 0 and x.max() < width and np.ptp(x) > 0.4 * width
        assert y.min() > 0 and y.max() < height


@pytest.mark.parametrize("camera", ["front", "side", "above"])
def test_labels_of_takes_stay_on_the_page(page, handshake, body, tmp_path, camera) -> None:
    path = save_html(handshake.repeat(2).replace(names=()), tmp_path / "a.html", body, styles=("skeleton",), title="A")
    page.goto(path.as_uri())
    page.wait_for_function("window.player && player.drawn > 2")
    page.select_option("#from", camera)
    page.evaluate("(player.view.zoom(0.4), player.seek(player.frame))")  # so near that heads are beyond the edge
    page.wait_for_function("!player.awake")
    for k in range(2):
        label = page.locator("#labels div").nth(k)
        if label.is_visible():
            box = label.bounding_box()
            assert box["x"] >= -1 and box["y"] >= 0 and box["x"] + box["width"] <= 801
    assert page.locator("#labels div").nth(0).is_visible() or page.locator("#labels div").nth(1).is_visible()
