"""Files that are whole or not there, disks that are full, archives that promise too much."""

from __future__ import annotations

import errno
import hashlib
import os
import re
import resource
import stat
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from magnet import checkpoints, files
from magnet.body import load_body
from magnet.evaluation.benchmark import Benchmark
from magnet.evaluation.submission import Submission
from magnet.export import save_bvh, save_csv, save_glb, save_smplx
from magnet.export.motion import NotebookView
from magnet.export.npz import read_smplx
from magnet.export.trace import DenoisingTrace
from magnet.files import (
    CannotWrite,
    alone,
    inside,
    load_npz,
    npz_path,
    regular,
    require_place,
    whole,
    write_text,
    write_whole,
    writing,
)
from magnet.motion.scene import Scene
from magnet.testing import random_scene
from magnet.viewer.reading import read_takes

HERE = "choose another --out"


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_names_the_path_what_is_free_and_what_to_do(code: int, tmp_path: Path) -> None:
    said = rf"store: the disk is full \([\d,.]+ MiB are free\): free some space, or {HERE}$"
    with pytest.raises(CannotWrite, match=said) as caught, writing(tmp_path / "new/store", HERE):
        raise OSError(code, os.strerror(code))
    assert caught.value.errno == code


def test_a_place_that_takes_no_files_is_named_and_other_errors_stay_as_they_are(tmp_path: Path) -> None:
    for code in (errno.EROFS, errno.EACCES):
        with pytest.raises(CannotWrite, match=rf"store: cannot be written .*{HERE}"), writing(tmp_path / "store", HERE):
            raise OSError(code, os.strerror(code), str(tmp_path / "store/.new"))
    for other in (PermissionError(errno.EACCES, "no", "/download/take"), FileNotFoundError(errno.ENOENT, "no", "x")):
        with pytest.raises(OSError) as caught, writing(tmp_path / "store", HERE):
            raise other
        assert caught.value is other


def test_a_place_is_known_before_there_is_anything_to_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    require_place(tmp_path / "new" / "folder" / "file")
    assert not list(tmp_path.iterdir())
    monkeypatch.setattr("os.access", lambda *_: False)
    with pytest.raises(CannotWrite, match=r"file: .* may not be written to; give yourself the right to"):
        require_place(tmp_path / "new" / "file")


def test_a_folder_that_the_system_does_not_make_is_known_before_there_is_anything_to_write(tmp_path: Path) -> None:
    if not Path("/proc/self").exists():
        pytest.skip("no /proc here")
    for path in ("/proc/nowhere/file.npz", "/proc/file.npz"):
        with pytest.raises(CannotWrite, match=rf"^{path}: /proc\S* cannot .+; choose another place$") as caught:
            require_place(path)
        assert "Errno" not in str(caught.value)


@pytest.mark.parametrize("name, path", [("a", "a.npz"), ("a.npz", "a.npz"), ("a.NPZ", "a.NPZ"), ("b.c/a", "b.c/a.npz")])
def test_an_npz_has_its_suffix(name: str, path: str) -> None:
    assert npz_path(name, "") == Path(path)


def test_an_npz_has_no_other_suffix() -> None:
    with pytest.raises(ValueError, match=r"a\.glb: got suffix \.glb, expected \.npz or none; use x"):
        npz_path("b/a.glb", "use x")


def test_a_real_full_device_is_told_as_such() -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    with pytest.raises(CannotWrite, match=r"/dev/full: the disk is full"), writing("/dev/full", HERE):
        Path("/dev/full").write_bytes(b"1" * 10)


def test_a_file_is_whole_and_its_hash_is_that_of_its_bytes(tmp_path: Path) -> None:
    seen: list[str] = []
    name, digest = write_whole(tmp_path, lambda digest: digest[:8], lambda out: out.write(b"whole"), seen.append)
    assert digest == hashlib.sha256(b"whole").hexdigest() and seen == [digest]
    assert [path.name for path in tmp_path.iterdir()] == [name] and (tmp_path / name).read_bytes() == b"whole"


