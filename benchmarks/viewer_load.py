"""How the viewer bears a crowd: memory, bytes and milliseconds a frame, and frames a second in a browser.

    python benchmarks/viewer_load.py --people 16 --frames 20000

Chromium runs headless with a software renderer, so its frame rates are the least that a computer without any GPU gives.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import shutil
import threading
import time
from pathlib import Path
from typing import Any

import torch

from magnet.body import load_body
from magnet.motion.scene import Scene
from magnet.testing import random_scene
from magnet.viewer.rig import STYLES
from magnet.viewer.takes import take
from magnet.viewer.troupe import Look
from magnet.viewer.watch import Viewer

FLAGS = (
    "--no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader --ignore-gpu-blocklist "
    "--disable-background-networking --no-first-run --disable-component-update --disable-sync --disable-quic"
)
STEPS = 40
COUNT = "window.frames_drawn = 0; (function f() { window.frames_drawn++; requestAnimationFrame(f) })()"


def crowd(people: int, frames: int) -> Scene:
    """People who wander around, on a grid of 2 metres; 500 frames, again and again."""
    part = random_scene(1, min(frames, 500), people, torch.Generator().manual_seed(1))
    roots = part.T_world_root.clone()
    side = max(1, round(people**0.5))
    slot = torch.arange(people)
    roots[..., 0, 3] += 2.0 * (slot % side)
    roots[..., 2, 3] += 2.0 * (slot // side)
    times = -(-frames // part.frames)
    return part.replace(
        T_world_root=roots.repeat(1, times, 1, 1, 1)[:, :frames],
        body_rot=part.body_rot.repeat(1, times, 1, 1, 1, 1)[:, :frames],
    )


def memory() -> float:
    """Megabytes of this process in memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6


class Listener(threading.Thread):
    """A client of the viewer that only counts what it receives."""

    def __init__(self, port: int) -> None:
        super().__init__(daemon=True)
        self.port, self.total, self.ended = port, 0, False

    def run(self) -> None:
        asyncio.run(self._listen())

    async def _listen(self) -> None:
        import viser
        from websockets.asyncio.client import connect
        from websockets.typing import Subprotocol

        protocol = Subprotocol(f"viser-v{viser.__version__}")
        async with connect(f"ws://127.0.0.1:{self.port}", subprotocols=[protocol], max_size=None) as socket:
            while not self.ended:
                with contextlib.suppress(TimeoutError):
                    self.total += len(await asyncio.wait_for(socket.recv(), 0.2))

    def quiet(self) -> int:
        """Bytes so far, as soon as nothing has come for a second."""
        before = -1
        while before != self.total:
            before = self.total
            time.sleep(1.0)
        return self.total


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--people", type=int, default=16)
    options.add_argument("--frames", type=int, default=20_000)
    options.add_argument("--seconds", type=float, default=8.0)
    options.add_argument("--shadows", action="store_true", help="true shadows instead of discs")
    options.add_argument("--marks", action="store_true", help="trails, contacts and collisions too")
    options.add_argument("--no-browser", action="store_true")
    asked = options.parse_args()
    torch.set_num_threads(1)
    body = load_body("open")
    empty = memory()
    scene = crowd(asked.people, asked.frames)
    print(f"{asked.people} people x {asked.frames} frames; the scene takes {memory() - empty:.0f} MB")
    print(f"{'style':10} {'MB more':>8} {'server ms':>10} {'kB/frame':>9} {'sent/s':>7} {'drawn/s':>8} {'CPU ms':>7}")
    for style in STYLES:
        measure(asked, scene, body, style)


def measure(asked: argparse.Namespace, scene: Scene, body: Any, style: Any) -> None:
    """One line of the table."""
    before = memory()
    rich = asked.marks
    look = Look(style=style, trails=rich, contacts=rich, collisions=rich, shadows=asked.shadows)
    viewer = Viewer([take("crowd", scene)], body, port=0, look=look)
    listener = Listener(viewer.port)
    listener.start()
    begun, cpu = listener.quiet(), time.process_time()
    for frame in range(100, 100 + STEPS):
        viewer.clock.seek(frame)
        viewer.draw()
        time.sleep(0.05)
    cost = (time.process_time() - cpu) / STEPS
    kilobytes = (listener.quiet() - begun) / STEPS / 1e3
    listener.ended = True
    listener.join()
    thread = viewer.start()
    sent = viewer.sent
    time.sleep(asked.seconds)
    rate = (viewer.sent - sent) / asked.seconds
    drawn, spent = (float("nan"),) * 2 if asked.no_browser else browser_rate(viewer.port, asked.seconds)
    more = memory() - before
    print(
        f"{style:10} {more:8.0f} {1e3 * cost:10.1f} {kilobytes:9.1f} {rate:7.1f} {drawn:8.1f} {spent:7.0f}", flush=True
    )
    viewer.stop()
    thread.join(timeout=10)


def browser_rate(port: int, seconds: float) -> tuple[float, float]:
    """Frames a second that a headless Chromium draws while the viewer plays, and its CPU milliseconds a frame."""
    from playwright.sync_api import sync_playwright

    path = shutil.which("chromium") or shutil.which("google-chrome")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, headless=True, args=FLAGS.split())
        page = browser.new_page(viewport={"width": 800, "height": 500})
        page.goto(f"http://127.0.0.1:{port}")
        page.get_by_role("button", name="Pause").wait_for(timeout=120_000)
        page.evaluate(COUNT)  # the first frames wait for shaders to be compiled
        page.wait_for_function("window.frames_drawn > 25", timeout=240_000)
        page.evaluate("window.frames_drawn = 0")
        before = children_cpu()
        page.wait_for_timeout(1000 * seconds)
        count = float(page.evaluate("window.frames_drawn"))
        spent = children_cpu() - before
        browser.close()
    return count / seconds, 1e3 * spent / max(count, 1.0)


def children_cpu() -> float:
    """Seconds of CPU that all processes under this one have taken."""
    parents, taken = {}, {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        parents[int(path.parent.name)] = int(fields[1])
        taken[int(path.parent.name)] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    total = 0.0
    for process, seconds in taken.items():
        above = parents[process]
        while above in parents and above != os.getpid():
            above = parents[above]
        total += seconds if above == os.getpid() else 0.0
    return total


if __name__ == "__main__":
    main()
