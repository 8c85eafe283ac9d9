"""Four agents in real time, of which one is killed and comes back again and again: what that costs the others.

    python benchmarks/agents_killed.py --minutes 10 --every 120 --away 10 --speed 0.125

Each is a process of `magnet agent`; the last of them is killed (SIGKILL) and started anew. Somebody who only listens
notes for how long each was silent. Where processors are too slow for all of them, `--speed` slows the scene's clock.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import magnet
from magnet.agents.message import RefusedMessage, unpack
from magnet.agents.zeromq import Link
from magnet.cli.provenance import machine

COLUMNS = (
    *("tokens", "late", "gaps", "filled", "jumps", "resets", "passed_over"),
    *("made_in_ms", "late_ms_p99", "late_ms_most", "silent_s"),
)


def addresses(names: str) -> dict[str, str]:
    """A free port of this machine for each."""
    found = {}
    sockets = [socket.socket() for _ in names]
    for name, each in zip(names, sockets, strict=True):
        each.bind(("127.0.0.1", 0))
        found[name] = f"tcp://127.0.0.1:{each.getsockname()[1]}"
    for each in sockets:
        each.close()
    return found


class Watcher:
    """Listens to everybody and notes when who told new frames.

    Args:
        where: addresses by name.

    Attributes:
        at: when somebody was heard last, in seconds.
        frame: the newest frame of each.
        silent: the longest time between two tokens of each, in seconds.
    """

    def __init__(self, where: dict[str, str]) -> None:
        own = addresses("W")["W"]
        self.link = Link("watcher", own, where)
        self.at: dict[str, float] = {}
        self.frame: dict[str, int] = {}
        self.silent = dict.fromkeys(where, 0.0)

    def watch(self, seconds: float, until: float = float("inf")) -> None:
        """Listen for so long; no longer than until everybody has told so many frames."""
        end = time.monotonic() + seconds
        while time.monotonic() < end and not all(self.frame.get(name, -1) >= until for name in self.silent):
            for peer, parts in self.link.receive(0.05):
                try:
                    message = unpack(parts)
                except RefusedMessage:
                    continue
                if message.kind == "frames" and message.agent == peer and message.frame > self.frame.get(peer, -1):
                    now = time.monotonic()
                    self.silent[peer] = max(self.silent[peer], now - self.at.get(peer, now))
                    self.at[peer], self.frame[peer] = now, message.frame


def started(folder: Path, name: str, where: dict[str, str], asked: argparse.Namespace) -> subprocess.Popen:
    """An agent's process."""
    words = [sys.executable, "-m", "magnet", "agent", "--name", name, "--scene", str(folder / "start.npz")]
    words += ["--model", asked.model, "--steps", str(asked.steps), "--meet", "300", "--listen", where[name]]
    words += ["--speed", str(asked.speed), *([] if asked.settle is None else ["--settle", asked.settle])]
    for other in sorted(set(where) - {name}):
        words += ["--connect", f"{other}={where[other]}"]
    env = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen([*words, "--report", str(folder / f"{name}.json")], env=env, stdout=subprocess.DEVNULL)


def measured(folder: Path, names: str, asked: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """Run them; what each had to say in the end, and for how long it was silent."""
    where = addresses(names)
    group = {name: started(folder, name, where, asked) for name in names}
    watcher, victim, returns = Watcher(where), names[-1], []
    watcher.watch(400, until=8)
    begun, kills = time.monotonic(), 0
    while (now := time.monotonic() - begun) < 60 * asked.minutes:
        due = (kills + 1) * asked.every
        if due + asked.away + asked.every * 0.7 > 60 * asked.minutes:
            watcher.watch(60 * asked.minutes - now)
            continue
        watcher.watch(due - now)
        os.kill(group[victim].pid, signal.SIGKILL)
        group[victim].wait()
        kills += 1
        watcher.watch(asked.away)
        group[victim] = started(folder, victim, where, asked)
        back = time.monotonic()
        watcher.watch(asked.every * 0.7, until=watcher.frame[victim] + 1)
        returns.append(watcher.at[victim] - back if watcher.at[victim] > back else float("nan"))
        silences = ", ".join(f"{name} {watcher.silent[name]:.2f}" for name in names)
        print(
            f"kill {kills}: heard again after {returns[-1]:.1f} s; longest silences so far, s: {silences}", flush=True
        )
    for process in group.values():
        process.send_signal(signal.SIGTERM)
    codes = [process.wait(120) for process in group.values()]
    watcher.link.close()
    if any(codes):
        raise RuntimeError(f"agents ended with {codes}")
    found = {name: json.loads((folder / f"{name}.json").read_text()) for name in names}
    return {name: found[name] | {"silent_s": watcher.silent[name]} for name in names}


def main() -> None:
    given = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    given.add_argument("--model", default="duet")
    given.add_argument("--names", default="ABCD")
    given.add_argument("--steps", type=int, default=4)
    given.add_argument("--speed", type=float, default=1.0, help="of the scene's clock, see magnet agent")
    given.add_argument("--settle", help="see magnet agent")
    given.add_argument("--minutes", type=float, default=10)
    given.add_argument("--every", type=float, default=120, help="seconds from one kill to the next")
    given.add_argument("--away", type=float, default=10, help="seconds until it is started again")
    asked = given.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        magnet.load(asked.model).generate(people=len(asked.names), frames=32, seed=0).save(folder / "start.npz")
        found = measured(folder, asked.names, asked)
    print(json.dumps(machine()), f"load {os.getloadavg()[0]:.1f}")
    print(f"| agent | {' | '.join(COLUMNS)} |\n|{'---:|' * (1 + len(COLUMNS))}")
    for name, said in found.items():
        values = (said[column] if said[column] is not None else float("nan") for column in COLUMNS)
        print(f"| {name} | {' | '.join(f'{value:.4g}' for value in values)} | {said['refused'] or ''}")


if __name__ == "__main__":
    main()
