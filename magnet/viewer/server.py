"""The viewer's web server."""

from __future__ import annotations

import asyncio
import contextlib
import http
import ipaddress
import logging
import math
import os
import re
import socket
import string
import sys
from collections.abc import AsyncIterator, Iterator
from typing import Any, cast
from urllib.parse import urlsplit

import rich

from magnet.extras import installing

AT_ONCE = "Object.defineProperty(document, 'hidden', {configurable: true, get: () => true})"
TOGETHER = f'<img src="data:," alt="" style="display:none" onerror="{AT_ONCE}">'
"""Lets viser's page (1.1) take up what it is sent at once, as it does in tabs that are out of sight.

Else it moves the bones of bodies in the picture that is about to be drawn, and colours and marks in the one after it:
where no GPU draws, bodies were ahead of their colours and marks by a tenth of a second and more.
"""
SHEET = 0.4
"""Share of the height of a phone held upright that controls take; of viser's own 0.6 people stand behind them."""
UPRIGHT = f"""<style>@media (max-width: 36em) {{
  div[style*="max-height: 60%"] {{ max-height: {100 * SHEET:.0f}% !important; width: 100% !important; }}
  div[style*="max-height: 60%"] div[style*="width: 20em"] {{ width: 100% !important; }}
}}</style>"""
"""Makes viser's (1.1) sheet of controls as wide as such a phone, and lower."""
GRACE = 0.5
"""Seconds that browsers have to say goodbye when a server stops: one whose connection is cut never does."""
TOLD = 15.0
"""Seconds that an error message stays visible."""
LONG = 60
"""Letters of a wrong value that are repeated."""


def start(host: str, port: int, title: str) -> Any:
    """Start a viser server on exactly this port; port 0 takes a free one.

    Raises:
        ImportError: viser is not installed, or starts otherwise than the versions that are known.
        OSError: the port is taken, or the host is not this machine.
    """
    viser = require_viser()
    port = free_port(host, port)
    with ungreeted(), own_pages_only(is_local(host)):
        server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
    if server.get_port() != port:
        server.stop()
        raise OSError(taken(host, port))
    server.gui.add_html(TOGETHER + UPRIGHT)
    only_values_of_pages(server)
    return server


@contextlib.contextmanager
def ungreeted() -> Iterator[None]:
    """viser's own greeting, a box of rich that notebooks show wherever stdout leads, is left out: ours says more."""
    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


def is_local(name: str | None) -> bool:
    """Whether a host is this machine and nobody else reaches it."""
    try:
        return name == "localhost" or ipaddress.ip_address(name or "").is_loopback
    except ValueError:
        return False


def is_foreign(origin: str | None, asked: str, local: bool) -> bool:
    """Whether a page of another server asks: in somebody's browser it could read and steer what is shown.

    origin: of the page, None where no browser asks. asked: the host that it asks for. local: that is to be this
    machine, for a page's own name may be made to stand for it (DNS rebinding).
    """
    try:
        if local and not is_local(urlsplit(f"//{asked}").hostname):
            return True
        return origin is not None and urlsplit(origin).netloc != asked
    except ValueError:
        return True


def has_asked(record: logging.LogRecord) -> bool:
    """Whether what is logged is more than a connection on which no page was asked for, as browsers open to be quicker.

    Of each of these websockets prints a traceback of 40 lines.
    """
    from websockets.exceptions import InvalidMessage

    return not (record.exc_info and isinstance(record.exc_info[1], InvalidMessage))


