"""The Inter-X reader against its fake."""

from __future__ import annotations

import pickle
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magnet.datamodules.fakes import interx as fake
from magnet.datamodules.interx import InterXReader
from magnet.datamodules.preparing.canonicalize import CanonicalizeOptions
from magnet.datamodules.preparing.convert import PrepareJob
from magnet.datamodules.preparing.prepare import prepare
from magnet.datamodules.reading.recording import DataError, Recording

TAKES, FRAMES = 4, 4


def read(root: Path, number: int = 0, **options: Any) -> Recording:
    reader = InterXReader(root, **options)
    return reader.read(next(take for take in reader.takes() if take.name.startswith(fake.name(number))))


def changed(root: Path, **fields: Any) -> None:
    """Overwrite keys of the first clip's P2; None removes a key."""
    path = root / "motions" / fake.name(0) / "P2.npz"
    with np.load(path) as file:
        held = dict(file) | fields
    np.savez(path, **{key: value for key, value in held.items() if value is not None})


def test_roles_are_those_of_the_annotations(made: Path) -> None:
    assert read(made, 0).persons == ("P1, actor", "P2, reactor")
    assert read(made, 1).persons == ("P1, reactor", "P2, actor")


@pytest.mark.parametrize("held", [b"", pickle.dumps(Path("x"))])
def test_damaged_annotations_cost_the_roles_and_no_clip(copy: Path, held: bytes) -> None:
    (copy / "annots/interaction_order.pkl").write_bytes(held)
    found = read(copy)
    assert found.persons == ("P1", "P2") and any("roles are unknown" in note for note in found.notes)
    (copy / "annots/interaction_order.pkl").unlink()
    assert read(copy).persons == ("P1", "P2")


def test_the_official_split_is_that_of_the_lists(made: Path) -> None:
    assert [take.split for take in InterXReader(made).takes()] == ["train", "val", "test", "train"]


def test_folders_may_carry_the_action(copy: Path) -> None:
    folder = copy / "motions" / fake.name(1)
    folder.rename(folder.with_name(f"{folder.name}_High-five"))
    takes = InterXReader(copy).takes()
    assert takes[1].name.endswith("High-five") and takes[1].split == "val"
    assert read(copy, 1).persons == ("P1, reactor", "P2, actor")


def test_a_clip_in_no_list_is_in_no_split(copy: Path) -> None:
    (copy / "splits/val.txt").write_text("G999T000A000R000\n")
    assert [take.split for take in InterXReader(copy).takes()] == ["train", None, "test", "train"]


@pytest.mark.parametrize("ending", [".txt", ".csv", "_data.csv"])
def test_the_papers_split_is_that_of_the_users_lists(made: Path, tmp_path: Path, ending: str) -> None:
    for split, numbers in (("train", (2,)), ("val", (3,)), ("test", (0, 1))):
        lines = ["scene_name"] * (ending != ".txt") + [f"{fake.name(number)}_Hug" for number in numbers]
        (tmp_path / f"{split}{ending}").write_text("\n".join(lines) + "\n")
    reader = InterXReader(made, split="paper", lists=tmp_path)
    assert [take.split for take in reader.takes()] == ["test", "test", "train", "val"]


def test_lists_beside_the_repositorys_motions_are_found(copy: Path) -> None:
    (copy / "splits").rename(copy / "datasets")
    assert InterXReader(copy).takes()[0].split == "train"


def test_roles_that_come_after_a_store_was_made_are_read_into_it(copy: Path, tmp_path: Path) -> None:
    (copy / "annots").rename(tmp_path / "annots")
    order = PrepareJob("interx", str(copy), {}, str(copy / "body.npz"), CanonicalizeOptions(min_frames=1))
    assert prepare(order, tmp_path / "store", limit=1).folder.manifest["persons"][0]["persons"] == ["P1", "P2"]
    (tmp_path / "annots").rename(copy / "annots")
    report = prepare(order, tmp_path / "store", limit=1)
    assert report.kept == 0
    assert {word for entry in report.folder.manifest["persons"] for word in entry["persons"]} >= {"P1, actor"}


def test_a_clip_in_two_lists_is_refused(copy: Path) -> None:
    shutil.copy(copy / "splits/train.txt", copy / "splits/test.txt")
    with pytest.raises(DataError, match="in both train and test"):
        InterXReader(copy).takes()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"split": "paper"}, "lists=FOLDER"),
        ({"split": "mine"}, "expected 'official' or 'paper'"),
        ({"split": "paper", "lists": Path("nowhere")}, "no train.txt, train.csv"),
    ],
)
def test_a_split_without_lists_is_refused(made: Path, options: dict[str, Any], said: str) -> None:
    with pytest.raises(DataError, match=said):
        InterXReader(made, **options).takes()


def test_a_list_of_something_else_is_refused(copy: Path) -> None:
    (copy / "splits/train.txt").write_text("eggs\nmilk\nbread\n")
    with pytest.raises(DataError, match=r"train\.txt: 0 of 3 lines"):
        InterXReader(copy).takes()


def test_missing_lists_are_refused_with_where_they_are(copy: Path) -> None:
    shutil.rmtree(copy / "splits")
    with pytest.raises(DataError, match=r"no splits/train\.txt"):
        InterXReader(copy).takes()


def test_the_processed_file_is_refused_with_the_reason(tmp_path: Path) -> None:
    (tmp_path / "inter-x.h5").write_bytes(b"\x89HDF\r\n")
    with pytest.raises(DataError, match="floor is each person's own"):
        InterXReader(tmp_path)


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"betas": None}, "lacks betas"),
        ({"trans": np.full((16, 3), np.nan)}, "trans.*NaN"),
        ({"pose_body": np.zeros((16, 23, 3))}, r"pose_body.*\(16, 23, 3\)"),
        ({"pose_body": np.zeros((0, 21, 3)), "trans": np.zeros((0, 3)), "root_orient": np.zeros((0, 3))}, "no frames"),
        ({"root_orient": np.zeros((15, 3))}, "unequal numbers of frames"),
        ({"pose_body": np.zeros((9, 21, 3)), "trans": np.zeros((9, 3)), "root_orient": np.zeros((9, 3))}, "P2.* 9"),
        ({"betas": np.zeros((1, 8))}, "8 shape numbers"),
        ({"betas": np.array(["a"])}, "betas.*expected numbers"),
    ],
)
def test_bad_fields_are_refused_by_name(copy: Path, fields: dict[str, Any], said: str) -> None:
    changed(copy, **fields)
    with pytest.raises(DataError, match=rf"G001T000A000R000.*{said}"):
        read(copy)
    assert read(copy, 1).frames == 4 * FRAMES


def test_a_missing_partner_is_refused_when_read_and_only_then(copy: Path) -> None:
    (copy / "motions" / fake.name(0) / "P2.npz").unlink()
    assert len(InterXReader(copy).takes()) == 4
    with pytest.raises(DataError, match=r"P2\.npz: no such file"):
        read(copy)


def test_pickled_numbers_are_refused(copy: Path) -> None:
    changed(copy, trans=np.array([Path("x")], dtype=object))
    with pytest.raises(DataError, match=r"P2\.npz"):
        read(copy)
