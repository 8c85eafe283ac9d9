"""While it plays, everything on the stage is of one moment: bodies, their colours, and what is marked."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from magnet.export.page.takes import take
from magnet.motion.scene import Scene
from tests.viewer.browser import STAGE, blue, shot, watched

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
    found = set()
    with watched(page, [take("leaping", leaping(handshake.slice(8, 9)))], body, style="light") as viewer:
        viewer.follow = False
        viewer.clock.loop = True
        for number in range(12):
            page.wait_for_timeout(190)
            image = shot(page, f"moment_{number}")[STAGE]
            red = (image[..., 0] > 150) & (image[..., 1] < 90) & (image[..., 2] < 90)
            left = np.arange(image.shape[1]) < 200
            # Marks are some 10 pixels where the camera was far away when it was stopped, some 60 where it was near.
            apart, marked = bool((blue(image) & left).sum() > 100), bool(red.sum() > 5)
            found.add((apart, marked))
    assert found == {(True, False), (False, True)}
