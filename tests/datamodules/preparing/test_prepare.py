"""`prepare`: the same bytes whatever happens on the way, nothing half-written, bad takes listed."""

from __future__ import annotations

import json
import multiprocessing
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch

from magnet.datamodules import registry
from magnet.datamodules.preparing import convert
from magnet.datamodules.preparing import pack as prepare_pack
from magnet.datamodules.preparing.canonicalize import CanonicalizeOptions
from magnet.datamodules.preparing.check import check_store
from magnet.datamodules.preparing.convert import PrepareJob
from magnet.datamodules.preparing.prepare import prepare, read_splits
from magnet.datamodules.reading.recording import DataError
from magnet.datamodules.store.reader import STATE, StoreReader
from tests.cases import few, some_slow
from tests.datamodules import made

pytestmark = pytest.mark.usefixtures("known")


@pytest.fixture
def order(tmp_path) -> PrepareJob:
    return PrepareJob(made.NAME, str(tmp_path / "dl"), {}, str(made.write(tmp_path / "dl")), CanonicalizeOptions())


@pytest.fixture(scope="module")
def whole(known, tmp_path_factory) -> dict[str, bytes]:
    """The store of the same download elsewhere."""
    root = tmp_path_factory.mktemp("whole")
    job = PrepareJob(made.NAME, str(root / "dl"), {}, str(made.write(root / "dl")), CanonicalizeOptions())
    prepare(job, root / "store", shard_rows=700)
    return content(root / "store")


def content(store: Path) -> dict[str, bytes]:
    """Every byte of a store, but not what a later prepare goes on from."""
    return {path.name: path.read_bytes() for path in store.iterdir() if path.name != STATE}


@pytest.fixture(scope="module")
def couples(tmp_path_factory) -> PrepareJob:
    """A fake that worker processes know, too."""
    root = tmp_path_factory.mktemp("couples")
    registry.reader("chi3d").write_fake(root, takes=5, frames=60)
    return PrepareJob("chi3d", str(root), {}, str(root / "body.npz"), CanonicalizeOptions())


@pytest.fixture(scope="module")
def undisturbed(couples, tmp_path_factory) -> dict[str, bytes]:
    out = tmp_path_factory.mktemp("undisturbed") / "store"
    prepare(couples, out, shard_rows=200)
    return content(out)


def doomed(order: PrepareJob, out: Path, during: str, workers: int, reached: Path) -> None:
    """In a process that is going to be killed: stops after the second take, or half-way through the second file."""
    told: list[int] = []

    def stop() -> None:
        reached.touch()
        time.sleep(600)

    def tell(_: str, done: int, total: int) -> None:
        told.append(done)
        if during == "conversion" and len(told) == 3:
            stop()

    write, written = prepare_pack.write_whole, []

    def half(folder, name, put):
        def begin(file):
            file.write(b"half of it")
            file.file.flush()
            stop()

        written.append(name)
        return write(folder, name, begin if len(written) == 2 else put)

    prepare_pack.write_whole = half
    convert.ALONE = 0  # type: ignore[misc]  # others are started after the first take
    prepare(order, out, workers=workers, shard_rows=200, progress=tell)


def children(pid: int) -> list[Path]:
    """Processes that a process started, in /proc."""
    return [
        Path("/proc", child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="utf-8").split()
    ]


def until(true: Callable[[], bool], seconds: float = 500.0) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.02)


@pytest.mark.parametrize("workers", some_slow([1, 2], 2))
@pytest.mark.parametrize("during", some_slow(["conversion", "packing"], "packing"))
def test_a_killed_run_goes_on_and_gives_the_same_bytes(couples, undisturbed, tmp_path, during, workers):
    out, reached = tmp_path / "killed", tmp_path / "reached"
    process = multiprocessing.get_context("fork").Process(target=doomed, args=(couples, out, during, workers, reached))
    process.start()
    try:
        until(lambda: reached.exists() or not process.is_alive())
        started = children(process.pid)
    finally:
        process.kill()
        process.join()
    assert started or workers == 1 or during == "packing"
    until(lambda: not any(child.exists() for child in started))  # workers do not outlive who started them
    assert not (out / "manifest.json").exists()  # nothing that reads as a store
    left = {path.name.split("-")[0] for path in out.iterdir()}
    assert left == ({STATE} if during == "conversion" else {STATE, "train", ".new"})
    with pytest.raises(ValueError, match="a prepare that has not finished lies there"):
        StoreReader(out)
    again = prepare(couples, out, shard_rows=200)
    takes = len(couples.reader().takes())
    assert again.kept == takes or (during == "conversion" and again.kept)
    assert again.made + again.kept == takes
    assert content(out) == undisturbed


