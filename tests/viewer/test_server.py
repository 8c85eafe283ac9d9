"""Whom the viewer's server answers, and what it lets clients do that are no browser of its own page."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import http.client
import logging
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rich

from magnet.body import Body
from magnet.export.page.takes import take
from magnet.motion.scene import Scene
from magnet.viewer.base import has_picture
from magnet.viewer.saving import saved
from magnet.viewer.server import has_asked, is_foreign, is_local, own_pages_only, start

HERE, EVERYWHERE = True, False


@pytest.mark.parametrize(
    ("origin", "asked", "local", "foreign"),
    [
        ("http://localhost:8080", "localhost:8080", HERE, False),
        ("http://127.0.0.1:8080", "127.0.0.1:8080", HERE, False),
        ("http://[::1]:8080", "[::1]:8080", HERE, False),
        ("http://localhost:9000", "localhost:9000", HERE, False),  # through ssh -L 9000:localhost:8080
        (None, "localhost:8080", HERE, False),  # no browser, or the page itself
        ("https://evil.example", "localhost:8080", HERE, True),
        ("http://localhost:3000", "localhost:8080", HERE, True),
        ("http://localhost.evil.example:8080", "localhost:8080", HERE, True),
        ("null", "localhost:8080", HERE, True),
        ("http://evil.example:8080", "evil.example:8080", HERE, True),  # whose name stands for 127.0.0.1 by now
        (None, "evil.example:8080", HERE, True),
        (None, "", HERE, True),
        (None, "[::1", HERE, True),
        ("http://studio.local:8080", "studio.local:8080", EVERYWHERE, False),
        ("https://evil.example", "studio.local:8080", EVERYWHERE, True),
        ("http://[", "studio.local:8080", EVERYWHERE, True),
    ],
)
def test_pages_of_other_servers_are_known(origin: str | None, asked: str, local: bool, foreign: bool) -> None:
    assert is_foreign(origin, asked, local) == foreign


def test_hosts_that_nobody_else_reaches_are_known() -> None:
    assert all(map(is_local, ("localhost", "127.0.0.1", "127.1.2.3", "::1")))
    assert not any(map(is_local, ("0.0.0.0", "::", "192.168.0.2", "studio.local", "", None)))


def test_a_page_of_another_server_is_neither_told_nor_heard(server: Any) -> None:
    """A browser connects to any address that a page names, and tells which page that is."""
    viser = pytest.importorskip("viser")
    from websockets.asyncio.client import connect
    from websockets.exceptions import InvalidStatus
    from websockets.typing import Origin, Subprotocol

    port = server.get_port()

    async def told(origin: str | None) -> int:
        protocol = Subprotocol(f"viser-v{viser.__version__}")
        asked = None if origin is None else Origin(origin)
        async with connect(f"ws://127.0.0.1:{port}", subprotocols=[protocol], origin=asked, max_size=None) as socket:
            return len(await asyncio.wait_for(socket.recv(), 20))

    for origin in (None, f"http://127.0.0.1:{port}"):
        assert asyncio.run(told(origin)) > 0
    for origin in ("https://evil.example", "null"):
        with pytest.raises(InvalidStatus, match="403"):
            asyncio.run(told(origin))
    for host, status in ((f"localhost:{port}", 200), (f"evil.example:{port}", 403)):
        page = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
        page.request("GET", "/", headers={"Host": host})
        assert page.getresponse().status == status
        page.close()


ASKS = (
    "GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
    "Sec-WebSocket-Protocol: viser-v{version}\r\n\r\n"
)


@pytest.mark.parametrize("kind", ["asks for nothing", "says no goodbye", "reads nothing"])
def test_a_server_stops_soon_and_wholly_though_a_browser_no_longer_answers(
    kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Its connection was cut, its machine sleeps, or its page stands still."""
    viser = pytest.importorskip("viser")
    before = set(threading.enumerate())
    server = start("127.0.0.1", 0, "test")
    with socket.create_connection(("127.0.0.1", server.get_port()), 20) as browser:
        if kind != "asks for nothing":
            browser.sendall(ASKS.format(port=server.get_port(), version=viser.__version__).encode())
            assert browser.recv(12) == b"HTTP/1.1 101"
        if kind == "reads nothing":  # more than the network holds
            points = np.zeros((1_000_000, 3), np.float32)
            server.scene.add_point_cloud("/many", points, points.astype(np.uint8))
        time.sleep(0.5)
        begun = time.monotonic()
        server.stop()
        assert time.monotonic() - begun < 4.0
        while set(threading.enumerate()) - before and time.monotonic() - begun < 4.0:
            time.sleep(0.05)
        assert not set(threading.enumerate()) - before
    assert not caplog.records


