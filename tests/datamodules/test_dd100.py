"""The DD100 reader against its fake."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magnet.datamodules.dd100 import DD100Reader
from magnet.datamodules.fakes import dd100 as fake
from magnet.datamodules.reading.recording import DataError, Recording
from magnet.unpickle import load_object_npy

TAKES, FRAMES = 4, 12
FOLDER = "data/motion/smplx/all"


def read(root: Path, number: int = 0, **options: Any) -> Recording:
    reader = DD100Reader(root, **options)
    return reader.read(next(take for take in reader.takes() if take.name == fake.name(number)))


def changed(root: Path, role: int = 0, **fields: Any) -> None:
    """Overwrite keys of the first take's file of a role; None removes a key."""
    path = root / FOLDER / f"{fake.name(0)}_{role:02}.npy"
    held = load_object_npy(path) | fields
    np.save(path, {key: value for key, value in held.items() if value is not None}, allow_pickle=True)  # type: ignore[arg-type]


def test_roles_are_known(made: Path) -> None:
    assert read(made).persons == ("follower", "leader")


@pytest.mark.parametrize("inside", ["", "data", "data/motion", "data/motion/smplx", FOLDER])
def test_any_folder_on_the_way_to_the_files_is_a_root(made: Path, inside: str) -> None:
    assert len(DD100Reader(made / inside).takes()) == 4


def test_the_preprocessed_pack_is_no_root(tmp_path: Path) -> None:
    (tmp_path / "rotmat").mkdir()
    with pytest.raises(DataError, match="rotmat"):
        DD100Reader(tmp_path)


def test_the_split_is_the_authors_rule(made: Path) -> None:
    reader = DD100Reader(made)
    for genre in ("Ballet", "Waltz", "Qiaqiaqia"):
        tests = {c for c in range(1, 11) if reader.split(genre, c) == "test"}
        assert tests == ({9, 10} if genre == "Ballet" else {5, 10})
        assert {c for c in range(1, 11) if reader.split(genre, c) == "val"} == {4}


def test_without_validation_the_training_split_is_the_official_one(made: Path) -> None:
    reader = DD100Reader(made, validation=False)
    assert {reader.split("Waltz", c) for c in (1, 2, 3, 4, 6, 7, 8, 9)} == {"train"}


def test_a_shorter_partner_cuts_the_take_with_a_note(copy: Path) -> None:
    held = load_object_npy(copy / FOLDER / f"{fake.name(0)}_01.npy")
    changed(copy, 1, **{key: held[key][:-3] for key in ("poses", "global_orient", "transl", "betas")})
    found = read(copy)
    assert found.frames == FRAMES - 3
    assert any(f"follower {FRAMES}, leader {FRAMES - 3}" in note for note in found.notes)


@pytest.mark.parametrize(
    "shaped",
    [
        {"poses": lambda a: a.reshape(-1, 55, 3), "global_orient": lambda a: a.reshape(-1, 1, 3)},
        {"global_orient": lambda a: None},
        {"betas": lambda a: np.pad(a, ((0, 0), (0, 6)))},
        {"betas": lambda a: a[0]},
        {"transl": lambda a: a.astype(np.float64)},
        {"meta": lambda a: None},
    ],
)
def test_other_shapes_in_use_are_read_alike(copy: Path, shaped: dict[str, Callable[[Any], Any]]) -> None:
    before = read(copy)
    held = load_object_npy(copy / FOLDER / f"{fake.name(0)}_00.npy")
    changed(copy, **{key: change(held[key]) for key, change in shaped.items()})
    after = read(copy)
    for part in ("poses", "transl", "betas"):
        assert np.array_equal(getattr(before, part), getattr(after, part))


def test_orientations_that_differ_are_refused_until_one_is_chosen(copy: Path) -> None:
    other = np.full((FRAMES, 3), 0.5)
    changed(copy, global_orient=other)
    with pytest.raises(DataError, match=r"_00\.npy: global_orient and poses.* differ.*--reader.orient .*poses"):
        read(copy)
    assert np.array_equal(read(copy, orient="global_orient").poses[:, 0, 0], other)  # type: ignore[index]
    assert not np.array_equal(read(copy, orient="poses").poses[:, 0, 0], other)  # type: ignore[index]


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"betas": None}, "lacks betas; it has"),
        ({"poses": None}, "lacks poses"),
        ({"transl": np.full((FRAMES, 3), np.nan)}, "transl.*NaN"),
        ({"poses": np.zeros((0, 165)), "global_orient": None}, "poses.*no frames"),
        ({"poses": np.zeros((FRAMES, 72))}, r"poses.*\(12, 72\).*165"),
        ({"betas": np.zeros((FRAMES, 4))}, "betas.*4 shape numbers"),
        ({"transl": np.zeros((FRAMES - 1, 3))}, "poses 12, transl 11"),
        ({"transl": "far away"}, "transl.*expected numbers"),
        ({"transl": [[1.0], [1.0, 2.0]]}, "transl.*unequal length"),
    ],
)
def test_bad_fields_are_refused_by_name(copy: Path, fields: dict[str, Any], said: str) -> None:
    changed(copy, **fields)
    with pytest.raises(DataError, match=rf"Waltz_001_001_00\.npy.*{said}"):
        read(copy)


def test_a_missing_partner_is_refused_when_read_and_only_then(copy: Path) -> None:
    (copy / FOLDER / f"{fake.name(0)}_01.npy").unlink()
    assert len(DD100Reader(copy).takes()) == 4
    with pytest.raises(DataError, match=r"_01\.npy: no such file"):
        read(copy)
    assert read(copy, 1).frames == FRAMES


def test_an_array_of_the_preprocessed_pack_is_refused(copy: Path) -> None:
    np.save(copy / FOLDER / f"{fake.name(0)}_00.npy", np.zeros((FRAMES, 498)))
    with pytest.raises(DataError, match=r"an array \(12, 498\)"):
        read(copy)
