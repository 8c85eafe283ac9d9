"""How the viewer bears a crowd: memory, bytes and milliseconds a frame, and frames a second in a browser.

    python benchmarks/viewer_load.py --people 16 --frames 20000
    python benchmarks/viewer_load.py --page crowd.html --warm 3   # a self-contained page, which has no server

Chromium runs headless with a software renderer, so its frame rates are the least that a computer without any GPU gives.
Where the time goes: `server ms` is Python's CPU for a frame that is sent, `script ms` the browser's for its scripts,
`draw ms` that of the process that draws, which is what a GPU would take over. The last two are for a frame drawn.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import dataclasses
import os
import shutil
import threading
import time
from pathlib import Path
from typing import Any

import torch

from magnet.body import load_body
from magnet.export.drawing import STYLES, Style
from magnet.export.page.takes import take
from magnet.motion.scene import Scene
from magnet.testing import random_scene
from magnet.viewer.scene_view import RenderOptions
from magnet.viewer.watch import Viewer

FLAGS = (
    "--no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader --ignore-gpu-blocklist "
    "--disable-background-networking --no-first-run --disable-component-update --disable-sync --disable-quic"
)
STEPS = 40
COUNT = """
window.drawn = {frames: 0, calls: 0, triangles: 0};
let ticks = 0, last = -1;
for (const name of ['drawElements', 'drawElementsInstanced', 'drawArrays', 'drawArraysInstanced']) {
  const call = WebGL2RenderingContext.prototype[name];
  WebGL2RenderingContext.prototype[name] = function (...words) {
    const times = name.endsWith('Instanced') ? words[words.length - 1] : 1;
    drawn.calls += 1;
    drawn.triangles += words[name.startsWith('drawElements') ? 1 : 2] / 3 * times;
    if (last !== ticks) { last = ticks; drawn.frames += 1; }
    return call.apply(this, words);
  };
}
(function tick() { ticks += 1; requestAnimationFrame(tick); })();
"""


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
    return int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1]) * 4096 / 1e6


class Listener(threading.Thread):
    """A client of the viewer that only counts what it receives."""

    def __init__(self, port: int) -> None:
        super().__init__(daemon=True)
        self.port, self.total, self.packets, self.ended = port, 0, 0, False

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
                    self.packets += 1

    def quiet(self) -> int:
        """Bytes so far, as soon as nothing has come for a second."""
        before = -1
        while before != self.total:
            before = self.total
            time.sleep(1.0)
        return self.total


HEAD = f"{'view':10} {'server MB':>9} {'server ms':>9} {'kB/frame':>8} {'packets':>7} {'sent/s':>6}"
HEAD_BROWSER = (
    f"{'drawn/s':>7} {'k triangles':>11} {'calls':>5} {'script ms':>9} {'draw ms':>7} {'script MB':>9} {'page MB':>7}"
)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--people", type=int, default=16)
    options.add_argument("--frames", type=int, default=20_000)
    options.add_argument("--seconds", type=float, default=12.0)
    options.add_argument("--size", default="1280x720", help="of the window (default: %(default)s)")
    options.add_argument("--views", nargs="+", choices=STYLES, default=STYLES)
    options.add_argument("--shadows", action="store_true", help="true shadows instead of discs")
    options.add_argument("--marks", action="store_true", help="trails, contacts and collisions too")
    options.add_argument("--dpr", type=float, help="viser's ?fixedDpr: 0.5 draws a quarter of the pixels")
    options.add_argument("--no_browser", action="store_true")
    options.add_argument("--page", type=Path, help="a self-contained page to measure in place of the viewer")
    first = "frames drawn before anything counts, as the first wait for shaders to be compiled (default: %(default)s)"
    options.add_argument("--warm", type=int, default=25, help=first)
    asked = options.parse_args()
    if asked.page:
        print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; window {asked.size}\n{HEAD_BROWSER}")
        return print(in_browser(asked.page.resolve().as_uri(), asked))
    torch.set_num_threads(1)
    body = load_body("open")
    empty = memory()
    scene = crowd(asked.people, asked.frames)
    print(f"{asked.people} people x {asked.frames} frames; the scene takes {memory() - empty:.0f} of {memory():.0f} MB")
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; window {asked.size}")
    print(f"{HEAD} | {HEAD_BROWSER}")
    for style in asked.views:
        measure(asked, scene, body, style)


def measure(asked: argparse.Namespace, scene: Scene, body: Any, style: Style) -> None:
    """One line of the table."""
    before = memory()
    rich = asked.marks
    render = RenderOptions(style="skeleton", trails=rich, contacts=rich, collisions=rich, shadows=asked.shadows)
    viewer = Viewer([take("crowd", scene)], body, port=0, render=render)
    viewer.set_style(dataclasses.replace(render, style=style))
    listener = Listener(viewer.port)
    listener.start()
    begun, packets, cpu = listener.quiet(), listener.packets, time.process_time()
    for frame in range(100, 100 + STEPS):
        viewer.clock.seek(frame)
        viewer.draw()
        time.sleep(0.05)
    cost = (time.process_time() - cpu) / STEPS
    kilobytes = (listener.quiet() - begun) / STEPS / 1e3
    sent_packets = (listener.packets - packets) / STEPS
    listener.ended = True
    listener.join()
    thread = viewer.start()
    sent = viewer.sent
    time.sleep(asked.seconds)
    rate = (viewer.sent - sent) / asked.seconds
    line = f"{style:10} {memory() - before:9.0f} {1e3 * cost:9.1f} {kilobytes:8.1f} {sent_packets:7.1f} {rate:6.1f}"
    address = f"http://127.0.0.1:{viewer.port}/{f'?fixedDpr={asked.dpr}' if asked.dpr else ''}"
    print(line if asked.no_browser else f"{line} | {in_browser(address, asked)}", flush=True)
    viewer.stop()
    thread.join(timeout=10)


def in_browser(address: str, asked: argparse.Namespace) -> str:
    """What a headless Chromium makes of a page while it plays."""
    from playwright.sync_api import sync_playwright

    path = shutil.which("chromium") or shutil.which("google-chrome")
    width, height = map(int, asked.size.split("x"))
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, headless=True, args=FLAGS.split())
        page = browser.new_page(viewport={"width": width, "height": height})
        page.add_init_script(COUNT)
        page.goto(address)
        page.get_by_role("button", name="Pause").wait_for(timeout=120_000)
        page.wait_for_function(f"window.drawn.frames > {asked.warm}", timeout=300_000)
        tools = page.context.new_cdp_session(page)
        tools.send("Performance.enable")

        def now() -> dict[str, float]:
            numbers = {each["name"]: each["value"] for each in tools.send("Performance.getMetrics")["metrics"]}
            count = page.evaluate("({...window.drawn})")
            used = processes()
            return {
                **count,
                "script": numbers["ScriptDuration"],
                "heap": numbers["JSHeapUsedSize"] / 1e6,
                "draw": used.get("gpu-process", (0.0, 0.0))[0],
                "page": used.get("renderer", (0.0, 0.0))[1],
                "at": time.perf_counter(),
            }

        begin = now()
        page.wait_for_timeout(1000 * asked.seconds)
        end = now()
        browser.close()
    spent = {name: end[name] - begin[name] for name in end}
    frames = max(spent["frames"], 1.0)
    triangles, script, draw = (spent[name] / frames for name in ("triangles", "script", "draw"))
    return (
        f"{frames / spent['at']:7.1f} {triangles / 1e3:11.1f} {spent['calls'] / frames:5.0f} "
        f"{1e3 * script:9.1f} {1e3 * draw:7.0f} {end['heap']:9.0f} {end['page']:7.0f}"
    )


def processes() -> dict[str, tuple[float, float]]:
    """CPU seconds and megabytes of Chromium's processes under this one, by type."""
    parents, found = {}, {}
    for path in Path("/proc").glob("[0-9]*"):
        try:
            fields = (path / "stat").read_text().rpartition(")")[2].split()
            command = (path / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            pages = int((path / "statm").read_text().split()[1])
        except (OSError, IndexError):
            continue
        parents[int(path.name)] = int(fields[1])
        kind = next((word[7:] for word in command.split() if word.startswith("--type=")), "")
        cpu = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
        found[int(path.name)] = (kind, cpu, pages * os.sysconf("SC_PAGE_SIZE") / 1e6)
    total: dict[str, tuple[float, float]] = {}
    for process, (kind, cpu, megabytes) in found.items():
        above = process
        while above in parents and above != os.getpid():
            above = parents[above]
        if above == os.getpid():
            before = total.get(kind, (0.0, 0.0))
            total[kind] = (before[0] + cpu, before[1] + megabytes)
    return total


if __name__ == "__main__":
    main()
