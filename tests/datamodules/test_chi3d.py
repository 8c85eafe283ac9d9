"""CHI3D's files to recordings."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magnet.datamodules.chi3d import CHI3DReader
from magnet.datamodules.reading.recording import DataError
from tests.cases import few
from tests.datamodules.readers import check_damaged, cut


@pytest.fixture
def root(tmp_path: Path) -> Path:
    CHI3DReader.write_fake(tmp_path, 2, 6)
    return tmp_path


def test_a_pair_is_held_out_because_the_official_test_is_not_given_out(tmp_path: Path) -> None:
    CHI3DReader.write_fake(tmp_path, 6, 2)
    takes = CHI3DReader(tmp_path).takes()
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
        held = json.loads(path.read_text(encoding="utf-8"))
        changed = what(held)
        path.write_text(json.dumps(held if changed is None else changed), encoding="utf-8")

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
    "one person": (array("transl", lambda a: a[0]), r"transl: got shape \(10, 3\)"),
    "unequal lengths": (array("transl", lambda a: a[:, :4]), r"unequal numbers of frames"),
    "ragged": (change(lambda held: held["transl"][0].pop() and None), r"transl: rows of unequal length"),
    "zero frames": (array("transl", lambda a: a[:, :0]), r"transl: got shape \(2, 0\)"),
    "wrong shape": (array("body_pose", lambda a: a[:, :, :20]), r"body_pose: got shape \(2, 10, 20, 3, 3\)"),
    "axis-angle": (array("body_pose", lambda a: a[..., 0]), r"body_pose: got shape \(2, 10, 21, 3\)"),
    "NaN": (array("transl", lambda a: np.where(a == a.max(), np.nan, a)), r"transl: \d+ of 60 numbers are NaN"),
    "no rotation": (array("body_pose", lambda a: a * 1.1), r"420 of 420 matrices are no rotations"),
    "mirrored": (array("global_orient", lambda a: -a), r"20 of 20 matrices are no rotations"),
    "text": (change(lambda held: held.update(transl="here")), r"expected numbers"),
    "null": (change(lambda held: held.update(transl=None)), r"expected numbers"),
}


@pytest.mark.parametrize("how", few(DAMAGED, 5))
def test_damaged_takes_are_refused_and_others_read(how: str, root: Path) -> None:
    check_damaged(CHI3DReader(root), *DAMAGED[how])
