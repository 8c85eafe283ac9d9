"""InterHuman's files to recordings."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magnet.datamodules.interhuman import InterHumanReader
from magnet.datamodules.reading.recording import DataError
from tests.datamodules.readers import Foreign, check_damaged, cut, rewritten


@pytest.fixture
def root(tmp_path: Path) -> Path:
    InterHumanReader.write_fake(tmp_path, 3, 6)
    return tmp_path


def test_people_are_known(root: Path) -> None:
    reader = InterHumanReader(root)
    recording = reader.read(reader.takes()[0])
    assert recording.persons == ("person1", "person2")


def test_splits_are_the_lists(tmp_path: Path) -> None:
    InterHumanReader.write_fake(tmp_path, 12, 2)
    takes = InterHumanReader(tmp_path).takes()
    assert [take.name for take in takes] == [str(k + 1) for k in range(12)]
    (tmp_path / "split" / "ignore_list.txt").write_text("1\n\n")
    (tmp_path / "split" / "val.txt").write_text("")
    splits = {take.name: take.split for take in InterHumanReader(tmp_path).takes() if take.name in ("1", "2")}
    assert splits == {"1": None, "2": None}


def test_a_name_in_two_lists_is_refused(root: Path) -> None:
    (root / "split" / "test.txt").write_text("1\n")
    with pytest.raises(DataError, match=r"1 is in the list of train too"):
        InterHumanReader(root).takes()


def test_lists_may_lie_beside_the_motions(root: Path) -> None:
    for path in (root / "split").iterdir():
        path.rename(root / path.name)
    assert InterHumanReader(root).takes()[0].split == "train"
    (root / "train.txt").unlink()
    with pytest.raises(DataError, match=r"no train\.txt; put the download's lists"):
        InterHumanReader(root).takes()


def test_a_folder_without_motions_says_what_it_holds(root: Path) -> None:
    (root / "motions").rename(root / "motions_processed")
    with pytest.raises(DataError, match=r"no folder motions .* it holds .*motions_processed"):
        InterHumanReader(root)


def first(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    return lambda path: rewritten(path, change)


DAMAGED: dict[str, tuple[Callable[[Path], Any], str]] = {
    "truncated": (cut, r"1\.pkl"),
    "empty": (lambda path: path.write_bytes(b""), r"1\.pkl"),
    "gone": (lambda path: path.unlink(), r"no such file"),
    "foreign code": (first(lambda held: {**held, "person1": Foreign()}), r"names (builtins|__builtin__)\.print"),
    "a list": (first(lambda held: [held]), r"expected a dict"),
    "no partner": (first(lambda held: held.__delitem__("person2")), r"partner person2 is missing"),
    "partner None": (first(lambda held: held.update(person1=None)), r"partner person1 is missing"),
    "partner a list": (first(lambda held: held.update(person1=[1])), r"person1: holds a list"),
    "no betas": (first(lambda held: held["person1"].__delitem__("betas")), r"person1: lacks betas"),
    "few betas": (first(lambda held: held["person1"].update(betas=np.zeros(6))), r"6 shape numbers"),
    "no trans": (first(lambda held: held["person2"].__delitem__("trans")), r"person2: lacks trans"),
    "NaN": (first(lambda held: held["person1"]["trans"].__setitem__((3, 1), np.nan)), r"trans: 1 of 36 .* NaN"),
    "unequal lengths": (
        first(
            lambda held: held["person1"].update(
                {k: held["person1"][k][:-1] for k in ("trans", "root_orient", "pose_body")}
            )
        ),
        r"unequal numbers of frames: person1 11, person2 12",
    ),
    "unequal keys": (first(lambda held: held["person1"].update(trans=np.zeros((5, 3)))), r"unequal numbers of frames"),
    "zero frames": (first(lambda held: held["person1"].update(trans=np.zeros((0, 3)))), r"no frames"),
    "wrong shape": (first(lambda held: held["person1"].update(pose_body=np.zeros((12, 69)))), r"\(12, 69\)"),
    "text": (first(lambda held: held["person1"].update(trans=np.array([["a"] * 3] * 12))), r"expected numbers"),
    "ragged": (first(lambda held: held["person1"].update(trans=[[1, 2, 3], [1, 2]])), r"unequal length"),
    "other rate": (first(lambda held: held.update(mocap_framerate=120.0)), r"mocap_framerate is 120, expected 59\.94"),
    "two rates": (first(lambda held: held.update(mocap_framerate=[1, 2])), r"mocap_framerate: got shape \(2,\)"),
    "other frames": (first(lambda held: held.update(frames=99)), r"says 99 frames"),
}


@pytest.mark.parametrize("how", DAMAGED)
def test_damaged_takes_are_refused_and_others_read(how: str, root: Path) -> None:
    check_damaged(InterHumanReader(root), *DAMAGED[how])


def test_a_rate_is_taken_when_the_user_says_so(root: Path) -> None:
    rewritten(root / "motions" / "1.pkl", lambda held: held.update(mocap_framerate=30.0))
    rewritten(root / "motions" / "2.pkl", lambda held: held.__delitem__("mocap_framerate"))
    reader = InterHumanReader(root, fps=30.0)
    assert reader.read(reader.takes()[0]).fps == 30.0
    assert "no frame rate" in reader.read(reader.takes()[1]).notes[0]


def test_joints_may_be_apart_and_shapes_once_a_frame(root: Path) -> None:
    reader = InterHumanReader(root)
    before = reader.read(reader.takes()[0])

    def change(held: dict[str, Any]) -> None:
        for person in ("person1", "person2"):
            held[person]["pose_body"] = held[person]["pose_body"].reshape(-1, 21, 3)
            held[person]["betas"] = np.tile(held[person]["betas"], (12, 1))

    rewritten(root / "motions" / "1.pkl", change)
    after = reader.read(reader.takes()[0])
    np.testing.assert_array_equal(after.poses, before.poses)  # type: ignore[arg-type]
    np.testing.assert_array_equal(after.betas, before.betas)  # type: ignore[arg-type]
