"""Windows a second and memory: a prepared store by memory map against everything in memory.

    python benchmarks/data_throughput.py                              one million frames, both ways
    python benchmarks/data_throughput.py --frames 10_000_000 --ways mapped    ten million, which need not fit
    python benchmarks/data_throughput.py --fit_steps 20                also train a small tokenizer from it

A frame is one person's. The store is made of walking people, repeated, in a folder that is removed at the end
(188 bytes a frame). Each way runs in a process of its own. `anonymous` is memory that cannot be given back
(RssAnon); pages of mapped files (RssFile) are the system's cache, which it takes back when it needs them.
"cold" starts after the files were dropped from that cache. Windows a CPU second leave out what else the machine does.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

WAYS = ("mapped", "mapped cold", "in memory")
COLUMNS = {
    "windows/s": 0,
    "windows/CPU s": 0,
    "open s": 2,
    "first s": 2,
    "anonymous MiB": 0,
    "growth MiB": 0,
    "file MiB": 0,
}
"""What is measured, and decimals."""


def main() -> None:
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--frames", type=int, default=1_000_000, help="of one person each")
    words.add_argument("--ways", nargs="*", default=WAYS, choices=WAYS)
    words.add_argument("--batch_size", type=int, default=256)
    words.add_argument("--seconds", type=float, default=10.0, help="measured for each way")
    words.add_argument("--fit_steps", type=int, default=0, help="also train a small tokenizer for so many steps")
    words.add_argument("--device", default="cpu", help="where windows go, such as cuda")
    words.add_argument("--folder", default=None, help="for the store; default: a temporary one")
    words.add_argument("--measure", nargs=2, default=None, help=argparse.SUPPRESS)
    given = words.parse_args()
    if given.measure:
        print(json.dumps(measure(given, given.measure[0], Path(given.measure[1]))))
        return
    with tempfile.TemporaryDirectory(dir=given.folder, prefix="throughput-") as folder:
        store = make(Path(folder), given.frames)
        size = sum(path.stat().st_size for path in store.iterdir() if path.is_file())
        print(f"{given.frames:,} frames, {size / 2**30:.2f} GiB in {len(list(store.glob('train-*')))} shards")
        print(f"{'':<14}" + "".join(f"{head:>{len(head) + 3}}" for head in COLUMNS))
        for way in given.ways:
            again = [sys.executable, __file__, *sys.argv[1:], "--measure", way, str(store)]
            said = subprocess.run(again, check=True, stdout=subprocess.PIPE, text=True).stdout
            found = json.loads(said.splitlines()[-1])
            print(
                f"{way:<14}" + "".join(f"{found[head]:>{len(head) + 3},.{digits}f}" for head, digits in COLUMNS.items())
            )
            if "fit" in found:
                print(f"{'':<14}trained: {found['fit']}")


def measure(given: argparse.Namespace, way: str, store: Path) -> dict[str, Any]:
    """One way, in this process; memory over what an empty process with the same imports has."""
    import torch

    from magnet.datamodules.fakes.motion import made_up_body
    from magnet.datamodules.prepared import Prepared

    torch.set_num_threads(1)
    if way == "mapped cold":
        for path in store.glob("*.npy"):
            with path.open("rb") as file:
                os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    made_up_body()
    before = memory()["RssAnon"]
    begin = time.perf_counter()
    body = str(store / "body.npz")
    data = Prepared(str(store), body_model=body, batch_size=given.batch_size, device_resident=way == "in memory")
    loader = data.train_dataloader()
    opened = time.perf_counter() - begin
    if given.device != "cpu":
        stored = data.store("train", given.device)
        loader.gather = lambda draw: stored.gather(draw, data.window_frames, data.compose_clearance)
    batches = iter(loader)
    begin = time.perf_counter()
    next(batches)
    first = time.perf_counter() - begin
    early, count, begin, busy = memory()["RssAnon"], 0, time.perf_counter(), time.process_time()
    while time.perf_counter() - begin < given.seconds:
        batch = next(batches, None)
        if batch is None:
            batches = iter(loader)
            continue
        count += batch.scenes
    if given.device != "cpu":
        torch.cuda.synchronize()
    spent, busy = time.perf_counter() - begin, time.process_time() - busy
    now = memory()
    found: dict[str, Any] = {
        "windows/s": count / spent,
        "windows/CPU s": count / busy,
        "first s": first,
        "open s": opened,
        "anonymous MiB": now["RssAnon"] - before,
        "growth MiB": now["RssAnon"] - early,
        "file MiB": now["RssFile"],
    }
    if given.fit_steps:
        found["fit"] = fit(data, given.fit_steps)
    return found


def fit(data: Any, steps: int) -> str:
    """Train a small tokenizer; how much memory grows from the middle to the end, and windows a second."""
    import lightning as L

    from magnet.tokenizer import Tokenizer

    seen: list[tuple[float, float]] = []

    class Watch(L.Callback):
        def on_train_batch_end(self, *_: Any) -> None:
            seen.append((time.perf_counter(), memory()["RssAnon"]))

    model = Tokenizer(latent=16, hidden=32, codes=32, depth=1)
    quiet = {
        "logger": False,
        "enable_checkpointing": False,
        "enable_progress_bar": False,
        "enable_model_summary": False,
    }
    trainer = L.Trainer(
        max_steps=steps,
        accelerator="cpu",
        callbacks=[Watch()],
        limit_val_batches=0,
        **quiet,  # type: ignore[arg-type]
    )
    trainer.fit(model, data)
    half = seen[len(seen) // 2]
    speed = (len(seen) - 1 - len(seen) // 2) * data.batch_size / (seen[-1][0] - half[0])
    return f"{speed:,.0f} windows/s, memory grew by {seen[-1][1] - half[1]:.0f} MiB in the last {steps // 2} steps"


def memory() -> dict[str, float]:
    """MiB of this process by kind."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return {line.split(":")[0]: int(line.split()[1]) / 1024 for line in lines if line.startswith(("Rss", "Vm"))}


