"""What the tests of all readers do: joints of a recording by hand, and files that are damaged in many ways."""

from __future__ import annotations

import importlib
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magnet.body.base import PARENTS
from magnet.datamodules.catalogue import NAMES
from magnet.datamodules.common import to_clips
from magnet.datamodules.fakes.motion import made_up_body, rest_joints
from magnet.datamodules.recording import DataError, Reader, Recording, Take


def fake_of(name: str) -> ModuleType:
    """The module that writes a data set's fake."""
    return importlib.import_module(NAMES[name].fake.split(":")[0])


def world_joints(recording: Recording, family: str) -> NDArray:
    """Joints (T, P, 22, 3) by a plain loop over the made-up body: pelvis = transl + J0, then bone by bone."""
    poses, transl, betas = (np.asarray(a, np.float64) for a in (recording.poses, recording.transl, recording.betas))
    rest = rest_joints(betas, "smpl" if family == "smpl" else "smplx")
    joints = np.zeros(poses.shape)
    for p in range(poses.shape[1]):
        turn: list[Rotation] = []
        for j, parent in enumerate(PARENTS):
            local = Rotation.from_rotvec(poses[:, p, j])
            turn.append(local if parent < 0 else turn[parent] * local)
            above = transl[:, p] if parent < 0 else joints[:, p, parent]
            bone = rest[p, j] - (0 if parent < 0 else rest[p, parent])
            joints[:, p, j] = above + (np.tile(bone, (len(poses), 1)) if parent < 0 else turn[parent].apply(bone))
    return joints


def check_round_trip(name: str, out: Path, takes: int = 5, frames: int = 20) -> list[Recording]:
    """Write the fake, read it, compare; in the order of takes."""
    NAMES[name].load_fake()(out, takes, frames, seed=3)
    written = fake_of(name).scenes(takes, frames, 3)
    reader = NAMES[name].load_reader()(out)
    found = reader.takes()
    assert sorted(take.name for take in found) == sorted(written)
    recordings = []
    for take in found:
        recording, motion = reader.read(take), written[take.name]
        assert (recording.fps, recording.up) == (motion.fps, motion.up)
        assert recording.poses is not None and recording.poses.shape == motion.poses.shape
        np.testing.assert_allclose(world_joints(recording, reader.family), motion.positions, atol=1e-5)
        np.testing.assert_allclose(recording.betas, motion.betas, atol=1e-6)
        assert len(recording.persons) == motion.poses.shape[1]
        assert all(path.is_file() for path in take.files)
        recordings.append(recording)
    return recordings


def check_splits(name: str, out: Path, takes: int = 12) -> list[Take]:
    """Every split has takes, no group stands in two, names are unique, and it is the same a second time."""
    NAMES[name].load_fake()(out, takes, 2, seed=0)
    found = NAMES[name].load_reader()(out).takes()
    assert {take.split for take in found} == {"train", "val", "test"}
    assert len({take.name for take in found}) == takes
    assert len({(take.group, take.split) for take in found}) == len({take.group for take in found})
    assert NAMES[name].load_reader()(out).takes() == found
    return found


def refused(reader: Reader, match: str, take: Take | None = None) -> None:
    """Reading fails with a message of ours that names a place under the reader's root and what to do."""
    take = take or reader.takes()[0]
    with pytest.raises(DataError, match=match) as caught:
        reader.read(take)
    assert str(reader.root) in str(caught.value)
    assert len(str(caught.value)) < 1000


WRONG: dict[str, tuple[Callable[[Recording], dict[str, Any]], str]] = {
    "up axis": (lambda r: {"up": "+z" if r.up == "+y" else "+y"}, r"the declared up axis is .* but people stand along"),
    "millimetres": (lambda r: {"transl": r.transl * 1000}, r"look like .*millimetres, expected metres"),
    "degrees": (lambda r: {"poses": np.rad2deg(r.poses)}, r"look like degrees"),
    "four times the rate": (
        lambda r: {"fps": 4 * r.fps},
        r"too fast for people; perhaps 30 frames a second are called",
    ),
    "a quarter of the rate": (lambda r: {"fps": r.fps / 4}, r"too slow for people; perhaps 120 frames a second"),
}


def check_wrong_units(name: str, out: Path, frames: int = 400) -> None:
    """What a reader gives, told with another axis, unit or rate, is refused with what is wrong."""
    NAMES[name].load_fake()(out, 1, frames)
    reader = NAMES[name].load_reader()(out)
    (take,) = reader.takes()
    recording = reader.read(take)
    body = made_up_body("smpl" if reader.family == "smpl" else "smplx")
    assert to_clips(recording, body, take.name, name, "train", reader.family).clips
    for change, match in WRONG.values():
        with pytest.raises(DataError, match=match):
            to_clips(replace(recording, **change(recording)), body, take.name, name, "train", reader.family)


def rewritten(path: Path, change: Callable[[Any], Any]) -> None:
    """A pickle's contents through `change`."""
    held = pickle.loads(path.read_bytes())
    changed = change(held)
    path.write_bytes(pickle.dumps(held if changed is None else changed))


def cut(path: Path, share: float = 0.5) -> None:
    """Leave only the beginning of a file."""
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])


class Foreign:
    """Pickles of it would run code when loaded."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (print, ("code of a stranger has run",))
