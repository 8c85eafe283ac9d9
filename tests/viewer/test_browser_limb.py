"""A hand of a keyframe, dragged by its arrow in a real headless Chromium."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from magnet.generation.keyframes import limb_places
from magnet.generation.live import Live
from magnet.testing import tiny_denoiser
from tests.viewer.browser import keyframe_at, played, shot, wait

pytestmark = [pytest.mark.browser, pytest.mark.slow]


def pixel(camera: Any, place: np.ndarray) -> np.ndarray:
    """Where a place (3,) in the world is in the window. -> (2,) from the left and from the top"""
    w, x, y, z = camera.wxyz
    across = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])
    ahead = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    seen = np.stack([across, np.cross(ahead, across), ahead]) @ (place - camera.position)  # right, down, forward
    half = np.array([camera.image_width, camera.image_height]) / 2
    return half + half[1] / np.tan(camera.fov / 2) * seen[:2] / seen[2]


def test_a_hand_of_a_keyframe_goes_up_with_its_arrow_and_nowhere_else(page, panel, handshake, body) -> None:
    model = tiny_denoiser(max_agents=2, window=16)
    live = Live(model, start=handshake.slice(0, 64), generator=torch.Generator().manual_seed(1))
    live.settings.steps = 2
    with played(page, live, body) as app:
        keyframe_at(page, panel, app, 40)
        panel.choose("drag its", "left hand")
        limb = app.keys.limb
        wait(lambda: limb.handle is not None)
        app.follow = False
        (client,) = app.server.get_clients().values()
        on_stage = np.array(app.root.position)

        def look() -> None:
            """From so near that the arrow is 100 pixels long and 15 wide; a drag that misses it turns the camera."""
            with client.atomic():
                client.camera.position = on_stage + limb.handle.position + np.array([0.9, 0.4, 1.2])
                client.camera.look_at = on_stage + limb.handle.position
            page.wait_for_timeout(500)

        def hand() -> torch.Tensor:
            return limb_places(live.keys[0], "left hand", body, live.scene.betas[0, 0])[0]

        went: list[torch.Tensor] = []

        def dragged() -> bool:
            """Drag its arrow up 10 cm; whether the hand went with it, and not where the arrow is not drawn yet."""
            look()
            shot(page, "limb_arrows")
            before, start = hand(), on_stage + limb.handle.position + np.array([0.0, 0.22, 0.0])
            way = [pixel(client.camera, start + np.array([0.0, 0.012 * step, 0.0])) for step in range(9)]
            page.mouse.move(*way[0])
            page.wait_for_timeout(500)
            page.mouse.down()
            for point in way:
                page.mouse.move(*point)
                page.wait_for_timeout(150)
            page.mouse.up()
            last = before
            while not torch.equal(last, hand()) or last is before:  # until all that the browser sent has come
                last = hand()
                page.wait_for_timeout(1500)
            went.append(last - before)
            return bool(went[-1].norm() > 0.02)

        wait(dragged)
        assert went[-1][1] > 0.05 and went[-1][[0, 2]].abs().max() < 0.01
