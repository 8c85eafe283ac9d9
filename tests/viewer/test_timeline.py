"""The tracks along the bottom: what is given, what is generated, keyframes and now, each where it belongs."""

from __future__ import annotations

import re
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
import torch

from magnet.export.page.palette import pale
from magnet.export.page.takes import take
from magnet.testing import random_scene
from magnet.viewer.scene_view import RenderOptions
from magnet.viewer.timeline import EDGE, NOW, Tracks, drawn

COLOURS = np.array([[10, 20, 30], [200, 100, 50]], dtype=np.uint8)


def bars(svg: str, colour: str) -> list[float]:
    """Left and right edges in per cent of the rectangles of a colour, one after the other."""
    found = ElementTree.fromstring(svg).iter("rect")
    return [
        edge
        for r in found
        if r.get("fill") == colour
        for edge in (float(r.get("x")[:-1]), float(r.get("x")[:-1]) + float(r.get("width")[:-1]))
    ]


def named(colour: np.ndarray) -> str:
    return "#" + bytes(colour.tolist()).hex()


def test_each_person_has_a_track_of_given_and_generated_frames_and_keyframes() -> None:
    known = np.zeros((100, 2), dtype=bool)
    known[:25] = True
    known[40:50, 1] = True
    svg = drawn(Tracks(known, COLOURS, keys=((1, 196),)), now=150, fps=30.0)  # a keyframe later than all there is
    faint = pale(COLOURS)
    assert bars(svg, named(faint[0])) == pytest.approx([0, 12.5])
    assert bars(svg, named(COLOURS[0])) == pytest.approx([12.5, 50])
    assert bars(svg, named(faint[1])) == pytest.approx([0, 12.5, 20, 25])
    assert bars(svg, named(COLOURS[1])) == pytest.approx([12.5, 20, 25, 50])
    assert bars(svg, NOW)[0] == 75.0
    assert re.findall(r'<svg x="([\d.]+)%"', svg) == ["99.00"]


@pytest.mark.parametrize(("people", "said"), [(8, []), (9, ["of the first 8 of 9 people"])])
def test_people_without_a_track_are_told(people: int, said: list[str], body) -> None:
    pytest.importorskip("viser")
    from magnet.viewer.watch import Viewer

    viewer = Viewer([take("crowd", random_scene(1, 6, people, torch.Generator().manual_seed(1)))], body, port=0)
    try:
        tracks = viewer.tracks()
    finally:
        viewer.stop()
    assert tracks.known.shape == (6, 8) and len(tracks.colours) == 8
    texts = [text.text for text in ElementTree.fromstring(drawn(tracks, now=0, fps=30.0)).iter("text")]
    assert [text for text in texts if "people" in text] == said


def test_the_timeline_is_as_wide_as_the_picture_and_nothing_happens_while_nobody_looks(body) -> None:
    pytest.importorskip("viser")
    from magnet.viewer.watch import Viewer

    viewer = Viewer([take("dance", random_scene(1, 24, 2, torch.Generator().manual_seed(1)))], body, port=0)
    try:
        sent = viewer.sent
        viewer.run(seconds=0.2)
        assert viewer.clock.at == 0.0 and viewer.sent == sent
        viewer.timeline.fit(1000)
        viewer.timeline.fit(0)
        assert viewer.timeline.width == 1000
    finally:
        viewer.stop()
    assert EDGE > 0


def test_who_pauses_sees_the_line_of_now_at_the_frame_that_is_shown(body) -> None:
    pytest.importorskip("viser")
    from magnet.viewer.watch import Viewer

    viewer = Viewer([take("dance", random_scene(1, 25, 2, torch.Generator().manual_seed(1)))], body, port=0)
    try:
        for frame in (3, 4, 5):
            viewer.clock.seek(frame)
            viewer.draw()
        viewer.clock.play(False)
        viewer.draw()
        assert bars(viewer.timeline.picture.content, NOW)[0] == pytest.approx(100 * 5 / 25)
    finally:
        viewer.stop()


def test_a_take_that_ends_before_the_others_is_not_given_again(body) -> None:
    pytest.importorskip("viser")
    from magnet.viewer.watch import Viewer

    generator = torch.Generator().manual_seed(1)
    takes = [take(f"{frames}", random_scene(1, frames, 1, generator), context=8) for frames in (24, 60)]
    viewer = Viewer(takes, body, port=0)
    try:
        known = viewer.tracks().known
        viewer.render = RenderOptions(contacts=False)
        captions = [viewer.caption(frame).split("  \n") for frame in (7, 8, 24)]
    finally:
        viewer.stop()
    assert known[:8].all() and not known[8:].any()
    assert [lines[1:] for lines in captions] == [["24: given", "60: given"], [], ["24: ended"]]


