"""AIOZ-GDANCE's files to recordings."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magnet.datamodules.aioz import AIOZ, AIOZReader
from magnet.datamodules.reading.recording import DataError
from tests.datamodules.readers import Foreign, check_damaged, cut, rewritten


@pytest.fixture
def root(tmp_path: Path) -> Path:
    AIOZReader.write_fake(tmp_path, 2, 12)
    return tmp_path


def test_everybody_has_the_mean_shape(root: Path) -> None:
    reader = AIOZReader(root)
    recording = reader.read(reader.takes()[1])
    assert recording.persons == ("dancer 1", "dancer 2", "dancer 3")
    assert not np.asarray(recording.betas).any() and "mean shape" in recording.notes[0]


def test_without_lists_a_video_is_in_one_split(tmp_path: Path) -> None:
    (tmp_path / "motions_smpl").mkdir()
    for video in range(60):
        for start in (0, 100):
            (tmp_path / "motions_smpl" / f"v{video}_{start}_{start + 90}.pkl").touch()
    takes = AIOZReader(tmp_path).takes()
    assert {take.split for take in takes} == {"train", "val", "test"}
    assert len({(take.name.split("_")[0], take.split) for take in takes}) == 60
    (tmp_path / "split_sequence_names.txt").write_text("v1_0_90,7\nv2_100_190.pkl\n")
    listed = {take.name: take.split for take in AIOZReader(tmp_path).takes() if take.split}
    assert set(listed) == {"v1_0_90", "v2_100_190"}
    assert all(take.split == listed[take.name] for take in takes if take.name in listed)


def test_a_folder_without_motions_says_what_it_holds(root: Path) -> None:
    with pytest.raises(DataError, match=r"no folder motions_smpl; it holds video0"):
        AIOZReader(root / "motions_smpl")


def change(what: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    return lambda path: rewritten(path, what)


DAMAGED: dict[str, tuple[Callable[[Path], Any], str]] = {
    "truncated": (cut, r"video000"),
    "empty": (lambda path: path.write_bytes(b""), r"video000"),
    "gone": (lambda path: path.unlink(), r"no such file"),
    "foreign code": (change(lambda held: {**held, "meta": Foreign()}), r"names (builtins|__builtin__)\.print"),
    "an array": (change(lambda held: held["smpl_poses"]), r"expected a dict"),
    "no poses": (change(lambda held: held.__delitem__("smpl_poses")), r"lacks smpl_poses"),
    "no trans": (change(lambda held: held.__delitem__("root_trans")), r"lacks root_trans"),
    "missing partner": (
        change(lambda held: held.update(smpl_poses=held["smpl_poses"][:1])),
        r"\(1, 12\) of smpl_poses",
    ),
    "unequal lengths": (
        change(lambda held: held.update(root_trans=held["root_trans"][:, :5])),
        r"\(2, 5\) of root_trans",
    ),
    "frames first": (
        change(lambda held: held.update({k: held[k].swapaxes(0, 1) for k in ("smpl_poses", "root_trans")})),
        r"would be 12 people, expected up to 7",
    ),
    "NaN": (change(lambda held: held["smpl_poses"].__setitem__((0, 3, 5), np.inf)), r"smpl_poses: 1 of .* infinite"),
    "zero frames": (change(lambda held: held.update(root_trans=np.zeros((2, 0, 3)))), r"no frames"),
    "flat": (change(lambda held: held.update(smpl_poses=np.zeros((12, 72)))), r"smpl_poses: got shape \(12, 72\)"),
    "odd width": (
        change(lambda held: held.update(smpl_poses=np.zeros((2, 12, 70)))),
        r"expected \(people, frames, 72\)",
    ),
    "odd roots": (
        change(lambda held: held.update(smpl_poses=np.zeros((2, 12, 63)), smpl_orients=np.zeros((2, 11, 3)))),
        r"smpl_orients: got shape \(2, 11, 3\)",
    ),
}


@pytest.mark.parametrize("how", DAMAGED)
def test_damaged_takes_are_refused_and_others_read(how: str, root: Path) -> None:
    check_damaged(AIOZReader(root), *DAMAGED[how])


@pytest.mark.parametrize("hands", [0, 6])
def test_roots_apart_from_poses_are_put_together(hands: int, root: Path) -> None:
    reader = AIOZReader(root)
    before = reader.read(reader.takes()[0])

    def apart(held: dict[str, Any]) -> None:
        poses = held["smpl_poses"]
        held.update(smpl_orients=poses[..., :3], smpl_poses=poses[..., 3 : 66 + hands])

    rewritten(reader.takes()[0].files[0], apart)
    np.testing.assert_array_equal(reader.read(reader.takes()[0]).poses, before.poses)  # type: ignore[arg-type]


def test_its_data_module_has_seven_slots() -> None:
    assert AIOZ().max_agents == 7
    assert AIOZ(max_agents=3, batch_size=8).max_agents == 3