def make(folder: Path, frames: int, clip_frames: int = 300, persons: int = 2) -> Path:
    """A store of so many frames, written as `prepare` does, of few different clips in turn."""
    from magnet.datamodules.common import to_clips
    from magnet.datamodules.fakes.body import write_body
    from magnet.datamodules.fakes.motion import made_up_body, people
    from magnet.datamodules.prepare import SHARD_ROWS
    from magnet.datamodules.prepare_pack import Source, pack
    from magnet.datamodules.prepare_takes import Part
    from magnet.datamodules.recording import Recording, Take
    from magnet.datamodules.store import body_hash, encode

    body, parts = made_up_body(), []
    for seed in range(16):
        m = people(clip_frames, persons, seed=seed)
        recording = Recording(m.fps, m.up, poses=m.poses, transl=m.transl, betas=m.betas)
        (clip,) = to_clips(recording, body, "walk", "walks", "train").clips
        betas = clip.scene.betas[0].numpy()
        parts.append(Part(None, (), ("walk",), (clip_frames,), (persons,), betas, encode(clip.scene)))

    @dataclass(frozen=True)
    class Walk(Source):
        number: int = 0

        def head(self, old: Any) -> Part:
            return replace(self.whole(old), rows=parts[0].rows[:0])

        def whole(self, old: Any) -> Part:
            return replace(parts[self.number % len(parts)], names=(self.take.name,))

    begin = time.perf_counter()
    takes = [Take(f"walk{i:06d}", (), "train") for i in range(-(-frames // (clip_frames * persons)))]
    facts = {
        "name": "walks", "title": "Walks", "source": "made up", "licence": "none", "family": "smplx",
        "body": {"id": body.id, "sha256": body_hash(body)}, "options": {}, "splits by": "nothing", "left out": [],
    }  # fmt: skip
    store = folder / "store"
    store.mkdir()
    pack([Walk(take, Path(), None, number=i) for i, take in enumerate(takes)], None, store, facts, SHARD_ROWS)
    write_body(store / "body.npz")
    print(f"written in {time.perf_counter() - begin:.1f} s")
    return store


if __name__ == "__main__":
    main()
