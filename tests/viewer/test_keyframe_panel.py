"""Keyframes that are added, moved in time and removed in the live app."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from magnet.generation.keyframes import LATER, keyframe


def entered(app: Any, frame: int) -> list[str]:
    """Give the chosen keyframe another time, as from a browser. -> what that browser is told"""
    told: list[str] = []
    client = SimpleNamespace(add_notification=lambda title, text, **_: told.append(text))
    app.keys.at._impl.value = frame  # as viser has it from the browser
    for heard in app.keys.at._impl.update_cb:
        heard(SimpleNamespace(client_id=1, client=client))
    return told


def test_a_keyframe_far_behind_the_end_is_refused_and_stays_where_it_is(app: Any) -> None:
    """Its timeline, and all frames up to it, would not fit into memory."""
    app.keys.add(keyframe(app.live.scene, 0, 48))
    latest = app.live.scene.frames + LATER
    assert entered(app, latest) == [] and app.live.keys[0].frame == latest == app.keys.at.value
    assert entered(app, 10**12)[0].startswith("a keyframe at frame 1000000000000: all up to the last keyframe is made")
    assert app.live.keys[0].frame == latest == app.keys.at.value


def test_of_keyframes_that_are_removed_or_replaced_nothing_is_left_in_the_scene(app: Any) -> None:
    """Nodes that are hidden only would be sent to every browser that comes."""
    scene, nodes = app.live.scene, app.server.scene._handle_from_node_name
    before = set(nodes)
    app.keys.add(keyframe(scene, 0, 48))
    each = len(nodes) - len(before)
    app.keys.add(keyframe(scene, 0, 48, pose=20))
    app.keys.add(keyframe(scene, 1, 52))
    assert each > 20 and len(nodes) == len(before) + 2 * each
    moved = app.keys.entries[0].handle._impl_aux.update_cb
    app.keys.clear()
    assert set(nodes) == before
    for heard in moved:  # a browser that still drags its arrows
        heard(None)
    assert app.live.keys == [] and set(nodes) == before
