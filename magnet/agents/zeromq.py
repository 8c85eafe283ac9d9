"""Messages over ZeroMQ: one PUB socket that tells, one SUB socket for each agent that is heard (docs/agents.md)."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from magnet.agents.message import LARGEST, PARTS, VERSION

QUEUE = 64
"""Messages that wait for somebody who does not read; after that they are lost."""
SILENT = 10.0
"""Seconds after which whoever is silent is connected to anew."""
HERE = re.compile(r"ipc://.+|inproc://.+|tcp://(127\.\d+\.\d+\.\d+|localhost|\[::1\]):\d+")


def engine() -> ModuleType:
    """ZeroMQ for Python.

    Raises:
        ModuleNotFoundError: it is not installed.
    """
    try:
        import zmq
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError('agents need ZeroMQ: pip install "magnet-motion[agents]"') from error
    return zmq


class Link:
    """What an agent sends and hears by.

    Args:
        name: whose link it is.
        listen: where it tells, such as tcp://127.0.0.1:5601 or ipc:///run/user/1000/a.
        connect: where each of the others tells.
        keys: folder of CURVE keys, as `make_keys` writes it: own NAME.key_secret, everybody's NAME.key. None: nothing
            is encrypted and nobody proves who they are, so addresses must be of this machine.

    Raises:
        ValueError: an address of another machine without keys, a key that is not there, or an address that is taken.
    """

    def __init__(self, name: str, listen: str, connect: Mapping[str, str], keys: Path | None = None) -> None:
        zmq = engine()
        if keys is None:
            for address in (listen, *connect.values()):
                if not HERE.fullmatch(address):
                    raise ValueError(
                        f"{address} is not an address of this machine (tcp://127.0.0.1:PORT, ipc://PATH): give keys "
                        "(--keys) to send to others"
                    )
        else:
            for file in (f"{name}.key_secret", *(f"{other}.key" for other in connect)):
                if not (keys / file).is_file():
                    raise ValueError(f"{keys / file} is missing: make one with --make_keys, or copy theirs there")
        self._zmq, self.context = zmq, zmq.Context()
        self._guard: Any = None
        try:
            self._open(name, listen, connect, keys)
        except (zmq.ZMQError, OSError) as error:
            self.close()
            raise ValueError(f"{listen}: {error}; choose another address, or look into the folder of keys") from error

    def _open(self, name: str, listen: str, connect: Mapping[str, str], keys: Path | None) -> None:
        zmq = self._zmq
        self.out = self.context.socket(zmq.PUB)
        self.out.set_hwm(QUEUE)
        self.out.linger, self.out.ipv6 = 0, "[" in listen
        mine: tuple[Any, Any] | None = None
        if keys is not None:
            import zmq.auth
            from zmq.auth.thread import ThreadAuthenticator

            mine = zmq.auth.load_certificate(keys / f"{name}.key_secret")
            self._guard = ThreadAuthenticator(self.context)
            self._guard.start()
            self._guard.configure_curve(domain="*", location=str(keys))
            self.out.curve_publickey, self.out.curve_secretkey = mine
            self.out.curve_server = True
        self.out.bind(listen)
        self.poller = zmq.Poller()
        self.inn: dict[Any, tuple[str, str]] = {}  # sockets, and of whom and where they hear
        self._last: dict[Any, float] = {}
        self._begun: dict[Any, list[bytes]] = {}  # messages that are not read to their ends yet
        for other, address in connect.items():
            socket = self.context.socket(zmq.SUB)
            socket.set_hwm(QUEUE)
            socket.linger, socket.ipv6 = 0, "[" in address
            socket.maxmsgsize = LARGEST
            if keys is not None and mine is not None:
                socket.curve_publickey, socket.curve_secretkey = mine
                socket.curve_serverkey = zmq.auth.load_certificate(keys / f"{other}.key")[0]
            socket.subscribe(b"magnet/")
            socket.connect(address)
            self.poller.register(socket, zmq.POLLIN)
            self.inn[socket], self._last[socket], self._begun[socket] = (other, address), time.monotonic(), []

    def send(self, parts: list[bytes]) -> None:
        """Tell all who listen; never waits."""
        self.out.send_multipart(parts)

    def receive(self, seconds: float) -> list[tuple[str, list[bytes]]]:
        """Messages that have arrived, each with its sender's name; waits for the first at most so long.

        Of a message of more parts than any has, one part more is given: enough to refuse it.
        """
        found = []
        for socket, _ in self.poller.poll(max(int(1000 * seconds), 0)):
            found += [(self.inn[socket][0], parts) for parts in self._read(socket)]
            self._last[socket] = time.monotonic()
        self._renew()
        return found

    def _read(self, socket: Any) -> Iterator[list[bytes]]:
        """What has come whole, part by part: a message of a million parts takes seconds, and is read in many turns."""
        for _ in range(QUEUE * PARTS):
            try:
                part = socket.recv(self._zmq.NOBLOCK)
            except self._zmq.Again:
                return
            if len(self._begun[socket]) <= PARTS:
                self._begun[socket].append(part)
            if not socket.getsockopt(self._zmq.RCVMORE):
                parts, self._begun[socket] = self._begun[socket], []
                yield parts

    def _renew(self) -> None:
        """Connect anew to who is silent: after one message over its size ZeroMQ hears nothing of an address again."""
        for socket, (_, address) in self.inn.items():
            if (now := time.monotonic()) - self._last[socket] > SILENT:
                self._last[socket] = now
                socket.disconnect(address)
                socket.connect(address)

    def close(self) -> None:
        if self._guard is not None:
            self._guard.stop()
        self.context.destroy(linger=0)


def make_keys(folder: Path, name: str) -> Path:
    """Make a pair of CURVE keys: NAME.key, which the others need, and NAME.key_secret, which nobody else may see.

    Raises:
        ValueError: a name that no file can have, or whose keys are there already.
    """
    engine()
    import zmq.auth

    if not name or Path(name).name != name:
        raise ValueError(f"name: got {name!r}, expected one that a file can have")
    if (folder / f"{name}.key_secret").exists():
        raise ValueError(
            f"{folder / name}.key_secret is there already, and the others have its {name}.key: to make another pair, "
            "delete it first"
        )
    folder.mkdir(parents=True, exist_ok=True)
    _, secret = zmq.auth.create_certificates(folder, name, metadata={"magnet": str(VERSION)})
    Path(secret).chmod(0o600)
    return Path(secret)
