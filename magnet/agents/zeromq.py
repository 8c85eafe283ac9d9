"""Messages over ZeroMQ: one PUB socket that tells, one SUB socket for each agent that is heard (docs/agents.md)."""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

from magnet.agents.message import LARGEST, PARTS, VERSION
from magnet.extras import installing

QUEUE = 64
"""Messages that wait for somebody who does not read; after that they are lost."""
SILENT = 10.0
"""Seconds after which whoever is silent is connected to anew."""
AGAIN = 0.25
"""Seconds after which whoever ZeroMQ has closed the connection to, and does not connect to again, is."""
THREADS = 32
"""Threads of ZeroMQ, at most."""
FORM = re.compile(r"ipc://.+|inproc://.+|tcp://[^\s/]+:(\d+|\*)")
HERE = re.compile(r"ipc://.+|inproc://.+|tcp://(127\.\d+\.\d+\.\d+|localhost|\[::1\]):\d+")


def engine() -> ModuleType:
    """ZeroMQ for Python.

    Raises:
        ModuleNotFoundError: it is not installed.
    """
    try:
        import zmq
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"agents need ZeroMQ: {installing('agents')}") from error
    return zmq


@dataclass
class Other:
    """Somebody who is heard, and how the connection to them is.

    Attributes:
        events: a socket on which ZeroMQ tells what happens to the connection.
        last: when something came, or it was connected to.
        begun: parts of a message that has not been read to its end.
        tried: whether ZeroMQ has found where to connect to, since it last said that it would do so again.
        greeting: whether the two are connected and have not agreed to speak yet, which ZeroMQ ends after 30 s.
        met: whether they have.
        cut: when the connection was closed, unless ZeroMQ connects again.
    """

    name: str
    address: str
    socket: Any
    events: Any
    last: float = field(default_factory=time.monotonic)
    begun: list[bytes] = field(default_factory=list)
    tried: bool = False
    greeting: bool = False
    met: bool = False
    cut: float | None = None