@pytest.mark.parametrize("dies_at", few(["first shard", "second shard", "index", "manifest"]))
def test_dying_while_the_store_is_written_leaves_the_old_one_whole(order, whole, tmp_path, monkeypatch, dies_at):
    prepare(order, tmp_path / "store", limit=1, shard_rows=700)
    before = content(tmp_path / "store")
    write, calls = prepare_pack.write_whole, []

    def dying(folder, name, put):
        calls.append(name if isinstance(name, str) else name("0" * 64))
        now = {"first shard": len(calls) == 1, "second shard": len(calls) == 2,
               "index": calls[-1].startswith("clips"), "manifest": calls[-1] == "manifest.json"}  # fmt: skip
        if now[dies_at]:
            raise KeyboardInterrupt
        return write(folder, name, put)

    monkeypatch.setattr(prepare_pack, "write_whole", dying)
    with pytest.raises(KeyboardInterrupt):
        prepare(order, tmp_path / "store", shard_rows=700)
    monkeypatch.undo()
    assert content(tmp_path / "store").items() >= before.items()
    assert not check_store(StoreReader(tmp_path / "store")).problems
    prepare(order, tmp_path / "store", shard_rows=700)
    assert content(tmp_path / "store") == whole


@pytest.mark.slow
def test_two_workers_write_the_bytes_of_one(couples, undisturbed, tmp_path, monkeypatch):
    monkeypatch.setattr(convert, "ALONE", 0)
    told: list[tuple[int, int]] = []
    prepare(
        couples, tmp_path / "2", workers=2, shard_rows=200, progress=lambda _, done, total: told.append((done, total))
    )
    assert content(tmp_path / "2") == undisturbed
    assert told == sorted(told) and told[-1][0] == told[-1][1] and len(told) == 1 + len(couples.reader().takes())


@pytest.mark.parametrize(("alone", "started"), [(600.0, 0), (0.0, 1)])
def test_other_processes_are_started_where_there_is_work_for_them(couples, tmp_path, monkeypatch, alone, started):
    """Each imports everything anew: of three short recordings that took longer than all the rest."""
    pools = []

    class Here(ThreadPoolExecutor):
        def __init__(self, count, mp_context, **begin):
            pools.append(count)
            super().__init__(1, **begin)

    monkeypatch.setattr(convert, "ALONE", alone)
    monkeypatch.setattr(convert, "ProcessPoolExecutor", Here)
    threads = torch.get_num_threads()
    assert prepare(couples, tmp_path / "store", workers=2).made == 5
    torch.set_num_threads(threads)  # one in each such process
    assert pools == [2] * started


def test_only_what_changed_is_made_again(order, tmp_path):
    out = tmp_path / "store"
    prepare(order, out)
    first = content(out)
    assert prepare(order, out).made == 0 and content(out) == first
    take = tmp_path / "dl/take1.txt"
    old = take.read_text()
    take.write_text("200 2 30.0 77")
    report = prepare(order, out)
    assert (report.made, report.kept) == (1, 4) and content(out) != first
    take.write_text(old)
    prepare(order, out)
    assert content(out) == first  # and nothing of the store in between is left
    shorter = PrepareJob(order.name, order.root, {}, order.body_file, CanonicalizeOptions(min_frames=31))
    assert prepare(shorter, out).made == 5  # an option changed: all of them
    with_fps = PrepareJob(order.name, order.root, {"fps": 31.0}, order.body_file, CanonicalizeOptions())
    assert prepare(with_fps, out).made == 5


def test_a_damaged_store_is_made_again(order, tmp_path):
    out = tmp_path / "store"
    prepare(order, out)
    first = content(out)
    next(out.glob("train-*")).write_bytes(b"rubbish")
    assert prepare(order, out).made == 5
    assert content(out) == first


def test_bad_takes_are_skipped_and_listed(order, tmp_path):
    (tmp_path / "dl/take0.txt").write_text("150 2")
    (tmp_path / "dl/take1.txt").write_text("20 2 30.0 1")
    folder = prepare(order, tmp_path / "store").folder
    skipped = {entry["take"]: entry["why"] for entry in folder.manifest["skipped"]}
    assert skipped.keys() == {"take0", "take1"}
    assert skipped["take0"].startswith("take0.txt: not enough values")  # and not the folder it lay in
    assert "no stretch of 30 frames" in skipped["take1"]
    assert folder.manifest["splits"]["train"]["takes"] == 1
    (tmp_path / "dl/take0.txt").write_text("150 2 30.0 0")
    again = prepare(order, tmp_path / "store")
    assert (again.made, again.failed) == (2, 1)  # what failed is always tried again


