"""The live app beside a model that begins anew in another thread."""

from __future__ import annotations

import asyncio
import re
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest

from magnet.body import Body
from magnet.generation.live import Live
from magnet.tasks import registry
from magnet.testing import tiny_denoiser
from magnet.viewer.server import literal


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


@pytest.fixture
def controls(app: Any) -> dict[str, Any]:
    """Those of the page, by their labels."""
    return {each.label: each for each in app.server.gui._gui_input_handle_from_uuid.values() if hasattr(each, "label")}


@pytest.mark.parametrize(
    ("label", "value", "said"),
    [
        ("task", "juggling", "task: got 'juggling', expected "),
        ("task", ["joint_future"], "task: got ['joint_future'], expected "),
        ("whom", {"a": 1}, "whom: got {'a': 1}, expected nobody, person 1, "),
        ("step", "far", "step: got 'far', expected |<, "),
        ("people", None, "people: got None, expected "),
        ("example", 7, "example: got 7, expected from nothing"),
        ("weight", "much", "weight: got 'much', expected a number"),
        ("weight", float("nan"), "weight: got nan, expected a number"),
        ("at frame", [1] * 100, "at frame: got [1, 1, "),
        ("loop", "yes", "loop: got 'yes', expected on or off"),
    ],
)
def test_what_no_page_sends_is_refused_and_changes_nothing(
    label: str, value: object, said: str, app: Any, controls: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    from viser._messages import GuiUpdateMessage

    told: list[str] = []
    client = SimpleNamespace(add_notification=lambda title, text, **_: told.append(f"{title}: {text}"))
    monkeypatch.setattr(app.server, "get_clients", lambda: {7: client})
    before = controls[label].value
    message = GuiUpdateMessage(controls[label]._impl.uuid, {"value": value})
    asyncio.run(app.server._websock_server._handle_incoming_message(7, message))
    assert len(told) == 1 and told[0].startswith(f"Not set: {said}") and controls[label].value == before


@pytest.mark.parametrize("updates", [3, {"update_cb": []}, {"value": 2, "disabled": True}, {}])
def test_nothing_of_a_control_but_its_value_is_set(
    updates: Any, app: Any, controls: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """viser would put whatever it holds of a control in the page's words, what it calls among them."""
    from viser._messages import GuiUpdateMessage

    told: list[str] = []
    client = SimpleNamespace(add_notification=lambda title, text, **_: told.append(text))
    monkeypatch.setattr(app.server, "get_clients", lambda: {7: client})
    control = controls["weight"]
    before = control.value, control.disabled, control._impl.update_cb
    message = GuiUpdateMessage(control._impl.uuid, updates)
    asyncio.run(app.server._websock_server._handle_incoming_message(7, message))
    assert told == ["weight: only its value can be set"]
    assert (control.value, control.disabled, control._impl.update_cb) == before


def test_what_a_page_sends_is_taken(app: Any, controls: dict[str, Any]) -> None:
    from viser._messages import GuiUpdateMessage

    for label, value in (("task", "inbetweening"), ("weight", 2), ("loop", True), ("step", "+10")):
        message = GuiUpdateMessage(controls[label]._impl.uuid, {"value": value})
        asyncio.run(app.server._websock_server._handle_incoming_message(7, message))
        assert controls[label].value == value


def test_the_page_says_why_a_scene_does_not_begin(app: Any, controls: dict[str, Any], tmp_path: Path) -> None:
    app.worker.stop()
    app.examples["gone"] = tmp_path / "gone.npz"
    (tmp_path / "gone.npz").write_bytes(b"words")
    controls["example"].options = (*controls["example"].options, "gone")
    controls["example"]._impl.value = "gone"
    before = app.live.version
    for pressed in controls["Start anew"]._impl.update_cb:
        pressed(SimpleNamespace(client_id=7))
    assert "gone.npz: not a scene file" in app.caption(0) and app.live.version == before
    assert not controls["Start anew"].disabled
    (tmp_path / "gone.npz").unlink()
    for pressed in controls["Start anew"]._impl.update_cb:
        pressed(SimpleNamespace(client_id=7))
    assert "FileNotFoundError: " in app.caption(0)


def test_who_opens_it_reads_what_the_task_does_and_that_nothing_is_made_yet(app: Any) -> None:
    from magnet.viewer.live_app import described

    app.worker.stop()
    assert "the model has generated nothing yet" in app.caption(0)
    app.live.advance()
    assert re.search(r"(?m)^generates \d+ frames/s, [\d.]+x real time", app.caption(0))
    for task in map(registry.get, registry.names()):
        sentence, formula = described(task).split("  \n")
        assert sentence.startswith(literal(task.__doc__.split()[0])) and formula == f"`{task.formula}`"

    @dataclass(frozen=True)
    class Bare:
        formula: ClassVar[str] = "P(A)"
        target: int = 0

    assert described(Bare) == "`P(A)`"


def test_who_pauses_sees_how_far_the_model_has_come_and_waits_for_nothing(app: Any) -> None:
    app.worker.stop()
    last = app.live.scene.frames - 1
    app.clock.seek(last)
    app.draw()
    app.worker.paused = False
    assert "waiting for the model" in app.caption(last)
    app.clock.play(False)
    assert "waiting for the model" not in app.caption(last)
    app.live.advance()
    app.before_draw()
    app.draw()
    frames = app.live.scene.frames
    assert frames > last + 1 and f"of {frames / 30:.1f} s" in app.clock_text.content


def test_of_a_scene_that_grows_only_what_is_new_is_looked_through(app: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else each chunk would hold up the picture for longer the longer it plays."""
    from magnet.viewer import live_app

    take, asked = live_app.take, []
    monkeypatch.setattr(live_app, "take", lambda *args, **more: (asked.append(more), take(*args, **more))[1])
    app.worker.stop()
    before = app.live.scene.frames
    app.before_draw()
    app.live.advance()
    app.before_draw()
    assert asked[-1] == {"looked_at": before} and app.views[0].take.frames == app.live.scene.frames > before
