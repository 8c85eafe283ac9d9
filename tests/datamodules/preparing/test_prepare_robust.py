"""`prepare` where others work in the folder too, where the disk is full, and where nothing may be written."""

from __future__ import annotations

import errno
import json
import multiprocessing
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from multiprocessing.synchronize import Barrier
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from magnet import cli, files
from magnet.datamodules.preparing import convert
from magnet.datamodules.preparing.canonicalize import CanonicalizeOptions
from magnet.datamodules.preparing.check import check_store
from magnet.datamodules.preparing.convert import PrepareJob
from magnet.datamodules.preparing.prepare import prepare
from magnet.datamodules.reading.recording import Take
from magnet.datamodules.store.reader import MANIFEST, STATE, StoreReader
from tests.cases import few, some_slow
from tests.datamodules import made

pytestmark = pytest.mark.usefixtures("known")
FORK = multiprocessing.get_context("fork")
BUSY = "another prepare is working in "


@pytest.fixture
def order(tmp_path: Path) -> PrepareJob:
    return PrepareJob(made.NAME, str(tmp_path / "dl"), {}, str(made.write(tmp_path / "dl")), CanonicalizeOptions())


def content(store: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in store.iterdir() if path.name != STATE}


@pytest.fixture(scope="module")
def alone(known: None, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What one process makes of the same download elsewhere."""
    root = tmp_path_factory.mktemp("alone")
    order = PrepareJob(made.NAME, str(root / "dl"), {}, str(made.write(root / "dl")), CanonicalizeOptions())
    prepare(order, root / "store", shard_rows=700)
    return content(root / "store")


# -- two at once -------------------------------------------------------------------------------


def ended(order: PrepareJob, out: Path, outcome: Any, before: Callable[[], object], tell: Any = None) -> None:
    """In a process of its own: how a prepare ended."""
    before()
    try:
        report = prepare(order, out, shard_rows=700, progress=tell)
    except OSError as error:
        outcome.put(str(error))
    else:
        outcome.put((report.made, report.kept))


def test_a_second_prepare_says_that_another_works_there_and_the_first_ends_well(
    order: PrepareJob, alone: dict[str, bytes], tmp_path: Path
) -> None:
    begun, go_on = FORK.Event(), FORK.Event()

    def tell(_: str, done: int, total: int) -> None:
        if done and not begun.is_set():  # in the midst of its takes
            begun.set()
            assert go_on.wait(60)

    out, outcome = tmp_path / "store", FORK.SimpleQueue()
    first = FORK.Process(target=ended, args=(order, out, outcome, lambda: None, tell))
    first.start()
    try:
        assert begun.wait(60)
        second = FORK.Process(target=ended, args=(order, out, outcome, lambda: None))
        second.start()
        second.join(60)
        assert outcome.get() == f"{BUSY}{out}; wait for it, or choose another --out"
    finally:
        go_on.set()
        first.join(60)
    assert outcome.get() == (5, 0)
    assert content(out) == alone and prepare(order, out, shard_rows=700).made == 0


@pytest.mark.parametrize("there", some_slow(["nothing", "a store", "another store"], "nothing", "a store"))
def test_prepares_that_race_leave_the_store_of_one(
    order: PrepareJob, alone: dict[str, bytes], tmp_path: Path, there: str
) -> None:
    out, outcome = tmp_path / "store", FORK.SimpleQueue()
    if there != "nothing":
        prepare(order, out, shard_rows=700, limit=None if there == "a store" else 1)
    start: Barrier = FORK.Barrier(3)
    racing = [FORK.Process(target=ended, args=(order, out, outcome, start.wait)) for _ in range(3)]
    for process in racing:
        process.start()
    for process in racing:
        process.join(120)
    ends = [outcome.get() for _ in racing]
    done = [end for end in ends if isinstance(end, tuple)]
    new = {"nothing": 5, "a store": 0, "another store": 2}[there]
    assert done and max(made for made, _ in done) == new  # whoever came after that kept all of it
    assert sum(made for made, _ in done) == new
    assert all(end.startswith(BUSY) for end in ends if isinstance(end, str))
    assert content(out) == alone and not check_store(StoreReader(out)).problems


def test_a_store_made_while_another_was_about_to_begin_is_gone_on_from(
    order: PrepareJob, alone: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from magnet.datamodules.preparing import prepare as module

    out, opened, calls = tmp_path / "store", module.opened, []

    def meanwhile(*words: Any) -> Any:
        found = opened(*words)
        calls.append(None)
        if len(calls) == 1:  # nothing was there; now another one makes it
            monkeypatch.setattr(module, "opened", opened)
            prepare(order, out, shard_rows=700)
        return found

    monkeypatch.setattr(module, "opened", meanwhile)
    assert prepare(order, out, shard_rows=700).made == 0
    assert content(out) == alone


# -- a full disk -------------------------------------------------------------------------------


def full_after(monkeypatch: pytest.MonkeyPatch, size: int) -> None:
    """The disk takes so many more bytes, half of the last write, and then no more, until `undo`."""
    left, write = [size], files.HashedFile.write

    def written(self: files.HashedFile, data: Any) -> int:
        data = bytes(data)
        left[0] -= len(data)
        if left[0] < 0:
            self.file.write(data[: len(data) // 2])
            self.file.flush()
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(self, data)

    monkeypatch.setattr(files.HashedFile, "write", written)


@pytest.mark.parametrize("share", few([0.0, 0.2, 0.45, 0.6, 0.8, 0.97, 0.999]))
def test_a_full_disk_is_told_with_what_to_do_and_the_same_command_goes_on(
    order: PrepareJob, alone: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, share: float
) -> None:
    out = tmp_path / "store"
    size = 2 * sum(map(len, alone.values()))  # parts, then the store
    full_after(monkeypatch, int(share * size))
    with pytest.raises(OSError, match=rf"{out}.*: the disk is full \(.* free\): .*then run the same command again"):
        prepare(order, out, shard_rows=700)
    monkeypatch.undo()
    left = [path.name for path in out.rglob("*")]
    assert MANIFEST not in left and not [name for name in left if name.startswith(".new")]
    again = prepare(order, out, shard_rows=700)
    assert again.kept == sum(name.endswith(".part") for name in left) and again.made + again.kept == 5
    assert content(out) == alone


def test_a_disk_that_fills_up_leaves_the_old_store_whole(
    order: PrepareJob, alone: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "store"
    prepare(order, out, shard_rows=700, limit=1)
    before = content(out)
    for size in (10, 100_000, 200_000, 300_000):
        full_after(monkeypatch, size)
        with pytest.raises(OSError, match="the disk is full"):
            prepare(order, out, shard_rows=700)
        monkeypatch.undo()
        assert content(out).items() >= before.items() and not check_store(StoreReader(out)).problems
    prepare(order, out, shard_rows=700)
    assert content(out) == alone


def test_the_command_line_says_it_in_a_line(
    order: PrepareJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    full_after(monkeypatch, 50_000)
    words = ["--root", order.root, "--out", str(tmp_path / "store"), "--body", order.body_file, "--workers", "1"]
    assert cli.main(["data", "prepare", made.NAME, *words]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1 and f"{tmp_path / 'store'}" in said[0] and "free some space, or choose another" in said[0]


# -- where nothing may be written --------------------------------------------------------------


@pytest.fixture
def nobody() -> Iterator[Path]:
    """A folder of somebody else's, and no right to write there: root may write anywhere, so it steps down."""
    folder = Path(tempfile.mkdtemp(prefix="magnet-readonly-"))
    folder.chmod(0o755)
    root = os.geteuid() == 0
    try:
        yield folder
    finally:
        if root:
            os.seteuid(0)
        for path in (folder, *folder.rglob("*")):
            path.chmod(0o755)
        shutil.rmtree(folder)


def step_down(folder: Path) -> None:
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)
    if os.geteuid() == 0:
        os.seteuid(65534)


