"""What the server tells the browser: of a frame the poses of whoever is seen, and nothing that grows with the scene."""

from __future__ import annotations

import contextlib
from collections import Counter
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from magnet.body import Body
from magnet.export.drawing import STYLES, Style
from magnet.export.limbs import CAPSULES, STICKS
from magnet.export.page.takes import take
from magnet.motion.scene import BODY_JOINTS
from magnet.testing import random_scene
from magnet.viewer.scene_view import RenderOptions

MOST_BESIDES = 10
"""Messages of a frame that are not poses: slider, caption, label, the floor's place, discs."""


def told(body: Body, people: int, frames: int, style: Style, rich: bool = False) -> tuple[Counter[str], int]:
    """Messages by kind, and bytes before they are compressed, for one frame of a viewer that plays."""
    msgspec = pytest.importorskip("msgspec")
    pytest.importorskip("viser")
    from magnet.viewer.watch import Viewer

    scene = random_scene(1, frames, people, torch.Generator().manual_seed(1))
    render = RenderOptions(style=style, trails=rich, contacts=rich, collisions=rich, shadows=False)
    viewer = Viewer([take("crowd", scene)], body, port=0, render=render)
    heard = []
    try:
        viewer.clock.seek(10)
        viewer.draw()
        viewer.server._websock_server.queue_message = heard.append
        viewer.clock.seek(11)
        viewer.draw()
    finally:
        viewer.stop()
    arrays: list[memoryview] = []
    words = msgspec.msgpack.encode([message.as_serializable_dict(arrays) for message in heard])
    return Counter(type(message).__name__ for message in heard), len(words) + sum(array.nbytes for array in arrays)


@pytest.mark.parametrize("style", STYLES)
def test_a_frame_costs_two_messages_a_bone_or_two_a_limb_of_everybody(style: Style, body: Body) -> None:
    few, _ = told(body, 2, 24, style)
    many, size = told(body, 16, 24, style)
    if style in ("body", "light"):
        poses = {name: many[name] for name in ("SetBoneOrientationMessage", "SetBonePositionMessage")}
        assert set(poses.values()) == {16 * BODY_JOINTS}
        assert size < 110_000
    else:
        assert many == few  # a batch holds everybody
        poses = {"SceneNodeUpdateMessage": 2 * len(CAPSULES if style == "capsules" else STICKS)}
        assert size < 30_000
    assert sum(many.values()) - sum(poses.values()) <= MOST_BESIDES


def test_a_frame_of_a_long_scene_costs_what_one_of_a_short_scene_costs(body: Body) -> None:
    short, long = told(body, 2, 24, "skeleton", rich=True), told(body, 2, 2400, "skeleton", rich=True)
    assert long[0] == short[0] and long[1] < short[1] + 100


def test_who_has_moved_the_slider_is_told_the_frame_once_more(body: Body) -> None:
    pytest.importorskip("viser")
    from magnet.viewer.watch import Viewer

    viewer = Viewer([take("dance", random_scene(1, 24, 2, torch.Generator().manual_seed(1)))], body, port=0)
    heard = []
    try:
        viewer.clock.seek(10)
        viewer.draw()
        viewer.slider._impl.value = 15  # as viser has it from the browser
        viewer.server._websock_server.queue_message = heard.append
        for told_of in viewer.slider._impl.update_cb:
            told_of(SimpleNamespace(client_id=1))
        viewer.draw()
        assert not heard_of(viewer.slider, heard)
        viewer.settle(float("inf"))
        viewer.settle(float("inf"))
    finally:
        viewer.stop()
    assert heard_of(viewer.slider, heard)[-1] == 15 == viewer.shown
    assert len(heard_of(viewer.slider, heard)) == 2


def test_the_camera_follows_people_or_stays_where_it_is(body: Body) -> None:
    pytest.importorskip("viser")
    from magnet.viewer.watch import Viewer

    scene = random_scene(1, 24, 2, torch.Generator().manual_seed(1))
    viewer = Viewer([take("dance", scene)], body, port=0)
    places = []
    try:
        for follow, frame in ((True, 20), (False, 2), (True, 12)):
            viewer.follow = follow
            viewer.clock.seek(frame)
            viewer.draw()
            places.append(-torch.as_tensor(viewer.root.position)[[0, 2]].float())
    finally:
        viewer.stop()
    middle = scene.T_world_root[0, :, :, :3, 3].mean(dim=1)[:, [0, 2]]
    assert torch.equal(places[0], places[1])
    torch.testing.assert_close(places[2] - places[0], middle[12] - middle[20], atol=1e-4, rtol=0)


def test_a_camera_sent_to_a_preset_sees_everybody_while_nothing_plays(
    body: Body, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("viser")
    from magnet.viewer.watch import Viewer

    scene = random_scene(1, 24, 2, torch.Generator().manual_seed(1))
    viewer = Viewer([take("dance", scene)], body, port=0)
    camera = SimpleNamespace(position=[0.0, 1.0, 1.0], look_at=[0.0, 0.0, 0.0], fov=0.8, aspect=1.5, image_height=600)
    client = SimpleNamespace(client_id=7, camera=camera, atomic=contextlib.nullcontext)
    try:
        viewer.clock.seek(10)
        viewer.draw()
        monkeypatch.setattr(viewer.server, "get_clients", lambda: {7: client})
        viewer.placed.add(7)
        viewer.distance = 0.5  # far too near
        viewer.move_cameras("below", client)  # there is no such preset
        assert camera.position == [0.0, 1.0, 1.0]
        viewer.move_cameras("front", client)
        before = np.array(camera.position)
        viewer.shown = -1
        viewer.draw()
    finally:
        viewer.stop()
    assert np.linalg.norm(before) > 2.0
    np.testing.assert_allclose(camera.position, before, atol=1e-6)


def heard_of(slider: Any, heard: list[Any]) -> list[int]:
    """Values of a slider among messages."""
    return [message.updates["value"] for message in heard if getattr(message, "uuid", "") == slider._impl.uuid]
