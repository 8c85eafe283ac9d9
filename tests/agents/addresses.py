"""Addresses of this machine for agents of tests."""

from __future__ import annotations

import socket


def ports(count: int) -> list[int]:
    """Free ports of this machine."""
    sockets = [socket.socket() for _ in range(count)]
    for each in sockets:
        each.bind(("127.0.0.1", 0))
    found = [each.getsockname()[1] for each in sockets]
    for each in sockets:
        each.close()
    return found


def addresses_of(names: str) -> dict[str, str]:
    return {name: f"tcp://127.0.0.1:{port}" for name, port in zip(names, ports(len(names)), strict=True)}