def test_a_folder_that_may_not_be_written_to_is_named_and_what_to_do(order: PrepareJob, nobody: Path) -> None:
    shutil.copytree(order.root, nobody / "dl")
    order = PrepareJob(order.name, str(nobody / "dl"), {}, str(nobody / "dl/body.npz"), CanonicalizeOptions())
    prepare(order, nobody / "store", shard_rows=700)
    before = content(nobody / "store")
    step_down(nobody)
    for out in (nobody / "new", nobody / "a/b", nobody / "store"):
        with pytest.raises(OSError, match=rf"^{out}: cannot be written \(.*\): .*choose another --out"):
            prepare(order, out, shard_rows=700)
    assert content(nobody / "store") == before
    assert not check_store(StoreReader(nobody / "store")).problems  # it is read all the same
    batch = next(iter(made.data(nobody / "store").train_dataloader()))
    assert batch.T_world_root.isfinite().all()


def test_a_download_that_may_not_be_written_to_is_prepared(order: PrepareJob, nobody: Path, tmp_path: Path) -> None:
    shutil.copytree(order.root, nobody / "dl")
    order = PrepareJob(order.name, str(nobody / "dl"), {}, str(nobody / "dl/body.npz"), CanonicalizeOptions())
    out = Path(tempfile.mkdtemp(prefix="magnet-out-"))
    out.chmod(0o777)
    try:
        step_down(nobody)
        assert prepare(order, out / "store").made == 5
    finally:
        if os.getuid() == 0:
            os.seteuid(0)
        shutil.rmtree(out)


