"""A made-up data set whose reader gives walking people, and ways of spoiling a recording."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from magnet.datamodules.clip import Split
from magnet.datamodules.fakes.body import write_body
from magnet.datamodules.fakes.motion import FakeMotion, people
from magnet.datamodules.prepared import Prepared
from magnet.datamodules.reading.recording import Axis, DataError, Reader, Recording, Take

NAME = "made"
SPLITS: tuple[Split, ...] = ("train", "train", "train", "val", "test")


class MadeReader(Reader):
    """Files NAME.txt that hold: frames, people, fps, seed.

    Args:
        root: their folder.
        fps: in place of the files'.
    """

    name, title, source, licence = NAME, "Made", "https://example.org", "free"

    def __init__(self, root: str | Path, fps: float | None = None) -> None:
        super().__init__(root)
        self.fps = fps

    def found(self) -> list[Take]:
        files = sorted(self.root.glob("*.txt"))
        return [Take(file.stem, (file,), SPLITS[i % len(SPLITS)]) for i, file in enumerate(files)]

    def read(self, take: Take) -> Recording:
        try:
            frames, persons, fps, seed = map(float, take.files[0].read_text().split())
        except ValueError as error:
            raise DataError(f"{take.files[0]}: {error}") from error
        return recorded(people(int(frames), int(persons), self.fps or fps, int(seed)))


class Made(Prepared):
    """Made."""

    reader: ClassVar[type[Reader]] = MadeReader


def write(root: Path, takes: int = 5, frames: int = 150, persons: int = 2, fps: float = 30.0, more: int = 10) -> Path:
    """A download of so many takes, each `more` frames longer, and a body beside it. Returns the body's path."""
    root.mkdir(parents=True, exist_ok=True)
    for i in range(takes):
        (root / f"take{i}.txt").write_text(f"{frames + more * i} {persons} {fps} {i}")
    return write_body(root / "body.npz")


def recorded(motion: FakeMotion) -> Recording:
    return Recording(motion.fps, motion.up, poses=motion.poses, transl=motion.transl, betas=motion.betas)


def tracked(motion: FakeMotion) -> Recording:
    return Recording(motion.fps, motion.up, positions=motion.positions, joints=tuple(range(22)))


def spoil_up(recording: Recording, to: Axis) -> Recording:
    return replace(recording, up=to)


def scaled(recording: Recording, by: float) -> Recording:
    if recording.transl is not None:
        return replace(recording, transl=recording.transl * by)
    assert recording.positions is not None
    return replace(recording, positions=recording.positions * by)


SPOILED: dict[str, tuple[Callable[[Recording], Recording], str]] = {
    "up axis": (lambda r: spoil_up(r, "+z" if r.up != "+z" else "-x"), "declared up axis is .*stand along "),
    "up axis reversed": (lambda r: spoil_up(r, ("-" if r.up[0] == "+" else "+") + r.up[1]), "stand along "),  # type: ignore[arg-type]
    "mm for m": (lambda r: scaled(r, 1000.0), "millimetres.*expected metres; convert"),
    "m for mm": (lambda r: scaled(r, 0.001), "too small.*; convert"),
    "120 for 30 fps": (lambda r: replace(r, fps=r.fps / 4), "120 frames a second are called 30"),
    "30 for 120 fps": (lambda r: replace(r, fps=r.fps * 4), "30 frames a second are called 120"),
}
"""What is done to a good recording, and what must be said of it."""


def in_degrees(recording: Recording) -> Recording:
    assert recording.poses is not None
    return replace(recording, poses=np.rad2deg(recording.poses))


def data(store: Path, **kwargs: Any) -> Made:
    """A store of it, with the body beside its download."""
    return Made(
        str(store), body_model=str(store.parent / "dl/body.npz"), **{"batch_size": 8, "epoch_size": 32, **kwargs}
    )
