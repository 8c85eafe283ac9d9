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
