"""The live app beside a model that begins anew in another thread."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest

from magnet.body import Body
from magnet.generation.live import Live
from magnet.testing import tiny_denoiser


@pytest.fixture
def app(body: Body) -> Iterator[Any]:
    pytest.importorskip("viser")
    from magnet.viewer.live_app import LiveApp

    live = Live(tiny_denoiser(max_agents=3, window=16), people=2)
    live.settings.steps = 2
    app = LiveApp(live, body, port=0)
    yield app
    app.stop()


class Waits(dict[int, Any]):
    """Goals that are gone through only when the test says so: in the middle of `Live.begin`."""

    def __init__(self) -> None:
        super().__init__()
        self.reached, self.go = threading.Event(), threading.Event()

    def items(self) -> Any:
        self.reached.set()
        assert self.go.wait(60)
        return super().items()


def test_what_is_drawn_while_a_scene_begins_anew_is_the_old_one_or_the_new_one(app: Any) -> None:
    live, goals = app.live, Waits()
    app.worker.stop()
    live.advance()  # a scene of other length than the new one
    app.before_draw()
    live.settings.goals = goals
    failed: list[Exception] = []

    def draw() -> None:
        try:
            app.before_draw()
            app.shown = -1
            app.draw()
        except Exception as error:
            failed.append(error)

    beginning = threading.Thread(target=live.begin, args=(3,))
    beginning.start()
    assert goals.reached.wait(60)
    drawing = threading.Thread(target=draw)
    drawing.start()
    drawing.join(0.5)  # it waits for the beginning to end, or has drawn what was there
    goals.go.set()
    beginning.join()
    drawing.join()
    draw()
    assert not failed
    assert len(app.views[0].take.slots) == 3 and app.version == live.version
    assert app.clock.frames == live.scene.frames
