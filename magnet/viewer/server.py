"""The viewer's web server."""

from __future__ import annotations

import contextlib
import os
import socket
import sys
from typing import Any

AT_ONCE = "Object.defineProperty(document, 'hidden', {configurable: true, get: () => true})"
TOGETHER = f'<img src="data:," alt="" style="display:none" onerror="{AT_ONCE}">'
"""Lets viser's page (1.1) take up what it is sent at once, as it does in tabs that are out of sight.

Else it moves the bones of bodies in the picture that is about to be drawn, and colours and marks in the one after it:
where no GPU draws, bodies were ahead of their colours and marks by a tenth of a second and more.
"""
NEEDS = 'the viewer needs viser: pip install "magnet-motion[view]"'


def start(host: str, port: int, title: str) -> Any:
    """Start a viser server on exactly this port; port 0 takes a free one.

    Raises:
        ImportError: viser is not installed.
        OSError: the port is taken, or the host is not this machine.
    """
    viser = require_viser()
    port = free_port(host, port)
    # viser greets with a box of its own; ours says more.
    with open(os.devnull, "w", encoding="utf-8") as nowhere, contextlib.redirect_stdout(nowhere):
        server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
    if server.get_port() != port:
        server.stop()
        raise OSError(taken(host, port))
    server.gui.add_html(TOGETHER)
    return server


def require_viser() -> Any:
    """The module viser.

    Raises:
        ImportError: it is not installed; says how to install it.
    """
    try:
        import viser
    except ImportError as error:
        raise ImportError(NEEDS) from error
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
