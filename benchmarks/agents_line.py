"""Agents in processes and network namespaces of their own, behind a line that loses, delays and reorders packets.

    python benchmarks/agents_line.py --seconds 60

Each namespace has a TUN device, the other end of which is here: so every IP packet between two agents passes through
`BadLine`, as through a router with tc/netem, without a kernel that has it. Needs Linux, `unshare`, `ip` and
/dev/net/tun.
"""

from __future__ import annotations

import argparse
import fcntl
import heapq
import json
import os
import random
import select
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

TUN, TUNSETIFF, IFF_TUN, IFF_NO_PI = Path("/dev/net/tun"), 0x400454CA, 0x0001, 0x1000
UNSHARE = ("unshare", "--net", "--map-root-user")
PORT = 5601
COLUMNS = (
    *("delay, ms", "loss", "packets lost", "reordered", "tokens", "gaps", "filled", "never", "late", "jumps"),
    *("refused", "ms a token"),
)
LINES = ((0, 0, 0.0), (50, 0, 0.0), (50, 50, 0.0), (50, 50, 0.05), (50, 50, 0.1), (100, 100, 0.1), (100, 100, 0.3))
"""Milliseconds of delay, milliseconds of it at most that are by chance, and share of lost packets; one way each."""


def refused() -> str:
    """Why namespaces with a TUN device cannot be made here; empty: they can."""
    try:
        words = [*UNSHARE, sys.executable, __file__, "--try_one"]
        tried = subprocess.run(words, capture_output=True, text=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"unshare: {error}"
    return "" if tried.returncode == 0 else (tried.stderr.strip().splitlines() or ["unshare failed"])[-1]


def opened(address: str) -> int:
    """A TUN device with an IPv4 address in this namespace; as long as the descriptor is open. -> its descriptor"""
    device = os.open(TUN, os.O_RDWR)
    fcntl.ioctl(device, TUNSETIFF, struct.pack("16sH22x", b"line", IFF_TUN | IFF_NO_PI))
    for words in (f"addr add {address}/24 dev line", "link set line up", "link set lo up"):
        subprocess.run(["ip", *words.split()], check=True)
    return device


class BadLine(threading.Thread):
    """Hands on packets between namespaces; some are lost, each of the others is late by a time of its own.

    Args:
        delay: seconds by which every packet is late.
        jitter: up to so many seconds more, for each packet by itself, which changes their order.
        loss: share of the packets that never come.
        seed: of what is lost and late.

    Attributes:
        passed: packets that came.
        lost: packets that did not.
        reordered: packets that came before one that had been sent earlier to the same address.
    """

    def __init__(self, delay: float = 0.0, jitter: float = 0.0, loss: float = 0.0, seed: int = 0) -> None:
        super().__init__(daemon=True)
        self.delay, self.jitter, self.loss, self.chance = delay, jitter, loss, random.Random(seed)
        self.passed = self.lost = self.reordered = 0
        self._ends: dict[str, int] = {}
        self._over = threading.Event()

    def begin(self, address: str, words: Sequence[str], **popen: Any) -> subprocess.Popen:
        """Start a process in a namespace with this address; one that is started again takes the old one's place."""
        ours, theirs = socket.socketpair()
        inside = [*UNSHARE, sys.executable, __file__, "--inside", address, "--send", str(theirs.fileno()), *words]
        process = subprocess.Popen(inside, pass_fds=[theirs.fileno()], **popen)
        theirs.close()
        _, found, _, _ = socket.recv_fds(ours, 1, 1)
        ours.close()
        if not found:
            raise RuntimeError(f"{address}: no TUN device came, see what the process said")
        os.set_blocking(found[0], False)
        self._ends[address] = found[0]
        return process

    def run(self) -> None:
        waiting: list[tuple[float, int, str, bytes]] = []
        newest: dict[str, int] = {}
        number = 0
        while not self._over.is_set():
            now = time.monotonic()
            while waiting and waiting[0][0] <= now:
                _, which, to, packet = heapq.heappop(waiting)
                self.reordered += which < newest.get(to, -1)
                newest[to] = max(which, newest.get(to, -1))
                self._write(to, packet)
            left = min(waiting[0][0] - now if waiting else 0.05, 0.05)
            ends = {end: address for address, end in self._ends.items()}
            for end in select.select(list(ends), [], [], max(left, 0))[0]:
                for packet in self._read(end, ends[end]):
                    number, to = number + 1, socket.inet_ntoa(packet[16:20])
                    if packet[0] >> 4 != 4 or to not in self._ends:
                        continue
                    if self.chance.random() < self.loss:
                        self.lost += 1
                        continue
                    due = time.monotonic() + self.delay + self.jitter * self.chance.random()
                    heapq.heappush(waiting, (due, number, to, packet))

    def _read(self, end: int, address: str) -> list[bytes]:
        """All packets that have come."""
        found: list[bytes] = []
        try:
            while select.select([end], [], [], 0)[0]:
                found.append(os.read(end, 65536))
        except OSError:  # the process is gone, and its namespace with it
            if self._ends.get(address) == end:
                del self._ends[address]
            os.close(end)
        return found

    def _write(self, to: str, packet: bytes) -> None:
        try:
            os.write(self._ends[to], packet)
            self.passed += 1
        except (KeyError, OSError):
            self.lost += 1

    def stop(self) -> None:
        """End it; call when the processes have ended."""
        self._over.set()
        self.join()
        for end in self._ends.values():
            os.close(end)
        self._ends.clear()


def inside(address: str, descriptor: int, words: Sequence[str]) -> None:
    """In the new namespace: make the device, hand its other end out, and become the process that was asked for."""
    with socket.socket(fileno=descriptor) as out:
        device = opened(address)
        socket.send_fds(out, [b"."], [device])
    os.execvp(words[0], list(words))


def agents(
    line: BadLine,
    folder: Path,
    scene: Path,
    names: str,
    more: Sequence[str],
    **popen: Any,
) -> dict[str, subprocess.Popen]:
    """Start an agent a name, each in a namespace, with keys: another namespace is another machine. -> by name

    more: further options of `magnet agent`, the same for all; popen: of `subprocess.Popen`.
    """
    from magnet.agents.zeromq import make_keys

    where = {name: f"10.7.0.{number + 1}" for number, name in enumerate(names)}
    for name in names:
        if not (folder / "keys" / f"{name}.key_secret").exists():
            make_keys(folder / "keys", name)
    made = {}
    for name in names:
        words = [sys.executable, "-m", "magnet", "agent", "--name", name, "--scene", str(scene)]
        words += ["--listen", f"tcp://{where[name]}:{PORT}", "--keys", str(folder / "keys")]
        for other in names.replace(name, ""):
            words += ["--connect", f"{other}=tcp://{where[other]}:{PORT}"]
        words += ["--report", str(folder / f"{name}.json"), "--out", str(folder / f"{name}.npz"), *more]
        made[name] = line.begin(where[name], words, **popen)
    return made


def measured(scene: Path, delay: int, jitter: int, loss: float, seconds: float, steps: int, model: str) -> str:
    """A row of the table: two agents in real time over such a line."""
    line = BadLine(delay / 1000, jitter / 1000, loss)
    line.start()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        options = ["--model", model, "--seconds", str(seconds), "--steps", str(steps), "--meet", "120"]
        both = agents(line, folder, scene, "AB", options, stdout=subprocess.DEVNULL)
        codes = [each.wait() for each in both.values()]
        line.stop()
        if any(codes):
            raise RuntimeError(f"agents ended with {codes}")
        found = [json.loads((folder / f"{name}.json").read_text()) for name in "AB"]
    said = {key: sum(each[key] for each in found) for key in ("tokens", "gaps", "filled", "late", "jumps", "resets")}
    made = max(each["made_in_ms"] for each in found)
    refusals = sum(sum(each["refused"].values()) for each in found)
    return (
        f"| {delay} + {jitter} | {100 * loss:.0f} % | {line.lost} of {line.lost + line.passed} | {line.reordered} | "
        f"{said['tokens']} | {said['gaps']} | {said['filled']} | {said['gaps'] - said['filled']} | {said['late']} | "
        f"{said['jumps']} | {refusals} | {made:.0f} |"
    )


def main() -> None:
    given = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    given.add_argument("--model", default="duet")
    given.add_argument("--steps", type=int, default=4)
    given.add_argument("--seconds", type=float, default=60)
    asked = given.parse_args()
    if why := refused():
        sys.exit(f"namespaces cannot be made here: {why}")
    import magnet

    with tempfile.TemporaryDirectory() as name:
        scene = Path(name) / "start.npz"
        magnet.load(asked.model).generate(people=2, frames=32, seed=0).save(scene)
        print(f"| {' | '.join(COLUMNS)} |\n|{'---:|' * len(COLUMNS)}", flush=True)
        for delay, jitter, loss in LINES:
            print(measured(scene, delay, jitter, loss, asked.seconds, asked.steps, asked.model), flush=True)


if __name__ == "__main__":
    if sys.argv[1:] == ["--try_one"]:
        opened("10.7.0.1")
    elif sys.argv[1:2] == ["--inside"]:
        inside(sys.argv[2], int(sys.argv[4]), sys.argv[5:])
    else:
        main()