class Link:
    """What an agent sends and hears by.

    Args:
        name: whose link it is.
        listen: where it tells, such as tcp://127.0.0.1:5601 or ipc:///run/user/1000/a.
        connect: where each of the others tells.
        keys: folder of CURVE keys, as `make_keys` writes it: own NAME.key_secret, everybody's NAME.key. None: nothing
            is encrypted and nobody proves who they are, so addresses must be of this machine.
        say: told in a line what happens to connections.

    Attributes:
        closed: how often ZeroMQ has closed the connection to whom, for a part over `LARGEST` or for what is no message.

    Raises:
        ValueError: an address of another machine without keys, a key that is not there, or an address that is taken.
    """

    def __init__(
        self,
        name: str,
        listen: str,
        connect: Mapping[str, str],
        keys: Path | None = None,
        say: Callable[[str], object] = lambda _: None,
    ) -> None:
        zmq = engine()
        self.say, self.closed = say, Counter[str]()
        if keys is None:
            for address in (listen, *connect.values()):
                if not HERE.fullmatch(address):
                    raise ValueError(
                        f"{address} is not an address of this machine (tcp://127.0.0.1:PORT, ipc://PATH): give keys "
                        "(--keys) to send to others"
                    )
        else:
            for address in (listen, *connect.values()):
                if not FORM.fullmatch(address):
                    raise ValueError(f"{address} is not an address: expected tcp://HOST:PORT or ipc://PATH")
            for file in (f"{name}.key_secret", *(f"{other}.key" for other in connect)):
                if not (keys / file).is_file():
                    raise ValueError(f"{keys / file} is missing: make one with --make_keys, or copy theirs there")
        # A thread to each address: while the name of one is looked up nothing else passes by its thread, and where a
        # name server does not answer that takes ten seconds, again and again.
        self._zmq, self.context = zmq, zmq.Context(io_threads=1 + min(len(connect), THREADS - 1))
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
        self.out.linger, self.out.ipv6, self.out.affinity = 0, "[" in listen, 1
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
        self._others: dict[Any, Other] = {}  # by socket
        self._said: set[str] = set()
        for number, (other, address) in enumerate(connect.items()):
            socket = self.context.socket(zmq.SUB)
            socket.affinity = 1 << 1 + number % (THREADS - 1)
            socket.set_hwm(QUEUE)
            socket.linger, socket.ipv6 = 0, "[" in address
            socket.maxmsgsize = LARGEST
            if keys is not None and mine is not None:
                socket.curve_publickey, socket.curve_secretkey = mine
                socket.curve_serverkey = zmq.auth.load_certificate(keys / f"{other}.key")[0]
            socket.subscribe(b"magnet/")
            self._others[socket] = Other(other, address, socket, socket.get_monitor_socket())
            socket.connect(address)
            self.poller.register(socket, zmq.POLLIN)

    def send(self, parts: list[bytes]) -> None:
        """Tell all who listen; never waits."""
        self.out.send_multipart(parts)

    def receive(self, seconds: float) -> list[tuple[str, list[bytes]]]:
        """Messages that have arrived, each with its sender's name; waits for the first at most so long.

        Of a message of more parts than any has, one part more is given: enough to refuse it.
        """
        found = []
        for socket, _ in self.poller.poll(max(int(1000 * seconds), 0)):
            found += [(self._others[socket].name, parts) for parts in self._read(self._others[socket])]
        for other in self._others.values():
            self._look(other)
            self._renew(other, time.monotonic())
        return found

    def _read(self, other: Other) -> Iterator[list[bytes]]:
        """What has come whole, part by part: a message of a million parts takes seconds, and is read in many turns."""
        for _ in range(QUEUE * PARTS):
            try:
                part = other.socket.recv(self._zmq.NOBLOCK)
            except self._zmq.Again:
                return
            other.last = time.monotonic()
            if len(other.begun) <= PARTS:
                other.begun.append(part)
            if not other.socket.getsockopt(self._zmq.RCVMORE):
                parts, other.begun = other.begun, []
                yield parts

    def _look(self, other: Other) -> None:
        """Note what ZeroMQ tells of a connection, which it does at once."""
        from zmq.utils.monitor import recv_monitor_message

        zmq, name = self._zmq, other.name
        while other.events.poll(0):
            kind = recv_monitor_message(other.events)["event"]
            if kind in (zmq.EVENT_CONNECT_DELAYED, zmq.EVENT_CONNECTED):
                other.tried, other.greeting = True, kind == zmq.EVENT_CONNECTED
            elif kind == zmq.EVENT_HANDSHAKE_SUCCEEDED:
                other.met, other.greeting, other.last = True, False, time.monotonic()
            elif kind == zmq.EVENT_HANDSHAKE_FAILED_AUTH:
                self._tell(f"{name} does not know our key: {name}'s folder of keys needs ours")
            elif kind in (zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL, zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL):
                self._tell(f"what listens at {other.address} has not {name}'s keys, or one of the two has none")
            elif kind == zmq.EVENT_DISCONNECTED:
                other.cut = time.monotonic() if other.met else None
                other.met, other.greeting, other.tried = False, False, True
            elif kind == zmq.EVENT_CONNECT_RETRIED:
                if not other.tried:
                    self._tell(f"no way to the host of {other.address} is found, and is looked for again and again")
                other.cut, other.tried = None, False

    def _renew(self, other: Other, now: float) -> None:
        """Connect anew to who is silent, and soon to whom ZeroMQ does not: after one message over its size, say."""
        cut = other.cut is not None and now - other.cut > AGAIN
        if cut:
            self.closed[other.name] += 1
            self._tell(
                f"{other.name} sent a part of over {LARGEST} bytes, or what is no message: ZeroMQ closed the "
                "connection, which is made anew each time"
            )
        if cut or (now - other.last > SILENT and not other.greeting):
            other.last, other.cut = now, None
            other.socket.disconnect(other.address)
            other.socket.connect(other.address)

    def _tell(self, line: str) -> None:
        """Say it, once."""
        if line not in self._said:
            self._said.add(line)
            self.say(line)

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
