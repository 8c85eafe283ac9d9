"""Hi4D's files to recordings."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magnet.datamodules.hi4d import Hi4DReader
from magnet.datamodules.reading.recording import DataError
from tests.datamodules.readers import Foreign, check_damaged, cut


@pytest.fixture
def root(tmp_path: Path) -> Path:
    Hi4DReader.write_fake(tmp_path, 2, 6)
    return tmp_path


def test_whole_pairs_are_held_out(tmp_path: Path) -> None:
    Hi4DReader.write_fake(tmp_path, 6, 2)
    takes = Hi4DReader(tmp_path).takes()
    assert {take.name.split("_")[0] for take in takes if take.split == "test"} == {"pair28"}
    mine = Hi4DReader(tmp_path, test_pairs=(0,), val_pairs=(1,)).takes()
    assert {take.split for take in mine if take.name.startswith("pair00_")} == {"test"}
    with pytest.raises(ValueError, match=r"pairs \[3\] are in both"):
        Hi4DReader(tmp_path, test_pairs=(3,), val_pairs=(3,))


def test_a_folder_without_pairs_says_what_it_holds(root: Path) -> None:
    with pytest.raises(DataError, match=r"no folder pairXX; it holds dance00"):
        Hi4DReader(root / "pair00")


def frame(change: Callable[[dict[str, Any]], Any], name: str = "smpl/000013.npz") -> Callable[[Path], None]:
    def damage(action: Path) -> None:
        with np.load(action / name, allow_pickle=True) as file:
            held = dict(file)
        change(held)
        np.savez(action / name, **held)

    return damage


def meta(**changes: Any) -> Callable[[Path], None]:
    return frame(lambda held: held.update(changes), "meta.npz")


def test_frames_whose_numbers_have_no_leading_zeros_are_in_order(root: Path) -> None:
    reader = Hi4DReader(root)
    action = next(reader.root.glob("pair*/*"))
    before = reader.read(reader.found()[0])
    for path in sorted((action / "smpl").glob("*.npz")):
        path.rename(path.with_stem(str(int(path.stem) - 3)))  # 8 to 13
    meta(start=8, end=13)(action)
    after = reader.read(reader.found()[0])
    assert np.array_equal(after.transl, before.transl)


DAMAGED: dict[str, tuple[Callable[[Path], Any], str]] = {
    "truncated": (lambda action: cut(action / "smpl/000013.npz"), r"000013\.npz: not an npz archive"),
    "empty": (lambda action: (action / "smpl/000013.npz").write_bytes(b""), r"000013\.npz: not an npz archive"),
    "npy for npz": (lambda action: np.save((action / "smpl/000013.npz").open("wb"), np.zeros(3)), r"000013\.npz"),
    "foreign code": (frame(lambda held: held.update(transl=np.array(Foreign(), dtype=object))), r"000013\.npz"),
    "frame missing": (
        lambda action: (action / "smpl/000013.npz").unlink(),
        r"frame 13 is missing, but meta.npz says 11",
    ),
    "first missing": (lambda action: (action / "smpl/000011.npz").unlink(), r"5 frames from 12 to 16, but"),
    "not a number": (lambda action: (action / "smpl/x.npz").touch(), r"x\.npz is no frame number"),
    "no frames": (lambda action: [path.unlink() for path in (action / "smpl").iterdir()], r"no frames 000XXX"),
    "no folder": (lambda action: (action / "smpl").rename(action / "smplx"), r"no frames 000XXX"),
    "no meta": (lambda action: (action / "meta.npz").unlink(), r"meta\.npz: no such file"),
    "truncated meta": (lambda action: cut(action / "meta.npz"), r"meta\.npz: not an npz archive"),
    "meta lacks": (frame(lambda held: held.pop("end"), "meta.npz"), r"meta\.npz: lacks end"),
    "other end": (meta(end=40), r"frames from 11 to 16, but meta\.npz says 11 to 40"),
    "broken start": (meta(start=1.5), r"start is 1\.5, expected a whole number"),
    "start a list": (meta(start=[1, 2]), r"start: got shape \(2,\)"),
    "one person": (meta(num_persons=1), r"num_persons is 1, expected 2"),
    "no betas": (frame(lambda held: held.pop("betas")), r"000013\.npz: lacks betas"),
    "no partner": (frame(lambda held: held.update(transl=held["transl"][:1])), r"the partner is missing"),
    "flat partner": (frame(lambda held: held.update(transl=held["transl"][0])), r"the partner is missing"),
    "NaN": (frame(lambda held: held["transl"].__setitem__((0, 0), np.nan)), r"transl: 1 of 6 .* NaN"),
    "wrong shape": (frame(lambda held: held.update(body_pose=np.zeros((2, 63)))), r"body_pose: got shape \(2, 63\)"),
    "text": (frame(lambda held: held.update(transl=np.array(["a"]))), r"expected numbers"),
}


@pytest.mark.parametrize("how", DAMAGED)
def test_damaged_takes_are_refused_and_others_read(how: str, root: Path) -> None:
    check_damaged(Hi4DReader(root), *DAMAGED[how], of=lambda take: take.files[0].parent)


def test_an_end_past_the_last_frame_is_noted(root: Path) -> None:
    meta(end=17)(root / "pair00" / "dance00")
    reader = Hi4DReader(root)
    assert "one past the last frame" in reader.read(reader.takes()[0]).notes[0]
    assert reader.read(reader.takes()[1]).notes == ()


def test_pickled_genders_do_no_harm(root: Path) -> None:
    meta(genders=np.array(["male", None], dtype=object))(root / "pair00" / "dance00")
    reader = Hi4DReader(root)
    assert reader.read(reader.takes()[0]).frames == 6


def test_a_shape_that_changes_is_noted(root: Path) -> None:
    frame(lambda held: held.update(betas=held["betas"] + 0.5))(root / "pair00" / "dance00")
    reader = Hi4DReader(root)
    assert any("shape varies by 0.5" in note for note in reader.read(reader.takes()[0]).notes)
