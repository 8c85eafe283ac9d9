"""The ReMoCap reader against its fake."""

from __future__ import annotations

import pickle
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magnet.datamodules.fakes import remocap as fake
from magnet.datamodules.reading.recording import DataError, Recording
from magnet.datamodules.reading.remocap_track import read_bvh_header
from magnet.datamodules.remocap import ReMoCapReader
from magnet.unpickle import load_pickle
from tests.datamodules.remocap_fits import write_fitted_scenes

TAKES, FRAMES = 4, 6
PERSON = "ReMoCap/LindyHop/train/3/0"
TOTAL = fake.length(FRAMES)


@pytest.fixture(scope="module")
def fits(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("fits")
    write_fitted_scenes(root, fake.scenes(4, FRAMES, 0))
    return root


def read(root: Path, number: int = 3, **options: Any) -> Recording:
    reader = ReMoCapReader(root, **options)
    return reader.read(next(take for take in reader.takes() if take.group == str(number)))


def table(path: Path) -> tuple[list[str], np.ndarray]:
    lines = path.read_text(encoding="utf-8").splitlines()
    return lines[0].split(","), np.array([[float(word) for word in line.split(",")] for line in lines[1:]])


def write_table(path: Path, heading: list[str], values: np.ndarray) -> None:
    rows = [",".join(f"{x:.6f}" for x in row) for row in values]
    path.write_text("\n".join([",".join(heading), *rows]) + "\n", encoding="utf-8")


def test_the_fakes_csv_has_the_order_of_the_authors_code(made: Path) -> None:
    heading, values = table(made / PERSON / "motion_worldpos.csv")
    names = [word.partition(".")[0] for word in heading[1::3]]
    # Places in the table of process_LindyHop.py, as the design notes cite it.
    places = {"Hips": 0, "RightUpLeg": 1, "LeftUpLeg": 6, "Spine": 11, "RightShoulder": 15, "RightHandPinky1": 20}
    places |= {"LeftShoulder": 40, "LeftHandThumb3End": 64, "Spine4": 65, "Neck": 66, "Head": 67, "HeadEnd": 68}
    assert values.shape == (TOTAL, 1 + 3 * 69) and {name: names.index(name) for name in places} == places


def test_ready_fits_alone_need_the_papers_split(fits: Path) -> None:
    with pytest.raises(DataError, match="split=paper"):
        ReMoCapReader(fits).takes()
    splits = {take.group: take.split for take in ReMoCapReader(fits, split="paper").takes()}
    assert splits == {"3": "train", "5": "train", "6": "test", "8": "val"}


def test_splits_are_by_folder_or_by_the_papers_sequences(made: Path, copy: Path) -> None:
    official = {take.group: take.split for take in ReMoCapReader(made).takes()}
    assert official == {"3": "train", "5": "train", "6": "test", "8": "val"}
    half = copy / "ReMoCap/LindyHop"
    (half / "train/8").rename(half / "test/8")
    assert {t.group: t.split for t in ReMoCapReader(copy).takes()} == {
        "3": "train",
        "5": "val",
        "6": "test",
        "8": "test",
    }
    assert ReMoCapReader(copy, split="paper").takes()[-1].split == "val"


@pytest.mark.parametrize("inside", ["", "ReMoCap", "ReMoCap/LindyHop"])
def test_any_folder_on_the_way_is_a_root(made: Path, inside: str) -> None:
    assert len(ReMoCapReader(made / inside).takes()) == 4


def test_other_spellings_are_read_alike(copy: Path) -> None:
    before = read(copy)
    (copy / "ReMoCap").rename(copy / "ReMocap")
    sequence = copy / "ReMocap/LindyHop/train/3"
    for person in ("0", "1"):
        (sequence / person / "motion_worldpos.csv").rename(sequence / person / "motion_worldpose.csv")
        (sequence / person / "motion_rotations.csv").rename(sequence / person / "motion_rotation.csv")
    sequence.rename(sequence.with_name("seq_3"))
    after = read(copy)
    assert np.array_equal(before.positions, after.positions)  # type: ignore[arg-type]
    assert any("motion_worldpose.csv" in note for note in after.notes)


@pytest.mark.parametrize("order", ["reversed", "as declared", "without ends"])
def test_columns_without_names_are_told_by_the_bones(copy: Path, order: str) -> None:
    before = read(copy)
    header = read_bvh_header(copy / PERSON / "motion.bvh")
    for file in ("motion_worldpos.csv", "motion_rotations.csv"):
        heading, values = table(copy / PERSON / file)
        names = [word.partition(".")[0] for word in heading[1::3]]
        kept = list(header.names) if order == "as declared" else names
        if order == "without ends":
            kept = [name for name in kept if not name.endswith("End")]
        columns = [0, *(3 * names.index(name) + 1 + axis for name in kept for axis in range(3))]
        write_table(copy / PERSON / file, ["frame", *(str(k) for k in columns[1:])], values[:, columns])
    after = read(copy)
    assert np.array_equal(before.positions, after.positions)  # type: ignore[arg-type]
    assert any("lengths of bones" in note for note in after.notes)


def test_the_euler_order_of_the_bvh_is_proven_and_another_one_found(copy: Path) -> None:
    assert any(re.search("Euler order zxy as in the BVH.* within .* mm", note) for note in read(copy).notes)
    path = copy / PERSON / "motion.bvh"
    path.write_text(path.read_text().replace("Zrotation Xrotation Yrotation", "Xrotation Yrotation Zrotation"))
    assert any("Euler order zxy, lead" in note for note in read(copy).notes)


def test_without_rotations_nothing_is_proven_but_the_take_is_read(copy: Path) -> None:
    (copy / PERSON / "motion_rotations.csv").unlink()
    (copy / PERSON / "motion_offsets.pkl").unlink()
    assert any("not proven" in note for note in read(copy).notes)


def test_offsets_may_lack(copy: Path) -> None:
    (copy / PERSON / "motion_offsets.pkl").unlink()
    assert read(copy).frames == TOTAL


@pytest.mark.parametrize("factor", [0.001, 0.1, 10.0])
def test_another_unit_of_positions_is_refused_unless_all_share_it(copy: Path, factor: float) -> None:
    path = copy / PERSON / "motion_worldpos.csv"
    heading, values = table(path)
    values[:, 1:] *= factor
    write_table(path, heading, values)
    with pytest.raises(DataError, match=r"no Euler order leads.*millimetres"):
        read(copy)


def test_rotations_in_radians_are_refused_as_such(copy: Path) -> None:
    path = copy / PERSON / "motion_rotations.csv"
    heading, values = table(path)
    values[:, 1:] = np.radians(values[:, 1:])
    write_table(path, heading, values)
    with pytest.raises(DataError, match=r"motion_rotations\.csv looks like radians, expected degrees: convert it"):
        read(copy)


def test_swapped_joints_are_refused(copy: Path) -> None:
    path = copy / PERSON / "motion_worldpos.csv"
    path.write_text(
        path.read_text().replace("LeftArm.", "Arm.").replace("LeftLeg.", "LeftArm.").replace("Arm.", "LeftLeg.")
    )
    with pytest.raises(DataError, match=r"LindyHop/train/3/0"):
        read(copy)


def test_a_csv_thinned_against_its_bvh_is_refused(copy: Path) -> None:
    path = copy / PERSON / "motion_worldpos.csv"
    heading, values = table(path)
    values[:, 0] *= 2.5
    write_table(path, heading, values)
    with pytest.raises(DataError, match=r"rows are 0\.05 s apart, its BVH says 0\.02 s"):
        read(copy)


def test_another_rate_of_the_bvh_is_taken_with_a_note(copy: Path) -> None:
    for person in ("0", "1"):
        folder = (copy / PERSON).with_name(person)
        path = folder / "motion.bvh"
        path.write_text(path.read_text().replace("Frame Time: 0.020000", "Frame Time: 0.010000"))
        heading, values = table(folder / "motion_worldpos.csv")
        values[:, 0] /= 2
        write_table(folder / "motion_worldpos.csv", heading, values)
    found = read(copy)
    assert found.fps == 100.0 and any("100 fps by its BVH, not 50" in note for note in found.notes)


def edited(path: Path, old: str, new: str, count: int = -1) -> None:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, count), encoding="utf-8")