def test_nothing_is_left_of_a_file_that_did_not_fit_and_the_old_one_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a").write_bytes(b"old")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    def hidden(out: files.HashedFile) -> None:  # as torch does, which raises an error of its own
        try:
            out.write(b"new")
        except OSError:
            raise RuntimeError("file write failed") from None

    for fails in ("fsync", "replace"):
        monkeypatch.setattr(os, fails, full)
        with pytest.raises(CannotWrite, match="the disk is full"):
            write_whole(tmp_path, lambda _: "a", lambda out: out.write(b"new"))
        monkeypatch.undo()
    monkeypatch.setattr(files.HashedFile, "write", _failing(files.HashedFile.write))
    with pytest.raises(CannotWrite, match="the disk is full"):
        write_whole(tmp_path, lambda _: "a", hidden)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"a": b"old"}


def _failing(write):  # type: ignore[no-untyped-def]
    def begin(self: files.HashedFile, data: bytes) -> int:
        os.dup2(os.open("/dev/full", os.O_WRONLY), self.file.fileno())
        self.file = self.file.raw  # type: ignore[attr-defined]
        return write(self, data)

    return begin


def test_a_network_file_system_that_syncs_no_folders_and_has_no_locks_is_written_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fcntl, fsync = pytest.importorskip("fcntl"), os.fsync

    def files_alone(handle: int) -> None:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(errno.EINVAL, "Invalid argument")
        fsync(handle)

    def none(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(os, "fsync", files_alone)
    monkeypatch.setattr(fcntl, "flock", none)
    with alone(tmp_path / "lock", "taken"):
        assert write_whole(tmp_path, "a", b"new")[0] == "a"
    assert (tmp_path / "a").read_bytes() == b"new"


def test_a_refused_file_is_told_of_by_the_folder_that_it_belongs_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    refused = OSError(errno.EROFS, "Read-only file system", str(tmp_path / "out" / ".prepare" / "lock"))
    with (
        pytest.raises(CannotWrite, match="cannot be written"),
        writing("../out", "choose another --out"),
    ):
        raise refused


def test_a_file_takes_its_place_when_it_is_whole(tmp_path: Path) -> None:
    kept = write_text(tmp_path / "new" / "a.txt", "before")
    kept.chmod(0o640)
    link = tmp_path / "link.txt"
    link.symlink_to(kept)
    with pytest.raises(KeyboardInterrupt), whole(link) as part:
        assert part.suffix == ".txt" and part.parent == kept.parent
        part.write_text("half")
        raise KeyboardInterrupt
    assert kept.read_text() == "before" and [path.name for path in kept.parent.iterdir()] == ["a.txt"]
    assert write_text(link, "after") == link and link.is_symlink()
    assert kept.read_text() == "after" and kept.stat().st_mode & 0o777 == 0o640
    (tmp_path / "plain").touch()
    assert write_text(tmp_path / "other", "").stat().st_mode == (tmp_path / "plain").stat().st_mode


@pytest.mark.parametrize("umask", [0o022, 0o077])
def test_files_are_for_whom_the_umask_lets(umask: int, tmp_path: Path) -> None:
    before = os.umask(umask)
    try:
        write_whole(tmp_path, "whole", b"")
        write_text(tmp_path / "text", "")
        checkpoints.write({"state_dict": {"weight": torch.zeros(1)}}, tmp_path / "model")
    finally:
        os.umask(before)
    written = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert len(written) == 4 and {path.stat().st_mode & 0o777 for path in written} == {0o666 & ~umask}


def test_what_is_no_plain_file_is_written_as_it_is() -> None:
    with whole("/dev/null") as part:
        assert part == Path("/dev/null")


def test_a_pipe_that_a_path_leads_to_is_written_as_it_is() -> None:
    if not Path("/dev/fd").is_dir():
        pytest.skip("no /dev/fd here")
    read_end, write_end = os.pipe()
    try:
        assert write_text(f"/dev/fd/{write_end}", "text") == Path(f"/dev/fd/{write_end}")  # as /dev/stdout behind a |
        assert os.read(read_end, 99) == b"text"
    finally:
        os.close(read_end)
        os.close(write_end)


def test_a_file_that_is_protected_against_writing_is_not_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    there = write_text(tmp_path / "a", "before")
    monkeypatch.setattr("os.access", lambda path, _: Path(path) != there)  # chmod would not stop an administrator
    with whole(there) as part:
        assert part == there  # which the system refuses to open


def test_a_refused_file_is_told_by_the_name_that_was_asked_for(tmp_path: Path) -> None:
    with pytest.raises(CannotWrite, match=r"a\.txt: cannot be written \(") as caught, whole(tmp_path / "a.txt") as part:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(part))
    assert ".part" not in str(caught.value)
    with pytest.raises(FileNotFoundError) as other, whole(tmp_path / "a.txt"):
        raise FileNotFoundError(errno.ENOENT, "no", "model.npz")
    assert other.value.filename == "model.npz"


