"""Windows a second and memory: a prepared store by memory map against everything in memory.

    python benchmarks/data_throughput.py                              one million frames, every way
    python benchmarks/data_throughput.py --frames 10_000_000 --ways mapped    ten million, which need not fit
    python benchmarks/data_throughput.py --through prepare --workers 2     a made-up download, then magnet data prepare
    python benchmarks/data_throughput.py --fit_steps 20                also train a small tokenizer from it
    python benchmarks/data_throughput.py --store STORE --body FILE     a store that is there already

A frame is one person's. The store is made of walking people, repeated, in a folder that is removed at the end
(188 bytes a frame). With `--through prepare` it is made of files: eleven takes that the fake writer wrote, copied
under further names until there are enough of them (720 bytes a frame), every copy read and converted like any
other. Each way runs in a process of its own. `anonymous` is memory that cannot be given back
(RssAnon); pages of mapped files (RssFile) are the system's cache, which it takes back when it needs them.
"cold" starts after the files were dropped from that cache; "for a GPU" is what a CPU has left to do where a GPU
decodes. Windows a CPU second leave out what else the machine does. With `--step_ms 20` somebody takes a batch every
20 ms without using this CPU, as a GPU that computes so long would; `wait ms` is how long it waits for the next one.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

WAYS = ("mapped", "mapped cold", "for a GPU", "in memory")
COLUMNS = {
    "windows/s": 0,
    "windows/CPU s": 0,
    "wait ms": 1,
    "open s": 2,
    "first s": 2,
    "anonymous MiB": 0,
    "growth MiB": 0,
    "file MiB": 0,
}
"""What is measured, and decimals."""
SLICES = 5
"""Speeds are the medians of so many pieces of the time measured."""


def main() -> None:
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--frames", type=int, default=1_000_000, help="of one person each")
    words.add_argument("--ways", nargs="*", default=WAYS, choices=WAYS)
    words.add_argument("--batch_size", type=int, default=256)
    words.add_argument("--seconds", type=float, default=10.0, help="measured for each way")
    words.add_argument("--read_ahead", type=int, default=0, help="batches that threads read ahead")
    words.add_argument("--step_ms", type=float, default=0.0, help="pause after each batch")
    words.add_argument("--fit_steps", type=int, default=0, help="also train a small tokenizer for so many steps")
    words.add_argument("--device", default="cpu", help="where windows go, such as cuda")
    words.add_argument("--through", default="pack", choices=("pack", "prepare"), help="how the store is made")
    words.add_argument("--workers", type=int, default=2, help="of prepare")
    words.add_argument("--folder", default=None, help="where the temporary folder is made")
    words.add_argument("--keep", default=None, help="folder to keep the store in")
    words.add_argument("--store", default=None, help="measure this store, of the body --body, and make none")
    words.add_argument("--body", default=None, help="of --store; default: body.npz in it")
    words.add_argument("--measure", nargs=2, default=None, help=argparse.SUPPRESS)
    given = words.parse_args()
    if 0 < given.fit_steps < 4:
        words.error(f"--fit_steps {given.fit_steps}: the second half is timed, so it takes 4 or more")
    if given.measure:
        print(json.dumps(measure(given, given.measure[0], Path(given.measure[1]))))
        return
    with tempfile.TemporaryDirectory(dir=given.folder, prefix="throughput-") as folder:
        store = Path(given.keep) if given.keep else Path(folder) / "store"
        if given.store:
            store = Path(given.store)
        elif given.through == "prepare":
            through_prepare(Path(folder) / "download", store, given.frames, given.workers)
        else:
            make(store, given.frames)
        size = sum(path.stat().st_size for path in store.iterdir() if path.is_file())
        print(f"{rows(store):,} frames, {size / 2**30:.2f} GiB in {len(list(store.glob('train-*')))} shards")
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
    body = given.body or str(store / "body.npz")
    resident, ahead = way == "in memory", given.read_ahead
    data = Prepared(
        str(store), body_model=body, batch_size=given.batch_size, device_resident=resident, read_ahead=ahead
    )
    loader = data.train_dataloader()
    opened = time.perf_counter() - begin
    device = "meta" if way == "for a GPU" else given.device
    if device != "cpu":
        there: Any = data.store("train").to(device)
        frames, clearance = data.window_frames, data.augment.compose_clearance
        loader.fetch = lambda draw: there.fetch(draw, frames, clearance)
        loader.finish = (lambda rows: rows) if way == "for a GPU" else lambda rows: there.finish(rows, clearance)
    begin = time.perf_counter()
    batches = itertools.chain.from_iterable(itertools.repeat(loader))
    next(batches)
    first, early = time.perf_counter() - begin, memory()["RssAnon"]
    waits: list[float] = []
    speeds, per_cpu = zip(*(taken(batches, given, waits) for _ in range(SLICES)), strict=True)
    now = memory()
    found: dict[str, Any] = {
        "windows/s": statistics.median(speeds),
        "windows/CPU s": statistics.median(per_cpu),
        "wait ms": 1000 * statistics.median(waits),
        "first s": first,
        "open s": opened,
        "anonymous MiB": now["RssAnon"] - before,
        "growth MiB": now["RssAnon"] - early,
        "file MiB": now["RssFile"],
    }
    if given.fit_steps:
        found["fit"] = fit(data, given.fit_steps)
    return found


def taken(batches: Iterator[Any], given: argparse.Namespace, waits: list[float]) -> tuple[float, float]:
    """Windows a second and a CPU second over one piece of the time; notes how long each batch was waited for."""
    count, begin, busy = 0, time.perf_counter(), time.process_time()
    while time.perf_counter() - begin < given.seconds / SLICES:
        asked = time.perf_counter()
        batch = next(batches)
        if given.device != "cpu":
            import torch

            torch.cuda.synchronize()
        waits.append(time.perf_counter() - asked)
        count += len(batch.names)
        time.sleep(given.step_ms / 1000)
    return count / (time.perf_counter() - begin), count / (time.process_time() - busy)


def fit(data: Any, steps: int) -> str:
    """Train a small tokenizer; its memory that cannot be given back, over the steps, and windows a second."""
    import lightning as L

    from magnet.tokenizer import Tokenizer
    from magnet.tokenizer.options import AutoencoderOptions, QuantizerOptions

    seen: list[tuple[float, float]] = []

    class Watch(L.Callback):
        def on_train_batch_end(self, *_: Any) -> None:
            seen.append((time.perf_counter(), memory()["RssAnon"]))

    model = Tokenizer(AutoencoderOptions(width=32, depth=1), QuantizerOptions(codebook_dim=16, codebook_size=32))
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
    shown = [len(seen) * k // 8 for k in range(8)] + [len(seen) - 1]
    held = ", ".join(f"{seen[step][1]:,.0f} ({step + 1})" for step in sorted(set(shown)))
    return f"{speed:,.0f} windows/s; MiB after so many steps: {held}"


def memory() -> dict[str, float]:
    """MiB of this process by kind."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return {line.split(":")[0]: int(line.split()[1]) / 1024 for line in lines if line.startswith(("Rss", "Vm"))}


