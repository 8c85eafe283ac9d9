"""CHI3D's files to recordings."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magnet.datamodules.chi3d import CHI3D, CHI3DReader
from magnet.datamodules.common import to_clips
from magnet.datamodules.fakes.chi3d import write
from magnet.datamodules.fakes.motion import made_up_body
from magnet.datamodules.recording import DataError

from .reading import check_round_trip, check_splits, check_wrong_units, cut, refused


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write(tmp_path, 2, 6)
    return tmp_path


def test_reading_gives_what_was_written(tmp_path: Path) -> None:
    check_round_trip("chi3d", tmp_path, frames=10)


def test_a_pair_is_held_out_because_the_official_test_is_not_given_out(tmp_path: Path) -> None:
    takes = check_splits("chi3d", tmp_path)
    assert {take.name.split("_")[0] for take in takes if take.split == "test"} == {"s03"}
    mine = CHI3DReader(tmp_path, test_pairs=("s02",)).takes()
    assert {take.name.split("_")[0] for take in mine if take.split == "test"} == {"s02"}


def test_motion_in_the_test_folder_is_for_testing(root: Path) -> None:
    (root / "chi3d" / "train" / "s02").rename(root / "chi3d" / "test" / "s05")
    assert next(take for take in CHI3DReader(root).takes() if "s05" in take.name).split == "test"


def test_the_root_may_be_the_folder_itself(root: Path) -> None:
    assert len(CHI3DReader(root / "chi3d").takes()) == 2
    with pytest.raises(DataError, match=r"no train/sXX/smplx; it holds s02/, s04/"):
        CHI3DReader(root / "chi3d" / "train")


def change(what: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    def damage(path: Path) -> None:
        held = json.loads(path.read_text())
        changed = what(held)
        path.write_text(json.dumps(held if changed is None else changed))

    return damage


def array(key: str, what: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    return change(lambda held: held.update({key: what(np.array(held[key])).tolist()}))


DAMAGED: dict[str, tuple[Callable[[Path], Any], str]] = {
    "truncated": (cut, r"not a json file"),
    "empty": (lambda path: path.write_bytes(b""), r"not a json file"),
    "no text": (lambda path: path.write_bytes(b"\xff\xfe\x00"), r"not a json file"),
    "too deep": (lambda path: path.write_text("[" * 100_000), r"not a json file"),
    "gone": (lambda path: path.unlink(), r"no such file"),
    "a list": (change(lambda held: [held]), r"holds a list"),
    "no betas": (change(lambda held: held.__delitem__("betas")), r"lacks betas"),
    "missing partner": (array("transl", lambda a: a[:1]), r"transl of one person: the partner is missing"),
    "one person": (array("transl", lambda a: a[0]), r"transl: got shape \(6, 3\)"),
    "unequal lengths": (array("transl", lambda a: a[:, :4]), r"unequal numbers of frames"),
    "ragged": (change(lambda held: held["transl"][0].pop() and None), r"transl: rows of unequal length"),
    "zero frames": (array("transl", lambda a: a[:, :0]), r"transl: got shape \(2, 0\)"),
    "wrong shape": (array("body_pose", lambda a: a[:, :, :20]), r"body_pose: got shape \(2, 6, 20, 3, 3\)"),
    "axis-angle": (array("body_pose", lambda a: a[..., 0]), r"body_pose: got shape \(2, 6, 21, 3\)"),
    "NaN": (array("transl", lambda a: np.where(a == a.max(), np.nan, a)), r"transl: \d+ of 36 numbers are NaN"),
    "no rotation": (array("body_pose", lambda a: a * 1.1), r"252 of 252 matrices are no rotations"),
    "mirrored": (array("global_orient", lambda a: -a), r"12 of 12 matrices are no rotations"),
    "text": (change(lambda held: held.update(transl="here")), r"expected numbers"),
    "null": (change(lambda held: held.update(transl=None)), r"expected numbers"),
}


@pytest.mark.parametrize("how", DAMAGED)
def test_damaged_takes_are_refused_and_others_read(how: str, root: Path) -> None:
    damage, match = DAMAGED[how]
    reader = CHI3DReader(root)
    one, two = reader.takes()
    damage(one.files[0])
    refused(reader, match, one)
    assert reader.read(two).frames == 6


def test_clips_stand_upright_at_30_fps(tmp_path: Path) -> None:
    write(tmp_path, 1, 125)
    reader = CHI3DReader(tmp_path)
    (take,) = reader.takes()
    (clip,) = to_clips(reader.read(take), made_up_body(), take.name, reader.name, "train", reader.family).clips
    assert clip.frames == 75
    assert float(clip.scene.T_world_root[..., 1, 3].min()) > 0.6


def test_a_wrong_axis_unit_or_rate_is_named(tmp_path: Path) -> None:
    check_wrong_units("chi3d", tmp_path)


def test_its_data_module_reads_its_stores() -> None:
    assert CHI3D(path="x").reader is CHI3DReader