@pytest.mark.parametrize(
    ("sent", "said"),
    [
        ("words", "AssertionError()"),
        (b"\xff\x00", "DecodeError('MessagePack data is malformed"),
        (b"\x81\xa4type\xa4Nope", "KeyError('Nope')"),
        (b"\x81\xa4type\xa4\x1b[2J", "KeyError('\\x1b[2J')"),  # what would clear a terminal
        (b"\x83\xa4type\xb0GuiUpdateMessage\xa4uuid\x80\xa7updates\x80", "TypeError(\"unhashable type: 'dict'\")"),
    ],
)
def test_what_viser_cannot_read_is_said_in_a_line_and_the_viewer_goes_on(
    sent: str | bytes, said: str, server: Any, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    viser = pytest.importorskip("viser")
    from websockets.asyncio.client import connect
    from websockets.exceptions import ConnectionClosed
    from websockets.typing import Subprotocol

    where, protocol = f"ws://127.0.0.1:{server.get_port()}", Subprotocol(f"viser-v{viser.__version__}")

    async def talk(message: str | bytes | None) -> int:
        async with connect(where, subprotocols=[protocol], max_size=None) as socket:
            first = len(await asyncio.wait_for(socket.recv(), 20))
            if message is not None:
                await socket.send(message)
                with contextlib.suppress(TimeoutError, ConnectionClosed):
                    while True:
                        await asyncio.wait_for(socket.recv(), 0.5)
            return first

    asyncio.run(talk(sent))
    assert asyncio.run(talk(None)) > 0
    gc.collect()  # asyncio tells of a task that failed once it is gone
    lines = capsys.readouterr().err.splitlines()
    assert lines and all(
        line.startswith(f"magnet: a browser sent what the viewer cannot read: {said}") for line in lines
    )
    assert not caplog.records


def test_a_connection_that_asks_for_nothing_is_not_told_of_and_what_fails_is(
    server: Any, caplog: pytest.LogCaptureFixture
) -> None:
    """Browsers and `ssh -L` open some that they do not need."""
    for said in (b"", b"nonsense\r\n\r\n"):
        with socket.create_connection(("127.0.0.1", server.get_port()), 20) as browser:
            browser.sendall(said)
            browser.shutdown(socket.SHUT_WR)
            while browser.recv(1000):
                pass
    assert not caplog.records
    failed = logging.makeLogRecord({"exc_info": (ValueError, ValueError("handler"), None)})
    assert has_asked(failed) and has_asked(logging.makeLogRecord({"msg": "server closed"}))


@pytest.mark.parametrize("notebook", [False, True])
def test_viser_greets_nobody(notebook: bool, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    pytest.importorskip("viser")
    shown: list[Any] = []
    monkeypatch.setattr("rich.jupyter.display", lambda *what: shown.append(what))
    monkeypatch.setattr(rich.get_console(), "is_jupyter", notebook)
    server = start("127.0.0.1", 0, "test")
    greeting = capsys.readouterr().out, list(shown)
    server.stop()
    assert greeting == ("", [])


def test_a_viser_that_starts_otherwise_is_refused_and_not_left_open() -> None:
    pytest.importorskip("viser")
    with pytest.raises(ImportError, match="answer pages of other servers"), own_pages_only(HERE):
        pass


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Where temporary folders are."""
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    yield tmp_path


@pytest.mark.parametrize("kind", ["npz/../../../evil.npz", "/../../../evil.csv", "usd", ""])
def test_a_format_that_there_is_not_writes_no_file(kind: str, folder: Path, duet: Scene, body: Body) -> None:
    """viser passes on any text as the choice of a list, and this one names a file."""
    with pytest.raises(ValueError, match="expected npz, bvh, glb, "):
        saved(take("dance", duet), body, kind)
    assert [each.name for each in folder.rglob("*")] == ["temporary"]


def test_a_name_out_of_a_file_is_text_on_the_page(duet: Scene, body: Body) -> None:
    """Markdown takes HTML as it is, so that a name could run a script in the page, or load what a stranger offers."""
    pytest.importorskip("viser")
    from markdown_it import MarkdownIt

    from magnet.viewer.watch import Viewer

    names = ["<iframe srcdoc='<script>1</script>'/>", "![a](http://evil.example/a.png)", "*a* _b_ `c` &lt; \\<b>"]
    viewer = Viewer([take(name, duet, context=8) for name in names], body, port=0)
    try:
        (said,) = (block.children or [] for block in MarkdownIt().parse(viewer.caption(0)) if block.children)
    finally:
        viewer.stop()
    emphasis = {"strong_open", "strong_close", "hardbreak"}  # our own
    assert {part.type for part in said} - emphasis == {"text"}
    shown = "".join(part.content for part in said)
    assert all(name in shown for name in names)


@pytest.mark.parametrize(
    ("told", "seen"),
    [
        ({}, True),
        ({"image_height": 0}, False),  # a folded frame
        ({"aspect": 0.0}, False),
        ({"fov": 0.0}, False),
        ({"fov": float("nan")}, False),
        ({"position": np.full(3, np.nan)}, False),
        ({"look_at": np.array([0.0, np.inf, 0.0])}, False),
    ],
)
def test_the_camera_of_a_browser_without_a_picture_is_left_alone(
    told: dict[str, Any], seen: bool, duet: Scene, body: Body, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else one such browser would end the viewer for all."""
    pytest.importorskip("viser")
    from magnet.viewer.watch import Viewer

    usual = {"position": np.array([0.0, 1.0, 4.0]), "look_at": np.array([0.0, 0.85, 0.0]), "fov": 0.8, "aspect": 1.5}
    camera = SimpleNamespace(**{**usual, "image_height": 600, **told})
    assert has_picture(camera) == seen
    viewer = Viewer([take("dance", duet)], body, port=0)
    client = SimpleNamespace(client_id=7, camera=camera, atomic=viewer.server.atomic)
    monkeypatch.setattr(viewer.server, "get_clients", lambda: {7: client})
    try:
        viewer.clock.seek(10)
        viewer.draw()
    finally:
        viewer.stop()
    assert viewer.shown == 10 and (7 in viewer.placed) == seen
