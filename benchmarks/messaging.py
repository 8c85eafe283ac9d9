"""How long a message takes from one process to another on this machine, by ZeroMQ and by Zenoh, and what gets lost.

    pip install pyzmq eclipse-zenoh
    python benchmarks/messaging.py

One process publishes, another gives back what it receives; half of the way there and back is the latency. Then the
receiver sleeps for two seconds while messages keep coming: what it gets of them afterwards shows what the engine drops.
"""

from __future__ import annotations

import argparse
import multiprocessing
import statistics
import struct
import time
from collections.abc import Callable
from typing import Any

PORTS = (15741, 15742)
SIZE = 4096
"""Bytes of a message: about a token with its poses and its latent."""


class Zeromq:
    """PUB and SUB over TCP, with queues of 64 messages."""

    def __init__(self, mine: int, other: int) -> None:
        import zmq

        self.context = zmq.Context()
        self.out, self.inn = self.context.socket(zmq.PUB), self.context.socket(zmq.SUB)
        for socket in (self.out, self.inn):
            socket.set_hwm(64)
            socket.linger = 0
        self.out.bind(f"tcp://127.0.0.1:{mine}")
        self.inn.subscribe(b"")
        self.inn.connect(f"tcp://127.0.0.1:{other}")

    def send(self, data: bytes) -> None:
        self.out.send(data)

    def receive(self, seconds: float) -> bytes | None:
        return self.inn.recv() if self.inn.poll(int(1000 * seconds)) else None

    def close(self) -> None:
        self.context.destroy()


class Zenoh:
    """A publisher that drops and a subscriber with a queue of 64, peer to peer, without scouting."""

    def __init__(self, mine: int, other: int) -> None:
        import zenoh

        config = zenoh.Config()
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("listen/endpoints", f'["tcp/127.0.0.1:{mine}"]')
        config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{other}"]')
        self.session = zenoh.open(config)
        drop = zenoh.CongestionControl.DROP
        self.out = self.session.declare_publisher(f"from/{mine}", congestion_control=drop)
        self.inn = self.session.declare_subscriber(f"from/{other}", zenoh.handlers.RingChannel(64))

    def send(self, data: bytes) -> None:
        self.out.put(data)

    def receive(self, seconds: float) -> bytes | None:
        end = time.perf_counter() + seconds
        while time.perf_counter() < end:
            if (sample := self.inn.try_recv()) is not None:
                return bytes(sample.payload)
            time.sleep(0.00005)
        return None

    def close(self) -> None:
        self.session.close()


def echo(engine: Callable[..., Any], seconds: float) -> None:
    """Give back what comes; sleep for two seconds where a message says so."""
    link, end = engine(PORTS[1], PORTS[0]), time.time() + seconds
    while time.time() < end:
        got = link.receive(0.2)
        if got is not None and got[:1] == b"s":
            time.sleep(2.0)
        elif got is not None:
            link.send(got)
    link.close()


def measure(engine: Callable[..., Any], rounds: int, rate: float) -> dict[str, float]:
    """Latency in milliseconds, seconds to connect, and how many of 1,000 messages a sleeper gets."""
    process = multiprocessing.Process(target=echo, args=(engine, 12 + 2 * rounds / rate), daemon=True)
    process.start()
    begun = time.perf_counter()
    link = engine(PORTS[0], PORTS[1])
    while link.receive(0.05) is None:
        link.send(b"?" * SIZE)
    connected = time.perf_counter() - begun
    while link.receive(0.3) is not None:
        pass
    took, lost = [], 0
    for number in range(rounds):
        sent = time.perf_counter()
        link.send(struct.pack("<d", number).ljust(SIZE, b"."))
        got = link.receive(0.5)
        lost += got is None
        took += [] if got is None else [500 * (time.perf_counter() - sent)]
        time.sleep(max(0.0, sent + 1 / rate - time.perf_counter()))
    link.send(b"s" * SIZE)
    time.sleep(0.3)
    for number in range(1000):
        link.send(struct.pack("<d", number).ljust(SIZE, b"."))
        time.sleep(0.001)
    kept = []
    while (got := link.receive(1.5)) is not None:
        kept.append(struct.unpack("<d", got[:8])[0])
    link.close()
    process.terminate()
    process.join()
    took.sort()
    found = {"connect_s": connected, "median_ms": statistics.median(took), "p99_ms": took[int(0.99 * len(took))]}
    return found | {"max_ms": took[-1], "lost": lost, "kept": len(kept), "oldest": min(kept), "newest": max(kept)}


def main() -> None:
    """Measure, print a table."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--rounds", type=int, default=1000)
    options.add_argument("--rate", type=float, default=100.0, help="messages a second")
    given = options.parse_args()
    for engine in (Zeromq, Zenoh):
        found = measure(engine, given.rounds, given.rate)
        print(engine.__name__, {name: round(value, 3) for name, value in found.items()}, flush=True)


if __name__ == "__main__":
    main()