def test_a_file_in_a_folder_that_takes_no_other_is_still_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    there = write_text(tmp_path / "a", "before")
    monkeypatch.setattr("os.access", lambda *_: False)
    with whole(there) as part:
        assert part == there


# -- reading -----------------------------------------------------------------------------------


def test_links_are_followed_and_what_would_never_end_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    (tmp_path / "link").symlink_to(tmp_path / "file")
    (tmp_path / "nowhere").symlink_to(tmp_path / "gone")
    (tmp_path / "zero").symlink_to("/dev/zero")
    os.mkfifo(tmp_path / "pipe")
    assert regular(tmp_path / "link").read_text() == "x"
    with pytest.raises(FileNotFoundError):
        regular(tmp_path / "nowhere")
    for name, what in (("zero", "a device"), ("pipe", "a pipe"), (".", "a folder")):
        with pytest.raises(ValueError, match=f"is .*{what}.*, expected a file"):
            regular(tmp_path / name)


@pytest.mark.parametrize("name", ["../a", "/etc/passwd", "a/b", "..", "", ".", "a\0", 7, None, "a\\b"])
def test_no_index_leads_out_of_its_folder(name: object, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="expected the name of a file in it; make it anew"):
        inside(tmp_path, name)
    assert inside(tmp_path, "a.npy") == tmp_path / "a.npy"


def bomb(path: Path, mib: int) -> Path:
    """An npz of a few kilobytes a MiB whose array of zeros unpacks to so many, written without holding them."""
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({mib * 2**18},), }}".ljust(117) + "\n"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("poses.npy", "w") as member:
        member.write(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode())
        for _ in range(mib):
            member.write(bytes(2**20))
    return path


