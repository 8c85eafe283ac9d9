"""What viser is told of people."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from magnet.body import Body
from magnet.export.page.palette import agent_colours
from magnet.export.page.rig import bone_poses
from magnet.motion.scene import Scene
from magnet.viewer.people import SkinnedPeople, add_people, poser, quick_poser


def told(mesh: Any, pose: Any, turns: Any, places: Any, monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """The messages that posing a mesh queues, in full."""
    heard: list[Any] = []
    with monkeypatch.context() as patch:
        patch.setattr(mesh._impl.api._websock_interface, "queue_message", heard.append)
        pose(turns, places)
    return [(type(message).__name__, *vars(message).items()) for message in heard]


def test_the_quick_way_tells_viser_what_the_handles_tell(server, duet: Scene, body: Body, monkeypatch) -> None:
    people = add_people(server, "/a", body, duet, "light", agent_colours((0, 1)))
    assert isinstance(people, SkinnedPeople)
    turns, places = bone_poses(body, duet)
    mesh = people.meshes[0]
    quick = quick_poser(mesh)
    assert quick is not None, "viser has changed: bones are posed by its handles, which is slow"
    by_handles = told(mesh, poser(mesh), turns[3, 0], places[3, 0], monkeypatch)
    told(mesh, poser(mesh), turns[9, 0], places[9, 0], monkeypatch)  # elsewhere, or handles would say nothing
    quickly = told(mesh, quick, turns[3, 0], places[3, 0], monkeypatch)
    assert len(by_handles) == 44 and quickly == by_handles
    np.testing.assert_allclose([bone.wxyz for bone in mesh.bones], turns[3, 0], atol=1e-6)
    np.testing.assert_allclose([bone.position for bone in mesh.bones], places[3, 0], atol=1e-6)


def test_where_viser_is_built_otherwise_there_is_no_quick_way() -> None:
    pytest.importorskip("viser")

    class Mesh:
        bones = (object(),)

    assert quick_poser(Mesh()) is None