def rows(store: Path) -> int:
    """Frames of one person in a store."""
    manifest = json.loads((store / "manifest.json").read_text())
    return sum(split["person frames"] for split in manifest["splits"].values())


def through_prepare(download: Path, store: Path, frames: int, workers: int, take_frames: int = 3000) -> None:
    """A fake DD100 of so many frames, and `magnet data prepare` on it: nearly all of it to train on."""
    from magnet.datamodules.fakes import dd100

    begin = time.perf_counter()
    dd100.write_scenes(download, dd100.scenes(len(dd100.NAMES), take_frames, seed=0))
    folder = download / "data/motion/smplx/all"
    splits = {dd100.name(number): "train" for number in range(len(dd100.NAMES))}
    splits |= {dd100.name(1): "val", dd100.name(2): "test"}
    number = len(dd100.NAMES)
    while len(splits) * take_frames * 2 < frames:
        if splits[dd100.name(number % len(dd100.NAMES))] == "train":  # copies of the others would be near copies
            for role in ("00", "01"):
                written = folder / f"{dd100.name(number % len(dd100.NAMES))}_{role}.npy"
                shutil.copyfile(written, folder / f"{dd100.name(number)}_{role}.npy")
            splits[dd100.name(number)] = "train"
        number += 1
    (download / "splits.json").write_text(json.dumps(splits))
    size = sum(path.stat().st_size for path in folder.iterdir())
    print(f"{len(splits)} takes, {size / 2**30:.2f} GiB, written in {time.perf_counter() - begin:.0f} s", flush=True)
    body = download / "body.npz"
    words = ["--root", download, "--out", store, "--body", body, "--splits", download / "splits.json"]
    begin = time.perf_counter()
    command = [sys.executable, "-m", "magnet", "data", "prepare", "dd100", *words, "--workers", str(workers)]
    subprocess.run([str(word) for word in command], check=True)
    spent, used = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    busy = used.ru_utime + used.ru_stime
    shutil.copyfile(body, store / "body.npz")
    print(
        f"prepared by {workers} workers in {spent:.0f} s, {busy:.0f} CPU s: {rows(store) / busy:,.0f} frames a CPU "
        f"second; the largest process took {used.ru_maxrss / 1024:,.0f} MiB",
        flush=True,
    )


