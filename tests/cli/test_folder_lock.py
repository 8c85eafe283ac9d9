"""Two trainings in one folder."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from filelock import BaseFileLock

from magnet import cli
from magnet.cli import folder_lock
from magnet.files import Taken, alone
from tests.toys import ToyModel

FIT = ["fit", "--model", "ToyModel", "--data", "ToyData", "--trainer.max_steps", "1", "--out", "two"]
FIT += ["--trainer.accelerator", "cpu", "--trainer.enable_progress_bar", "false"]
HOLDS = """
import sys
from filelock import FileLock
lock = FileLock(sys.argv[1])
lock.acquire()
print("held", flush=True)
input()
"""


def test_a_second_training_in_a_folder_is_refused_while_the_first_one_works(
    toy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lock = toy / "two" / folder_lock.LOCK
    lock.parent.mkdir()
    with subprocess.Popen(
        [sys.executable, "-c", HOLDS, str(lock)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        assert other.stdout is not None and other.stdout.readline()
        assert cli.main(FIT) == 2
        told = capsys.readouterr().err.splitlines()[-1]
        assert told == "magnet fit: error: another training is working in two; wait for it, or choose another --out"
        assert [path.name for path in (toy / "two").iterdir()] == [folder_lock.LOCK]
        other.communicate(b"\n")
    assert cli.main(FIT) == 0
    assert not lock.exists()
    assert cli.main([*FIT[:6], "2", "--ckpt_path", "last", *FIT[7:]]) == 0, "the lock went with the first training"


def test_the_lock_is_held_while_training_and_by_the_first_process_alone(
    toy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []
    monkeypatch.setattr(
        ToyModel, "on_train_start", lambda self: seen.append((toy / "two" / folder_lock.LOCK).exists()), raising=False
    )
    assert cli.main(FIT) == 0 and seen == [True]
    monkeypatch.setenv("LOCAL_RANK", "1")
    with alone(toy / folder_lock.LOCK, "taken"), folder_lock.held(toy):
        pass
    monkeypatch.delenv("LOCAL_RANK")
    with folder_lock.held(toy / "never" / "began"):
        assert (toy / "never" / "began").is_dir()
    assert not (toy / "never").exists()


def test_the_locks_file_goes_while_the_lock_is_held(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Removed later, it may be one that another training holds by then, beside which a third one would be let in."""
    seen, release = [], BaseFileLock.release

    def watched(self: BaseFileLock, *words: bool) -> None:
        if self.is_locked:
            seen.append(Path(self.lock_file).exists())
        release(self, *words)

    monkeypatch.setattr(BaseFileLock, "release", watched)
    with folder_lock.held(tmp_path / "two"):
        assert (tmp_path / "two" / folder_lock.LOCK).exists()
    # Windows removes no file that is open: there filelock removes it as it lets go.
    assert seen == [os.name == "nt"] and not (tmp_path / "two").exists()


def test_a_lock_whose_file_is_removed_meanwhile_is_not_had(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its last holder removed it between this process's opening it and locking it."""
    fcntl = pytest.importorskip("fcntl")
    flock, lock = fcntl.flock, tmp_path / folder_lock.LOCK

    def late(fd: int, how: int) -> None:
        if how & fcntl.LOCK_EX:
            lock.unlink(missing_ok=True)
        flock(fd, how)

    monkeypatch.setattr(fcntl, "flock", late)
    with pytest.raises(Taken, match="taken"), alone(lock, "taken"):
        pass


def test_a_training_runs_without_a_lock_where_there_are_none(toy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*_: object) -> None:
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr(folder_lock, "alone", none)
    assert cli.main(FIT) == 0


@pytest.mark.parametrize(
    ("there", "advice"),
    [
        (["last.ckpt", "best.ckpt"], "choose another --out, or go on with --ckpt_path last"),
        (["best.ckpt"], "choose another --out, or go on with --ckpt_path two/checkpoints/best.ckpt"),
        ([], "none of its checkpoints is left, so choose another --out"),
    ],
)
def test_a_training_that_was_there_before_goes_on_with_a_checkpoint_that_is_there(
    there: list[str], advice: str, toy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = toy / "two" / "checkpoints"
    place.mkdir(parents=True)
    for name in there:
        (place / name).touch()
    assert cli.main(FIT) == 2
    assert capsys.readouterr().err.splitlines()[-1].endswith(f"two holds a training run already: {advice}")


def test_half_a_checkpoint_of_a_killed_training_is_gone_once_it_goes_on(toy: Path) -> None:
    assert cli.main(FIT) == 0
    half = toy / "two" / "checkpoints" / ".new-half"
    half.touch()
    assert cli.main([*FIT, "--trainer.max_steps", "2", "--ckpt_path", "last"]) == 0
    assert not half.exists()
