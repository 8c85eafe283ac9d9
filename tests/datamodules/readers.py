"""What the tests of all readers do: joints of a recording by hand, and files that are damaged in many ways."""

from __future__ import annotations

import importlib
import pickle
import re
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magnet.body.joints import PARENTS
from magnet.datamodules import registry
from magnet.datamodules.fakes.motion import rest_joints
from magnet.datamodules.reading.recording import DataError, Reader, Recording, Take

DO = re.compile(
    r"\b(ask|check|choose|confirm|convert|copy|cut|do not use|download|export|fetch|give|is it|leave|lower|make|mend|"
    r"move|name|prepare|put|rename|run|save|take|unpack|wait|write)\b"
)
"""What somebody is told to do, in the words of our messages."""


def told_what_to_do(error: Exception) -> str:
    """The error's text, which must say what to do."""
    assert DO.search(str(error)), f"does not say what to do: {error}"
    return str(error)


def named_and_told(error: Exception, root: Path) -> None:
    """The error names a file or folder of the download, and says what to do."""
    assert str(root) in told_what_to_do(error), f"names no file: {error}"


def fake_of(name: str) -> ModuleType:
    """The module that writes a data set's fake."""
    return importlib.import_module(registry.reader(name).fake)


def world_joints(recording: Recording, family: str) -> NDArray:
    """Joints (T, P, 22, 3) by a plain loop over the made-up body: pelvis (or transl + J0), then bone by bone."""
    place = recording.transl if recording.pelvis is None else recording.pelvis
    poses, place, betas = (np.asarray(a, np.float64) for a in (recording.poses, place, recording.betas))
    rest = rest_joints(betas, "smpl" if family == "smpl" else "smplx")
    joints = np.zeros(poses.shape)
    for p in range(poses.shape[1]):
        turn: list[Rotation] = []
        for j, parent in enumerate(PARENTS):
            local = Rotation.from_rotvec(poses[:, p, j])
            turn.append(local if parent < 0 else turn[parent] * local)
            if parent < 0:
                joints[:, p, j] = place[:, p] + (rest[p, j] if recording.pelvis is None else 0.0)
            else:
                joints[:, p, j] = joints[:, p, parent] + turn[parent].apply(rest[p, j] - rest[p, parent])
    return joints


def refused(reader: Reader, match: str, take: Take | None = None) -> None:
    """Reading fails with a message of ours that names a place under the reader's root and what to do."""
    take = take or reader.takes()[0]
    with pytest.raises(DataError, match=match) as caught:
        reader.read(take)
    assert str(reader.root) in str(caught.value)
    assert len(str(caught.value)) < 1000


def check_damaged(
    reader: Reader, damage: Callable[[Path], Any], match: str, of: Callable[[Take], Path] = lambda take: take.files[0]
) -> None:
    """The first take, damaged, is refused with what was found, and the second is read."""
    one, two, *_ = reader.takes()
    frames = reader.read(two).frames
    damage(of(one))
    one = next((take for take in reader.takes() if take.name == one.name), one)  # its files may be others now
    refused(reader, match, one)
    assert reader.read(two).frames == frames


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