def make(store: Path, frames: int, clip_frames: int = 300, persons: int = 2) -> None:
    """A store of so many frames, written as `prepare` does, of few different clips in turn."""
    from magnet.datamodules.fakes.body import write_body
    from magnet.datamodules.fakes.motion import made_up_body, people
    from magnet.datamodules.preparing.canonicalize import canonicalize
    from magnet.datamodules.preparing.convert import ConvertedTake
    from magnet.datamodules.preparing.pack import PackSource, pack
    from magnet.datamodules.preparing.prepare import SHARD_ROWS
    from magnet.datamodules.reading.recording import Recording, Take
    from magnet.datamodules.store.reader import body_hash
    from magnet.datamodules.store.rows import encode

    body, parts = made_up_body(), []
    for seed in range(16):
        m = people(clip_frames, persons, seed=seed)
        recording = Recording(m.fps, m.up, poses=m.poses, transl=m.transl, betas=m.betas)
        (clip,) = canonicalize(recording, body, "walk", "walks", "train").clips
        betas = clip.scene.betas[0].numpy()
        parts.append(ConvertedTake(None, (), ("walk",), (clip_frames,), (persons,), betas, encode(clip.scene)))

    @dataclass(frozen=True)
    class Walk(PackSource):
        number: int = 0

        def load(self, old: Any, rows: bool = True) -> ConvertedTake:
            part = replace(parts[self.number % len(parts)], names=(self.take.name,))
            return part if rows else part.without_rows()

    begin = time.perf_counter()
    takes = [Take(f"walk{i:06d}", (), "train") for i in range(-(-frames // (clip_frames * persons)))]
    facts = {
        "name": "walks", "title": "Walks", "source": "made up", "licence": "none", "family": "smplx",
        "body": {"id": body.id, "sha256": body_hash(body)}, "options": {}, "splits by": "nothing", "left out": [],
    }  # fmt: skip
    store.mkdir()
    pack([Walk(take, Path(), None, number=i) for i, take in enumerate(takes)], None, store, facts, SHARD_ROWS)
    write_body(store / "body.npz")
    print(f"written in {time.perf_counter() - begin:.1f} s")


if __name__ == "__main__":
    main()