def test_nothing_usable_is_an_error_that_says_why(order, tmp_path):
    for path in (tmp_path / "dl").glob("*.txt"):
        path.write_text("broken")
    with pytest.raises(DataError, match=r"(?s)none of 5 takes could be used.*take0.*take4"):
        prepare(order, tmp_path / "store")
    for path in (tmp_path / "dl").glob("*.txt"):
        path.unlink()
    with pytest.raises(DataError, match="no takes under"):
        prepare(order, tmp_path / "store")


def test_a_manifest_tells_what_the_store_holds_and_nothing_of_the_machine(order, tmp_path):
    folder = prepare(order, tmp_path / "store").folder
    manifest = folder.manifest
    assert (manifest["name"], manifest["source"], manifest["licence"]) == (made.NAME, "https://example.org", "free")
    assert manifest["splits"]["train"] | {"shards": None} == {
        "takes": 3, "clips": 3, "frames": 150 + 160 + 170, "person frames": 2 * 480, "clips by people": {"2": 3},
        "shards": None,
    }  # fmt: skip
    text = (tmp_path / "store/manifest.json").read_text()
    assert str(tmp_path) not in text and os.uname().nodename not in text


def test_a_users_list_of_splits_replaces_the_rule(order, tmp_path):
    (tmp_path / "mine.txt").write_text("# mine\ntake0 test\ntake1\ttrain\ntake2   val\n")
    splits = read_splits(tmp_path / "mine.txt")
    folder = prepare(order, tmp_path / "store", splits=splits).folder
    assert [folder.split(split).name for split in ("train", "val", "test")] == [["take1"], ["take2"], ["take0"]]
    assert folder.manifest["left out"] == ["take3", "take4"]
    for text in ('{"take0": "test", "take1": "train", "take2": "val"}',
                 '{"test": ["take0"], "train": ["take1"], "val": ["take2"]}'):  # fmt: skip
        (tmp_path / "mine.json").write_text(text)
        assert read_splits(tmp_path / "mine.json") == splits
    for text, message in (("take0 dev", "take0 is in 'dev', expected one of train, val, test"),
                          ("take0", "line 1: got 'take0', expected NAME SPLIT"),
                          ('{"take0": "val"', "bad.txt: neither lines NAME SPLIT nor JSON"),
                          ("take0 val\ntake0 test", "in val and in test")):  # fmt: skip
        (tmp_path / "bad.txt").write_text(text)
        with pytest.raises(ValueError, match=message):
            read_splits(tmp_path / "bad.txt")
    with pytest.raises(ValueError, match="names no take of this download: it has other"):
        prepare(order, tmp_path / "store", splits={"other": "train"})
    with pytest.raises(ValueError, match="names no take of this download: it has no names"):
        prepare(order, tmp_path / "store", splits={})


def test_near_copies_never_stand_in_two_splits(order, tmp_path, monkeypatch):
    from dataclasses import replace

    found = made.MadeReader.found
    monkeypatch.setattr(made.MadeReader, "found", lambda self: [replace(t, group="all one") for t in found(self)])
    with pytest.raises(DataError, match="take3 is in val but take0 in train, and both belong to all one"):
        prepare(order, tmp_path / "store")


def test_strangers_folders_are_left_alone(order, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis.tex").write_text("years of work")
    with pytest.raises(ValueError, match="not empty and holds no store"):
        prepare(order, tmp_path / "mine")
    (tmp_path / "mine/manifest.json").write_text('[{"file": "thesis.tex"}]')
    with pytest.raises(ValueError, match="not empty and holds no store"):
        prepare(order, tmp_path / "mine")
    prepare(order, tmp_path / "store")
    manifest = json.loads((tmp_path / "store/manifest.json").read_text())
    (tmp_path / "store/manifest.json").write_text(json.dumps({**manifest, "name": "other", "title": "Other"}))
    with pytest.raises(ValueError, match="holds a store of Other"):
        prepare(order, tmp_path / "store")


def test_shape_numbers_without_their_body_are_refused_with_where_to_get_it(order, tmp_path):
    without = PrepareJob(order.name, order.root, {}, "open", CanonicalizeOptions())
    with pytest.raises(ValueError, match=r"--body FILE, from https://smpl-x\.is\.tue\.mpg\.de"):
        prepare(without, tmp_path / "store")


def test_only_one_prepare_works_in_a_folder(order, tmp_path):
    from magnet.datamodules.preparing.prepare import locked

    out = tmp_path / "store"
    (out / STATE).mkdir(parents=True)
    with locked(out / STATE), pytest.raises(OSError, match="another prepare is working"):
        prepare(order, out)