def shortened(path: Path, lines: int) -> None:
    path.write_text("\n".join(path.read_text(encoding="utf-8").splitlines()[:-lines]) + "\n", encoding="utf-8")


@pytest.mark.parametrize(
    ("file", "damage", "said"),
    [
        ("motion.bvh", lambda p: shortened(p, 2), "says 10 frames, has 8: cut short"),
        ("motion.bvh", lambda p: p.write_text(p.read_text()[:-40]), "its last frame has .* of 165 numbers"),
        ("motion.bvh", lambda p: p.write_text(p.read_text()[:900]), "has no MOTION part"),
        (
            "motion.bvh",
            lambda p: edited(p, "Frame Time: 0.020000", "Frame Time: soon"),
            "expected the lines .Frames: N",
        ),
        ("motion.bvh", lambda p: edited(p, "Frames: 10", "Frames: 0"), "0 frames of 0.02 s"),
        (
            "motion.bvh",
            lambda p: edited(p, "OFFSET", "OFFSET x", 1),
            r"motion\.bvh:4: .*expected 3",
        ),
        ("motion.bvh", lambda p: edited(p, "JOINT Neck", "JOINT Nick"), "no offset of Nick"),
        ("motion.bvh", lambda p: p.unlink(), "no such file"),
        ("motion_worldpos.csv", lambda p: shortened(p, 1), "motion.bvh 10, motion_worldpos.csv 9"),
        ("motion_worldpos.csv", lambda p: p.write_text(p.read_text()[:-500]), "not a table of numbers"),
        ("motion_worldpos.csv", lambda p: p.write_text(p.read_text().splitlines()[0]), "no rows"),
        ("motion_worldpos.csv", lambda p: edited(p, "Hips.X", "Hips.Y"), "expected X, Y and Z of a joint"),
        ("motion_worldpos.csv", lambda p: edited(p, "Time,", ""), "headings over 208 columns"),
        ("motion_worldpos.csv", lambda p: edited(p, "LeftArm.", "LeftArms."), "no columns of LeftArm"),
        ("motion_worldpos.csv", lambda p: p.unlink(), "no such file"),
        ("motion_rotations.csv", lambda p: shortened(p, 1), "motion_rotations.csv 9"),
        ("motion_rotations.csv", lambda p: edited(p, "LeftArm.", "LeftArms."), "no columns of LeftArm"),
        ("motion_offsets.pkl", lambda p: p.write_bytes(p.read_bytes()[:100]), "not a whole pickle"),
        ("motion_offsets.pkl", lambda p: p.write_bytes(pickle.dumps({"Hips": [0, 0, 0]})), "has no offset of"),
        ("motion_offsets.pkl", lambda p: p.write_bytes(pickle.dumps([1, 2])), "holds a list"),
        ("motion_offsets.pkl", lambda p: p.write_bytes(pickle.dumps({"Hips": Path("x")})), "names pathlib"),
        ("motion_offsets.pkl", lambda p: p.write_bytes(pickle.dumps(load_pickle(p) | {"Neck": [1, 2]})), "Neck"),
    ],
)
def test_damaged_files_are_refused_by_place(copy: Path, file: str, damage: Any, said: str) -> None:
    damage(copy / PERSON / file)
    with pytest.raises(DataError, match=said) as caught:
        read(copy)
    assert "train/3/0" in str(caught.value)
    assert read(copy, 5).frames == TOTAL