@contextlib.contextmanager
def own_pages_only(local: bool) -> Iterator[None]:
    """Servers of viser that are started within answer only their own pages, which viser does not see to, and end soon.

    Where a page sends what viser cannot read, a line says so in place of viser's traceback.

    Raises:
        ImportError: viser has started none in the way that is known.
    """
    from websockets.asyncio import server as sockets
    from websockets.protocol import State

    serve, guarded = sockets.serve, []
    log = logging.getLogger("websockets.server.magnet")
    log.addFilter(has_asked)

    @contextlib.asynccontextmanager
    async def guard(talk: Any, *where: Any, process_request: Any, **options: Any) -> AsyncIterator[Any]:
        def answer(connection: Any, request: Any) -> Any:
            if is_foreign(request.headers.get("Origin"), request.headers.get("Host", ""), local):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "this viewer answers only its own pages\n")
            return process_request(connection, request)

        async def talked(connection: Any) -> None:
            try:
                await talk(connection)
            except Exception as error:  # whatever fails at what came; websockets closes the connection then
                unread(error)

        guarded.append(True)
        asyncio.get_running_loop().set_exception_handler(failed)
        async with serve(talked, *where, process_request=answer, logger=log, **options) as server:
            try:
                yield server
            finally:
                asyncio.get_running_loop().call_later(GRACE, cut, server)

    def failed(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        if isinstance(error := context.get("exception"), Exception) and "future" in context:
            unread(error)  # of a task of viser's for a message
        else:
            loop.default_exception_handler(context)

    def cut(server: Any) -> None:
        for connection, handler in tuple(server.handlers.items()):
            if connection.state is State.CONNECTING:  # it has asked for nothing yet, as browsers do to be quicker later
                handler.cancel()
            else:
                connection.transport.abort()

    sockets.serve = guard  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        sockets.serve = serve  # type: ignore[misc]
    if not guarded:
        raise ImportError('this viser would answer pages of other servers, too: pip install "viser==1.1.1"')


def unread(error: Exception) -> None:
    """Say in one line that a browser sent what viser failed at, whatever letters that held."""
    print(f"magnet: a browser sent what the viewer cannot read: {repr(error)[:LONG]}", file=sys.stderr)


def only_values_of_pages(server: Any) -> None:
    """Let pages set controls to nothing but what these offer: viser takes what comes, and prints what then fails.

    A viser that is not built like version 1.1 is left as it is.
    """
    try:
        from viser._messages import GuiUpdateMessage

        gui = server.gui
        take, controls = gui._handle_gui_updates, gui._gui_input_handle_from_uuid
        gui._websock_interface.unregister_handler(GuiUpdateMessage, take)
    except (ImportError, AttributeError, AssertionError, KeyError, ValueError):
        return

    async def heard(client_id: int, message: Any) -> None:
        control, updates = controls.get(message.uuid), message.updates
        said = ""
        if control is not None:  # pages send values and nothing else; viser would set whatever it holds of a control
            only = isinstance(updates, dict) and set(updates) == {"value"}
            said = not_offered(control, updates["value"]) if only else f"{label_of(control)}: only its value can be set"
        if not said:
            await take(client_id, message)
        elif client := server.get_clients().get(client_id):
            client.add_notification("Not set", said, color="red", auto_close_seconds=TOLD)

    gui._websock_interface.register_handler(GuiUpdateMessage, heard)


def not_offered(control: Any, value: object) -> str:
    """What is wrong with a value that a page sends for one of its controls; empty if nothing is."""
    options, now = getattr(control, "options", None), control.value
    if options is not None:
        fits, expected = value in tuple(options), ", ".join(map(str, options))
    elif isinstance(now, bool):
        fits, expected = isinstance(value, bool), "on or off"
    elif isinstance(now, int | float):
        number = isinstance(value, int | float) and not isinstance(value, bool)
        fits, expected = number and math.isfinite(cast(float, value)), "a number"
    else:
        return ""
    return "" if fits else f"{label_of(control)}: got {repr(value)[:LONG]}, expected {expected}"


def label_of(control: Any) -> str:
    """What a control is called on the page, as far as it is."""
    return str(getattr(control, "label", "a control"))


def literal(name: str) -> str:
    """A name as Markdown that shows it sign by sign: viser's page runs the HTML in it, and names come out of files.

    >>> print(literal("<b> of *two*"))
    \\<b\\> of \\*two\\*
    """
    return re.sub(f"[{re.escape(string.punctuation)}]", r"\\\g<0>", name)


def require_viser() -> Any:
    """The module viser.

    Raises:
        ImportError: it is not installed; says how to install it.
    """
    try:
        import viser
    except ImportError as error:
        raise ImportError(f"the viewer needs viser: {installing('view')}") from error
    return viser


def free_port(host: str, port: int) -> int:
    """The port, if nobody listens there; for 0 one that is free.

    Raises:
        OSError: it is taken, or the host is not this machine.
        ValueError: no port has this number.
    """
    if not 0 <= port < 2**16:
        raise ValueError(f"--port {port}: expected 0 to {2**16 - 1}; 0 takes any that is free")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except socket.gaierror as error:
            raise OSError(f"--host {host}: no such address; use 127.0.0.1, or 0.0.0.0 for all") from error
        except OSError as error:
            raise OSError(taken(host, port)) from error
        return int(probe.getsockname()[1])


def taken(host: str, port: int) -> str:
    """Message for a port that cannot be used."""
    return f"port {port} of {host} is in use or not allowed; choose another: --port {port + 1}, or --port 0 for any"


def open_browser(url: str) -> bool:
    """Show a page in the user's browser; False if there is none, as over ssh."""
    import webbrowser

    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return False
    try:
        return webbrowser.open(url)
    except webbrowser.Error:
        return False