def test_takes_whose_names_differ_in_signs_alone_stand_side_by_side(body) -> None:
    pytest.importorskip("viser")
    from magnet.viewer.watch import Viewer

    scene = random_scene(1, 24, 1, torch.Generator().manual_seed(1))
    viewer = Viewer([take(label, scene) for label in ("a-b", "a_b")], body, port=0)
    try:
        viewer.clock.seek(5)
        viewer.draw()
        assert len({view.name for view in viewer.views}) == 2
    finally:
        viewer.stop()


def shares_of_height(camera, points):
    """Where points are in a camera's picture, from its upper edge (0) to its lower one (1). -> (M,)"""
    ahead = camera.look_at - camera.position
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 1.0, 0.0])
    up = np.cross(right / np.linalg.norm(right), ahead)
    away = points - camera.position
    return 0.5 - 0.5 * (away @ up) / (away @ ahead) / np.tan(camera.fov / 2)


def test_the_camera_goes_as_far_away_as_everybody_needs_and_no_further(body, monkeypatch) -> None:
    pytest.importorskip("viser")
    from magnet.viewer.watch import Viewer

    scene = random_scene(1, 24, 2, torch.Generator().manual_seed(1))
    roots = scene.T_world_root.clone()
    roots[:, :, :, :3, 3] = torch.tensor([[0.0, 0.9, 0.0], [0.0, 0.9, 0.0]])
    roots[:, 12:, 0, 0, 3], roots[:, 12:, 1, 0, 3] = -3.0, 3.0
    viewer = Viewer([take("dance", scene.replace(T_world_root=roots))], body, port=0)

    class Client:
        client_id = 0

        def __init__(self) -> None:
            self.camera = SimpleNamespace(
                position=np.array([0.0, -0.2, -4.0]), look_at=np.zeros(3), fov=0.7, aspect=1.5, image_height=500
            )

        def atomic(self):
            return viewer.server.atomic()

    client = Client()
    monkeypatch.setattr(viewer.server, "get_clients", lambda: {0: client})
    try:
        viewer.clock.seek(1)
        viewer.draw()
        before = client.camera.position
        client.camera.position, client.camera.look_at = np.array([0.0, 0.85, 4.0]), np.array([0.0, 0.85, 0.0])
        viewer.clock.seek(2)
        viewer.draw()
        near = np.linalg.norm(client.camera.position - np.array([0.0, 0.85, 0.0]))
        viewer.clock.seek(20)
        viewer.draw()
        far = client.camera.position - np.array([0.0, 0.85, 0.0])
        low = shares_of_height(client.camera, np.array([[-3.0, 0.0, 0.0], [3.0, 0.0, 0.0]]))
        covered = viewer.timeline.height / 500
    finally:
        viewer.stop()
    assert before[1] == -0.2  # a browser that has not been told where to stand is left alone
    assert near == pytest.approx(4.0, rel=0.2)
    assert (low < 1 - covered).all()  # feet are above the timeline
    assert np.linalg.norm(far) * np.sin(0.35) >= 3.0
    assert np.allclose(far / np.linalg.norm(far), [0, 0, 1])  # on the line that it looked along


@pytest.mark.parametrize(("height", "aspect", "covered"), [(667, 375 / 667, 0.4), (900, 1.5, 0.0)])
def test_people_stand_above_the_controls_of_a_phone_held_upright(body, monkeypatch, height, aspect, covered) -> None:
    pytest.importorskip("viser")
    from magnet.viewer.watch import Viewer

    scene = random_scene(1, 24, 2, torch.Generator().manual_seed(1))
    roots = scene.T_world_root.clone()
    roots[..., :3, 3] = torch.tensor([[-0.4, 0.9, 0.0], [0.4, 0.9, 0.0]])
    viewer = Viewer([take("dance", scene.replace(T_world_root=roots))], body, port=0)
    begin, middle = np.array([0.0, 0.85, 4.0]), np.array([0.0, 0.85, 0.0])
    camera = SimpleNamespace(position=begin, look_at=middle, fov=0.7, aspect=aspect, image_height=height)
    client = SimpleNamespace(client_id=0, camera=camera, atomic=viewer.server.atomic)
    try:
        viewer.clock.seek(1)
        viewer.draw()  # nobody looks yet, and the clock stands still
        monkeypatch.setattr(viewer.server, "get_clients", lambda: {0: client})
        viewer.draw()
    finally:
        viewer.stop()
    ends = shares_of_height(camera, np.array([[-0.4, 0.0, 0.3], [0.4, 1.8, 0.0]]))
    free = 1 - max(covered, viewer.timeline.height / height)
    assert 0 < ends[1] < ends[0] < free and abs(ends.mean() - free / 2) < 0.05