@pytest.mark.parametrize("text", ["nan", "inf", "1e999"])
def test_positions_that_are_no_numbers_are_refused(copy: Path, text: str) -> None:
    path = copy / PERSON / "motion_worldpos.csv"
    lines = path.read_text().splitlines()
    lines[3] = ",".join([*lines[3].split(",")[:-1], text])
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(DataError, match=r"worldpos\.csv.* NaN or infinit"):
        read(copy)


def test_a_missing_partner_is_refused_when_read_and_only_then(copy: Path) -> None:
    shutil.rmtree((copy / PERSON).with_name("1"))
    assert len(ReMoCapReader(copy).takes()) == 4
    with pytest.raises(DataError, match="train/3/1: no such folder: a partner's files are missing"):
        read(copy)


@pytest.mark.parametrize("person", ["0", "1"])
def test_two_people_of_unequal_length_are_cut_to_the_shorter(copy: Path, person: str) -> None:
    """As the authors' process_LindyHop.py does; files of one person still have to agree."""
    whole = read(copy)
    folder = (copy / PERSON).with_name(person)
    for file in ("motion.bvh", "motion_worldpos.csv", "motion_rotations.csv"):
        shortened(folder / file, 3)
    edited(folder / "motion.bvh", f"Frames: {TOTAL}", f"Frames: {TOTAL - 3}")
    found = read(copy)
    assert np.array_equal(found.positions, whole.positions[:-3])  # type: ignore[arg-type, index]
    lengths = {"0": TOTAL, "1": TOTAL} | {person: TOTAL - 3}
    listed = ", ".join(f"{one} {length}" for one, length in lengths.items())
    assert f"unequal numbers of frames ({listed}), cut to the shortest" in found.notes


def test_a_number_twice_is_refused(copy: Path) -> None:
    shutil.copytree(copy / "ReMoCap/LindyHop/train/3", copy / "ReMoCap/LindyHop/test/seq_03")
    with pytest.raises(DataError, match="has the number of"):
        ReMoCapReader(copy).takes()


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"betas": None}, "lacks betas"),
        ({"trans": np.zeros((TOTAL, 3))}, r"trans is \(10, 3\), expected \(2, T"),
        ({"trans": np.full((2, TOTAL, 3), np.nan)}, "person 0: trans.* NaN"),
        ({"orient": np.zeros((2, TOTAL - 1, 3))}, "person 0: unequal"),
        ({"body_pose": np.zeros((2, TOTAL, 60))}, "body_pose.*60"),
    ],
)
def test_bad_fits_are_refused_by_file(fits: Path, tmp_path: Path, fields: dict[str, Any], said: str) -> None:
    with np.load(fits / "3.npz") as file:
        held = dict(file) | fields
    np.savez(tmp_path / "3.npz", **{key: value for key, value in held.items() if value is not None})
    with pytest.raises(DataError, match=rf"3\.npz.*{said}"):
        read(tmp_path, split="paper")
