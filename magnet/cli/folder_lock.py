"""A training has its folder to itself, and so has a report: what is there, running or finished, is not overwritten."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Iterator
from pathlib import Path

from magnet.cli.errors import CommandError
from magnet.cli.kept_checkpoints import newest
from magnet.cli.run_folder import first_process, started_by_lightning
from magnet.files import Taken, alone

LOCK = ".training.lock"


@contextlib.contextmanager
def held(folder: Path, what: str = "training") -> Iterator[None]:
    """Hold the folder's lock meanwhile; other processes of the same training leave it to the first one.

    The lock goes with the process, however it ends. Where no lock can be had, the work is done without: a folder that
    cannot be written is told of later, and some network file systems have no locks.

    Args:
        folder: made if missing.
        what: works there, for the message.
    """
    if not first_process():
        yield
        return
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    with contextlib.ExitStack() as lock:
        lock.callback(_leave, made)  # called last of all
        with contextlib.suppress(OSError, NotImplementedError):
            folder.mkdir(parents=True, exist_ok=True)
            try:
                lock.enter_context(alone(folder / LOCK, ""))
                for half in (folder / "checkpoints").glob(".new-*"):  # of a process that was killed as it wrote
                    half.unlink()
            except Taken as error:
                lock.pop_all()
                raise CommandError(
                    f"another {what} is working in {folder}; wait for it, or choose another --out"
                ) from error
        yield


def _leave(made: list[Path]) -> None:
    """Remove folders that nothing came into."""
    for each in made:
        with contextlib.suppress(OSError):
            each.rmdir()


def refuse_overwriting(folder: Path) -> None:
    """Refuse a new training where one has been."""
    place = folder / "checkpoints"
    if not place.exists() or started_by_lightning():
        return
    if (place / "last.ckpt").exists():
        advice = "choose another --out, or go on with --ckpt_path last"
    elif there := newest(place):
        advice = f"choose another --out, or go on with --ckpt_path {shlex.quote(str(there))}"
    else:
        advice = "none of its checkpoints is left, so choose another --out"
    raise CommandError(f"{folder} holds a training run already: {advice}")
