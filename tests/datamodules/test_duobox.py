"""The DuoBox reader against its fake."""

from __future__ import annotations

import pickle
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magnet.datamodules.duobox import FITS, MAP, SKELETONS, SKIPPED, DuoBoxReader
from magnet.datamodules.fakes import duobox as fake
from magnet.datamodules.reading.recording import DataError, Recording
from magnet.unpickle import load_object_npy
from tests.datamodules.readers import world_joints

TAKES, FRAMES = 2, 8
PARTS = ("tr0", "tr1", "tr2", "tr3", "va0", "te0")


def read(root: Path, part: str = "te0", number: int = 0, **options: Any) -> Recording:
    reader = DuoBoxReader(root, **options)
    return reader.read(next(take for take in reader.takes() if take.name == f"{fake.name(number)}_{part}"))


def changed(root: Path, folder: str, **fields: Any) -> None:
    """Overwrite keys of the first take's file; None removes a key."""
    path = root / folder / f"{fake.name(0)}.npy"
    held = load_object_npy(path) | fields
    np.save(path, {key: value for key, value in held.items() if value is not None}, allow_pickle=True)  # type: ignore[arg-type]


@pytest.mark.parametrize("part", PARTS)
def test_the_fit_is_read_back_to_its_motion(made: Path, part: str) -> None:
    found, shown = read(made, part, 1), fake.motion(1, FRAMES)
    frames = DuoBoxReader(made).frames("", shown.frames, part)
    assert (found.fps, found.up, found.persons) == (120.0, "+z", ("liu", "ma"))
    assert np.abs(world_joints(found, "smplx") - shown.positions[frames]).max() < 1e-5


def test_the_skeleton_is_read_back_to_the_same_joints(made: Path) -> None:
    found, shown = read(made, "tr2", form="skeleton"), fake.motion(0, FRAMES)
    frames = DuoBoxReader(made).frames("", shown.frames, "tr2")
    assert found.joints == tuple(MAP) and found.poses is None and len(MAP) == 19
    assert found.positions is not None
    assert np.abs(found.positions - shown.positions[frames][:, :, list(MAP)]).max() < 1e-5


def official(total: int, phase: int) -> tuple[list[int], list[int]]:
    """Frames of the authors' two parts, told frame by frame: every fourth, in blocks of four, 80 and 20 %."""
    thinned = [frame for frame in range(SKIPPED, total) if (frame - SKIPPED) % 4 == phase]
    while len(thinned) % 4:
        thinned.pop()
    train = int(len(thinned) * 0.8)
    train -= train % 4
    return thinned[:train], thinned[train:]


@pytest.mark.parametrize("total", [*range(220, 260), 1804, 14003])
def test_parts_are_the_authors_and_no_frame_of_any_phase_is_in_two(made: Path, total: int) -> None:
    reader = DuoBoxReader(made)
    shown = {part: list(range(total))[reader.frames("", total, part)][::4] for part in PARTS}
    whole = DuoBoxReader(made, validation=False)
    for phase in range(4):
        train = official(total, phase)[0]
        assert list(range(total))[whole.frames("", total, f"tr{phase}")][::4] == train
        assert shown[f"tr{phase}"] == train[: len(shown[f"tr{phase}"])]
        assert shown[f"tr{phase}"][-1] < shown["va0"][0]
    assert shown["te0"] == official(total, 0)[1]
    assert shown["va0"][-1] + 4 == shown["te0"][0]
    assert 0.1 * len(official(total, 0)[0]) <= len(shown["va0"]) <= 0.1 * len(official(total, 0)[0]) + 8


def test_every_take_has_all_splits_and_phases_only_for_training(made: Path) -> None:
    takes = DuoBoxReader(made).takes()
    assert [take.name.rsplit("_", 1)[1] for take in takes] == [*PARTS, *PARTS]
    assert [take.split for take in takes[:6]] == ["train"] * 4 + ["val", "test"]
    assert len({take.group for take in takes[:4]}) == 1
    assert len(DuoBoxReader(made, phases=1, validation=False).takes()) == 4


@pytest.mark.parametrize("spelling", ["DuoBox", "duobox", "data/DuoBox"])
def test_the_folder_above_is_a_root_too(made: Path, tmp_path: Path, spelling: str) -> None:
    shutil.copytree(made, tmp_path / spelling)
    assert len(DuoBoxReader(tmp_path).takes()) == 12


def test_takes_without_a_fit_are_read_as_skeletons(copy: Path) -> None:
    (copy / FITS / f"{fake.name(0)}.npy").unlink()
    assert read(copy).poses is None and read(copy, number=1).poses is not None
    assert len(DuoBoxReader(copy, form="fit").takes()) == 6


def test_fits_as_pickles_are_read_alike(copy: Path) -> None:
    before = read(copy)
    path = copy / FITS / f"{fake.name(0)}.npy"
    path.with_suffix(".pkl").write_bytes(pickle.dumps(load_object_npy(path), protocol=2))
    path.unlink()
    assert np.array_equal(before.poses, read(copy).poses)  # type: ignore[arg-type]


def test_a_short_take_is_refused(tmp_path: Path) -> None:
    DuoBoxReader.write_fake(tmp_path, takes=1, frames=1)
    with pytest.raises(DataError, match="24 frames are too few"):
        read(tmp_path, "va0")


TOTAL = fake.length(FRAMES)
FIT = {
    "transl": np.zeros((TOTAL, 3)),
    "global_orient": np.zeros((TOTAL, 3)),
    "body_pose": np.zeros((TOTAL, 63)),
    "betas": np.zeros((TOTAL, 10)),
}


@pytest.mark.parametrize(
    ("subject", "said"),
    [
        (None, "holds liu, expected two people"),
        ({key: value for key, value in FIT.items() if key != "betas"}, "ma: lacks betas"),
        (FIT | {"body_pose": np.zeros((TOTAL, 69))}, "ma: body_pose.*69"),
        (FIT | {"transl": np.full((TOTAL, 3), np.inf)}, "ma: transl.*infinit"),
        (FIT | {"transl": np.zeros((3, 3))}, "ma: unequal numbers of frames"),
        ({key: value[:-4] for key, value in FIT.items()}, "unequal numbers of frames: ma"),
        ({key: value[:0] for key, value in FIT.items()}, "no frames"),
        ("a boxer", "ma: holds a str"),
    ],
)
def test_bad_fits_are_refused_by_file_and_person(copy: Path, subject: Any, said: str) -> None:
    changed(copy, FITS, ma=subject)
    with pytest.raises(DataError, match=rf"defense\.npy.*{said}"):
        read(copy)


@pytest.mark.parametrize(
    ("field", "said"),
    [
        (None, "expected NAME_position of two people"),
        (np.zeros((TOTAL, 22, 3)), r"ma_position.*22"),
        (np.full((TOTAL, 21, 3), np.nan), "ma_position.*NaN"),
        (np.zeros((TOTAL - 1, 21, 3)), "unequal numbers of frames: ma"),
    ],
)
def test_bad_skeletons_are_refused_by_file_and_person(copy: Path, field: Any, said: str) -> None:
    changed(copy, SKELETONS, ma_position=field)
    with pytest.raises(DataError, match=rf"defense\.npy.*{said}"):
        read(copy, form="skeleton")


@pytest.mark.parametrize("options", [{"form": "other"}, {"phases": 5}, {"phases": 0}])
def test_options_out_of_range_are_refused(made: Path, options: dict[str, Any]) -> None:
    with pytest.raises(DataError, match="got"):
        DuoBoxReader(made, **options)
