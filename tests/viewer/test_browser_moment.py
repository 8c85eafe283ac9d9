"""While it plays, everything on the stage is of one moment: bodies, their colours, and what is marked."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from magnet.export.page.takes import take
from magnet.motion.scene import Scene
from tests.viewer.browser import STAGE, blue, orange, seen, shot, watched

pytestmark = [pytest.mark.browser, pytest.mark.slow]


def leaping(one: Scene, frames: int = 240) -> Scene:
    """Two people; every second pair of frames the first is given, and stands in the second: pale, with red marks."""
    there = torch.arange(frames) // 2 % 2 == 1
    scene = one.pad_frames(frames).slice(0, frames)
    T = scene.T_world_root.clone()
    T[0, :, 0, 0, 3], T[0, :, 1, 0, 3] = torch.where(there, 1.1, -1.2), 1.3
    T[..., 2, 3] = 0.0
    given = torch.stack([there, torch.zeros_like(there)], dim=-1)[None]
    return scene.replace(T_world_root=T, given=given)


def test_bodies_colours_and_marks_are_of_one_frame_while_it_plays(page, handshake, body) -> None:
    found, right = set(), {(True, False), (False, True)}
    with watched(page, [take("leaping", leaping(handshake.slice(8, 9)))], body, style="light") as viewer:
        viewer.follow = False
        viewer.clock.loop = True
        (client,) = viewer.server.get_clients().values()
        with client.atomic():  # near enough to see marks, wherever it stood when it was stopped
            client.camera.position, client.camera.look_at = np.array([2.6, 2.2, 3.4]), np.array([0.0, 0.6, 0.0])
        seen(page, "moment_near", lambda image: orange(image).sum() > 8000)
        for number in range(48):
            page.wait_for_timeout(150 + 37 * (number % 5))  # never in step with the leaps
            image = shot(page, f"moment_{number}")[STAGE]
            red = (image[..., 0] > 150) & (image[..., 1] < 90) & (image[..., 2] < 90)
            moment = (bool(blue(image[:, :200]).sum() > 1000), bool(red.sum() > 50))
            assert moment in right, f"moment_{number}.png is of two frames"
            found.add(moment)
            if number >= 11 and found == right:
                break
    assert found == right