# -- links -------------------------------------------------------------------------------------


def test_links_in_a_download_are_followed_and_what_they_lead_to_decides(order: PrepareJob, tmp_path: Path) -> None:
    plain = prepare(order, tmp_path / "plain").folder
    (tmp_path / "dl").rename(tmp_path / "elsewhere")
    (tmp_path / "dl").mkdir()
    for path in (tmp_path / "elsewhere").iterdir():
        (tmp_path / "dl" / path.name).symlink_to(path)
    out = tmp_path / "store"
    prepare(order, out)
    assert content(out) == content(plain.path)
    (tmp_path / "elsewhere/take1.txt").write_text("200 2 30.0 77")
    (tmp_path / "elsewhere/take2.txt").unlink()  # its link leads nowhere
    report = prepare(order, out)
    assert (report.made, report.kept) == (2, 3)
    assert [entry["take"] for entry in report.folder.manifest["skipped"]] == ["take2"]


def test_a_stores_manifest_does_not_lead_out_of_it(order: PrepareJob, tmp_path: Path) -> None:
    out = tmp_path / "store"
    prepare(order, out)
    text = (out / MANIFEST).read_text()
    manifest = json.loads(text)
    for place in (manifest["clips"], manifest["betas"], manifest["splits"]["train"]["shards"][0]):
        for name in ("../dl/take0.txt", str(tmp_path / "dl/take0.txt")):
            (out / MANIFEST).write_text(text.replace(place["file"], name))
            with pytest.raises(ValueError, match=r"manifest\.json: damaged .*its index names.*prepare the store again"):
                StoreReader(out).files()
            with pytest.raises(ValueError, match="its index names"):
                StoreReader(out).clips("train")


# -- many takes --------------------------------------------------------------------------------


def calls_for(count: int, job: PrepareJob, monkeypatch: pytest.MonkeyPatch) -> int:
    """Functions that are called while so many takes are done, each after the one before it was looked at."""
    begun: list[Future[str]] = []

    class Work(Future[str]):
        def result(self, timeout: float | None = None) -> str:
            if begun:
                begun.pop().set_result("done")
            return super().result(timeout)

    def submit(convert_one: object, take: Take, path: None) -> Future[str]:
        work = Work()
        if take is takes[0]:
            work.set_result("done")
        else:
            begun.append(work)
        return work

    pool = SimpleNamespace(submit=submit, shutdown=lambda **_: None)
    monkeypatch.setattr(convert, "ProcessPoolExecutor", lambda *_, **__: pool)
    monkeypatch.setattr(convert, "convert", lambda *_: "done")
    monkeypatch.setattr(convert, "ALONE", 0)
    takes = [Take(f"take {number}", (), "train") for number in range(count)]
    calls: list[str] = []
    sys.setprofile(lambda frame, event, value: calls.append(event))
    try:
        assert sum(1 for _ in convert.convert_all(job, takes, lambda take: None, workers=2)) == count
    finally:
        sys.setprofile(None)
    return len(calls)


def test_twice_as_many_takes_are_twice_the_work_for_the_process_that_waits(
    order: PrepareJob, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert calls_for(160, order, monkeypatch) < 2.5 * calls_for(80, order, monkeypatch)