def test_a_bomb_is_refused_before_memory_is_taken(tmp_path: Path) -> None:
    path = bomb(tmp_path / "bomb.npz", 300)
    assert path.stat().st_size < 2**20
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match=r"bomb\.npz: 'poses' would unpack from .* to 300 MiB, .*do not use the file"):
        load_npz(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50 * 1024  # KiB
    assert load_npz(path, ("other",)).files == ["poses"]  # which nobody reads


def test_arrays_of_any_size_that_hold_something_are_read(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    held = {"even": np.zeros(2**22), "odd": random.normal(size=2**16)}  # 32 MiB of zeros
    np.savez_compressed(tmp_path / "held.npz", **held)  # type: ignore[arg-type]
    with load_npz(tmp_path / "held.npz") as file:
        assert all(np.array_equal(file[key], value) for key, value in held.items())
    for array in (np.arange(2**23), np.zeros(2**24, dtype=np.uint8)):  # 64 MiB of numbers; packed not at all
        np.savez(tmp_path / "plain.npz", array=array)
        assert load_npz(tmp_path / "plain.npz")["array"].nbytes == array.nbytes


def damaged(path: Path, how: str) -> Path:
    """An npz with all of its arrays damaged in one way."""
    data = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        names, places = archive.namelist(), [member.header_offset for member in archive.infolist()]
    entries = [match.start() for match in re.finditer(b"PK\x01\x02", data)]  # of the list of members at its end
    if how == "cut short":
        del data[len(data) // 2 :]
    elif how == "without a part":
        del data[60:90]
    elif how == "of another sum":
        for entry in entries:
            data[entry + 16] ^= 0xFF
    elif how == "locked":
        for entry in entries:
            data[entry + 8] |= 1
    elif how == "packed otherwise":
        for place in places:
            begin = place + 30 + sum(struct.unpack_from("<HH", data, place + 26))
            data[begin : begin + 8] = b"\xff" * 8
    path.write_bytes(data)
    heads = {
        "of no type": "{'descr': (\n",
        "of no size": f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({10**20},)}}\n",
    }
    if how in heads:
        with zipfile.ZipFile(path, "w") as archive:
            for name in names:
                head = heads[how].encode()
                archive.writestr(name, np.lib.format.magic(1, 0) + struct.pack("<H", len(head)) + head)
    return path


READERS: dict[str, Callable[[Path], object]] = {
    "scene": Scene.load,
    "trace": DenoisingTrace.load,
    "npz": lambda path: read_smplx(path, load_body("open"), in_fps=30.0),
    "submission": lambda path: Submission.load(path, Benchmark.read()),
    "body": load_body,
    "view": lambda path: read_takes([path]),
}


@pytest.mark.parametrize(
    "how", ["cut short", "without a part", "of another sum", "locked", "packed otherwise", "of no type", "of no size"]
)
@pytest.mark.parametrize("kind", READERS)
def test_a_damaged_npz_is_told_as_one_by_whoever_reads_it(kind: str, how: str, tmp_path: Path) -> None:
    written = written_by_each(tmp_path)
    scene = random_scene(1, 8, 1, torch.Generator().manual_seed(0))
    np.savez_compressed(tmp_path / "body.npz", v_template=np.random.default_rng(0).normal(size=(50, 3)))
    written |= {"scene": scene.save(tmp_path / "scene.npz"), "body": tmp_path / "body.npz", "view": written["trace"]}
    with pytest.raises(ValueError, match=re.escape(written[kind].name)):
        READERS[kind](damaged(written[kind], how))


@pytest.mark.parametrize("meta", ["5", '{"format": "later", "recording": "later"}'])
@pytest.mark.parametrize("kind", ["scene", "trace", "view"])
def test_an_npz_that_says_something_strange_of_itself_is_refused(kind: str, meta: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "strange.npz", meta=np.array(meta))
    with pytest.raises(ValueError, match=r"strange\.npz"):
        READERS[kind](tmp_path / "strange.npz")


NAME = "my.model.v2"


def written_by_each(folder: Path) -> dict[str, Path]:
    """What each writer makes of a name with points, by its suffix; all but those that need other programs."""
    generator = torch.Generator().manual_seed(0)
    scene, body = random_scene(1, 8, 1, generator), load_body("open")
    window = scene.slice(0, 4)
    trace = DenoisingTrace(scene, torch.zeros(1, 2, 1, dtype=torch.int16), torch.zeros(1, dtype=torch.long), window)
    joints = torch.zeros(1, 1, 4, 1, 22, 3)
    return {
        "trace": trace.save(folder / NAME),
        "submission": Submission("b", "t", "m", ("one",), joints).save(folder / "1" / NAME, 30.0),
        "npz": save_smplx(scene, folder / "2" / NAME, body)[0],
        "csv": save_csv(scene, folder / NAME, body),
        "glb": save_glb(scene, folder / NAME, body),
        "bvh": save_bvh(scene, folder / NAME, body)[0],
        "page": NotebookView(b"", ".html").save(folder / NAME),
    }


def test_a_name_keeps_what_stands_behind_its_points(tmp_path: Path) -> None:
    written = written_by_each(tmp_path)
    assert [path.name for path in written.values()] == [
        f"{NAME}{suffix}" for suffix in (".npz", ".npz", ".npz", ".csv", ".glb", ".bvh", ".html")
    ]
    assert all(path.is_file() for path in written.values())
