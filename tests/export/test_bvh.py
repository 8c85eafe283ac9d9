"""BVH: what we write comes back, an independent reader finds the same joints, and broken files are named."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from magnet.body import Body
from magnet.body.joints import JOINT_NAMES
from magnet.export import load_rigs, save_bvh
from magnet.export.bones import Names, bone_names
from magnet.export.bvh import euler_zxy
from magnet.export.bvh_read import read_bvh
from magnet.motion.scene import Scene
from magnet.testing import random_scene


@pytest.fixture
def trio() -> Scene:
    return random_scene(1, 20, 3, torch.Generator().manual_seed(2))


@pytest.mark.parametrize("unit", ["m", "cm"])
def test_joints_and_skin_return_within_a_hundredth_of_a_millimetre(unit, trio: Scene, body: Body, tmp_path: Path):
    paths = save_bvh(trio, tmp_path / "trio.bvh", body, unit=unit)
    assert [path.name for path in paths] == ["trio_person0.bvh", "trio_person1.bvh", "trio_person2.bvh"]
    back = load_rigs(paths, body)
    assert all(source.exact and source.unit == unit and source.up == "y" for source in back.sources)
    assert (back.scene.fps, back.scene.body, back.floor) == (30.0, trio.body, 0.0)
    assert (body.joints(back.scene) - body.joints(trio)).abs().max() < 1e-5
    assert (body.vertices(back.scene) - body.vertices(trio)).abs().max() < 1e-5
    assert (back.scene.betas - trio.betas).abs().max() < 1e-3


def test_an_independent_reader_finds_the_same_joints(trio: Scene, body: Body, tmp_path: Path):
    bvhio = pytest.importorskip("bvhio", reason="bvhio is not installed")
    truth = body.joints(trio)[0].numpy()
    for person, path in enumerate(save_bvh(trio, tmp_path / "trio.bvh", body)):
        root = bvhio.readAsHierarchy(str(path))
        for frame in (0, 7, 19):
            root.loadPose(frame)
            found = {joint.Name: np.array(joint.PositionWorld) for joint, _, _ in root.layout()}
            assert set(found) == set(JOINT_NAMES)
            there = np.stack([found[name] for name in JOINT_NAMES])
            assert np.abs(there - truth[frame, person]).max() < 1e-3


def test_only_people_present_are_written_and_one_keeps_the_plain_name(trio: Scene, body: Body, tmp_path: Path):
    gone = trio.replace(present=torch.tensor([[False, True, False]]))
    (path,) = save_bvh(gone, tmp_path / "solo", body)
    assert path.name == "solo.bvh"
    back = load_rigs(path, body).scene
    assert (body.joints(back)[:, :, 0] - body.joints(trio)[:, :, 1]).abs().max() < 1e-5


def test_people_keep_the_numbers_of_their_slots(trio: Scene, body: Body, tmp_path: Path):
    two = trio.replace(present=torch.tensor([[True, False, True]]))
    assert [path.name for path in save_bvh(two, tmp_path / "a.bvh", body)] == ["a_person0.bvh", "a_person2.bvh"]


@pytest.mark.parametrize(("unit", "long"), [("m", 1.0), ("cm", 100.0)])
def test_last_bones_end_where_hands_toes_and_head_point(unit, long, trio: Scene, body: Body, tmp_path: Path):
    """To the sides, forwards and up, the way that the bone before them goes for a few centimetres more."""
    text = save_bvh(trio, tmp_path / "trio.bvh", body, unit=unit)[0].read_text()
    found = re.findall(r"JOINT (\w+)\n\s*{\n[^{}]*End Site\n\s*{\n\s*OFFSET (\S+) (\S+) (\S+)", text)
    ends = {name: np.array([float(number) for number in offset]) / long for name, *offset in found}
    ways = {"left_wrist": [1, 0, 0], "right_wrist": [-1, 0, 0], "left_foot": [0, 0, 1], "right_foot": [0, 0, 1],
            "head": [0, 1, 0]}  # fmt: skip
    assert set(ends) == set(ways)
    for name, way in ways.items():
        length = np.linalg.norm(ends[name])
        assert 0.05 < length < 0.2 and ends[name] @ way > 0.99 * length


def test_the_header_states_order_and_rate(trio: Scene, body: Body, tmp_path: Path):
    text = save_bvh(trio, tmp_path / "trio.bvh", body)[0].read_text()
    assert text.count("CHANNELS 3 Zrotation Xrotation Yrotation") == 21
    assert "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation" in text
    assert "Frames: 20" in text and "Frame Time: 0.0333333333" in text


@given(st.lists(st.floats(-180, 180), min_size=3, max_size=3), st.booleans())
def test_euler_angles_give_the_rotation_back_also_at_a_quarter_turn(angles, locked):
    z, x, y = angles
    rotation = Rotation.from_euler("ZXY", [z, 90.0 if locked else x, y], degrees=True).as_matrix()[None]
    again = Rotation.from_euler("ZXY", euler_zxy(rotation)[0], degrees=True).as_matrix()
    assert np.abs(again - rotation[0]).max() < 1e-6


def test_euler_angles_do_not_jump():
    turning = Rotation.from_euler("Y", np.arange(0, 1000, 10)[:, None], degrees=True).as_matrix()
    assert np.abs(np.diff(euler_zxy(turning), axis=0)).max() < 11


@pytest.mark.parametrize(
    ("step", "fps"),
    [
        *(("0.033333", 30.0), ("0.00833333", 120.0), ("0.0417", 24.0), ("0.1", 10), ("0.03", 33.333)),
        *(("0.033", 30.0), ("0.0083", 120.0), ("0.017", 60.0), ("0.042", 24.0), ("0.008", 125.0), ("0.0333", 30.0)),
        *(("0.0166", 60.0), ("0.016", 60.0), ("0.0041", 240.0), ("0.0416", 24.0)),
        *(("0.0042", 240.0), ("0.011", 90.0), ("0.0334", 29.97), ("0.04170833", 23.976), ("0.04", 25.0)),
    ],
)
def test_a_rounded_frame_time_is_the_rate_it_stands_for(step, fps, trio: Scene, body: Body, tmp_path: Path):
    path = save_bvh(trio, tmp_path / "trio.bvh", body)[0]
    path.write_text(re.sub(r"Frame Time: \S+", f"Frame Time: {step}", path.read_text()))
    assert read_bvh(path).fps == pytest.approx(fps, rel=1e-3)


def test_positions_that_repeat_the_offset_and_positions_added_to_it_are_told_apart(tmp_path: Path):
    for added in (False, True):
        place = "0 0 0" if added else "0 5 0"
        path = tmp_path / "two.bvh"
        path.write_text(
            "HIERARCHY\nROOT a {\nOFFSET 0 0 0\nCHANNELS 3 Xposition Yposition Zposition\n"
            "JOINT b\n{\nOFFSET 0 5 0\nCHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation\n"
            f"End Site\n{{\nOFFSET 0 1 0\n}}\n}}\n}}\nMOTION\nFrames: 1\nFrame Time: 0.1\n1 2 3 {place} 0 0 0\n"
        )
        _, at = read_bvh(path).world()
        assert at[0].tolist() == [[1, 2, 3], [1, 7, 3]]


def walker(path: Path, offset: np.ndarray, channels: np.ndarray) -> Path:
    """A hip and a leg of 90, moved by so many channels (T, 3)."""
    rows = "\n".join(" ".join(f"{value:.4f}" for value in [*row, 0, 0, 0, 0, 0, 0]) for row in channels)
    path.write_text(
        f"HIERARCHY\nROOT hip {{\nOFFSET {' '.join(map(str, offset))}\n"
        "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation\n"
        "JOINT foot\n{\nOFFSET 0 -90 0\nCHANNELS 3 Zrotation Xrotation Yrotation\n"
        f"End Site\n{{\nOFFSET 0 0 10\n}}\n}}\n}}\nMOTION\nFrames: {len(channels)}\nFrame Time: 0.1\n{rows}\n",
        encoding="utf-8",
    )
    return path


WALK = np.stack([np.linspace(180, -320, 60), 88 + 3 * np.sin(np.arange(60)), np.linspace(-40, 90, 60)], axis=1)
OFFSETS = {
    "the first frame": (WALK[0], False),
    "the first frame of a longer take": (np.array([440.0, 91, -300]), False),
    "the rest pose": (np.array([0.0, 90, 0]), False),
    "the rest pose, where channels begin at zero": (np.array([10.0, 90, 5]), True),
}


@pytest.mark.parametrize("case", OFFSETS)
def test_wherever_somebody_walks_a_root_offset_puts_nobody_elsewhere(case, tmp_path: Path):
    offset, added = OFFSETS[case]
    _, at = read_bvh(walker(tmp_path / "a.bvh", offset, WALK - offset if added else WALK)).world()
    assert np.abs(at[:, 0] - WALK).max() < 1e-3


LYING = np.stack([np.linspace(0, 5, 60), np.r_[90.0, 89, 80, np.full(57, 12.0)], np.zeros(60)], axis=1)
STILL = np.stack([1 + 0.1 * np.sin(np.arange(60)), 88 + 3 * np.sin(np.arange(60)), np.linspace(0, 9, 60)], axis=1)


@pytest.mark.parametrize(
    ("offset", "channels"),
    [([0.0, 90, 0], LYING), ([0.0, 94, 4], LYING), ([10.0, 90, 5], STILL)],
    ids=["who begins where the OFFSET is and lies down", "nearly there", "who hardly moves aside"],
)
def test_how_somebody_moves_on_does_not_make_channels_count_from_the_offset(offset, channels, tmp_path: Path):
    _, at = read_bvh(walker(tmp_path / "a.bvh", np.array(offset), channels)).world()
    assert np.abs(at[:, 0] - channels).max() < 1e-3


def test_a_recording_stays_where_it_is_if_its_root_offset_repeats_the_first_frame(cmu_root: Path, tmp_path: Path):
    file = cmu_root / "bvh" / "test__walking__walking_1.bvh"
    if not file.is_file():
        pytest.skip("no conversions of the recordings to BVH here")
    plain = read_bvh(file)
    first = " ".join(map(str, plain.place[0, 0]))
    moved = tmp_path / "moved.bvh"
    moved.write_text(re.sub(r"OFFSET 0 0 0", f"OFFSET {first}", file.read_text(), count=1))
    assert read_bvh(moved).offsets[0].any()
    assert np.array_equal(read_bvh(moved).world()[1], plain.world()[1])


BREAKS = {
    "does not begin with HIERARCHY": lambda text: "garbage\n" + text,
    "has no MOTION part": lambda text: text[: text.index("MOTION")],
    "the HIERARCHY is incomplete": lambda text: text.replace("}\nMOTION", "MOTION"),
    "Frames: 20, but 15.04 frames of 69 numbers follow; the file is truncated": lambda text: "\n".join(
        [*text.split("\n")[:-6], "1 2 3"]
    ),
    "Frames: 2, but 20 frames of 69 numbers": lambda text: text.replace("Frames: 20", "Frames: 2"),
    "Frame Time: 0,0333333 has a decimal comma, expected a point": lambda text: re.sub(
        r"Frame Time: \S+", "Frame Time: 0,0333333", text
    ),
    ":4: 0,0000000 has a decimal comma, expected a point": lambda text: text.replace(".", ","),
    "0,5 has a decimal comma": lambda text: re.sub(r"\S+\n$", "0,5\n", text),
    "expected the lines 'Frames: N'": lambda text: text.replace("Frames: 20", "Frames: many"),
    "frame 19 holds NaN or infinity; leave such frames out in all": lambda text: re.sub(r"\S+\n$", "nan\n", text),
    "something that is no number": lambda text: re.sub(r"\S+\n$", "1.2.3\n", text),
    r":5: CHANNELS 6 X .*: expected 6 of": lambda text: text.replace("CHANNELS 6 Xposition", "CHANNELS 6 X", 1),
    r":4: got 0.0 0.0, expected 3 finite": lambda text: re.sub(r"OFFSET [0. ]+", "OFFSET 0.0 0.0", text, count=1),
    "a JOINT inside an End Site": lambda text: re.sub(r"(End Site\s*{)", r"\1\nJOINT a\n{\nOFFSET 0 0 0\n}", text),
    "a second ROOT": lambda text: text.replace("JOINT left_hip", "ROOT left_hip"),
    "expected ROOT, JOINT": lambda text: text.replace("JOINT left_hip", "BONE left_hip"),
    "frames of 0 s": lambda text: re.sub(r"Frame Time: \S+", "Frame Time: 0", text),
}  # fmt: skip


def test_blank_lines_may_come_before_the_hierarchy(trio: Scene, body: Body, tmp_path: Path):
    path = save_bvh(trio, tmp_path / "trio.bvh", body)[0]
    plain, text = read_bvh(path), path.read_text()
    path.write_text("\ufeff\n \n" + text, encoding="utf-8")
    assert np.array_equal(read_bvh(path).world()[1], plain.world()[1])
    path.write_text("\n\n" + text.replace("CHANNELS 6 Xposition", "CHANNELS 6 X", 1))
    with pytest.raises(ValueError, match=r":7: CHANNELS 6 X .*: expected 6 of"):
        read_bvh(path)


@pytest.mark.parametrize("mark", ["", "\ufeff"])
@pytest.mark.parametrize("coding", ["utf-16-le", "utf-16-be"])
def test_a_file_in_utf_16_is_read_as_one_in_utf_8(coding: str, mark: str, trio: Scene, body: Body, tmp_path: Path):
    path = save_bvh(trio, tmp_path / "trio.bvh", body)[0]
    plain = read_bvh(path)
    path.write_text(mark + path.read_text(), encoding=coding)
    read = read_bvh(path)
    assert read.names == plain.names and np.array_equal(read.world()[1], plain.world()[1])


@pytest.mark.parametrize("message", BREAKS)
def test_a_broken_file_is_named_with_what_is_wrong(message, trio: Scene, body: Body, tmp_path: Path):
    path = save_bvh(trio, tmp_path / "trio.bvh", body)[0]
    broken = BREAKS[message](path.read_text())
    assert broken != path.read_text()
    path.write_text(broken)
    with pytest.raises(ValueError, match=message) as error:
        read_bvh(path)
    assert str(path) in str(error.value)


@pytest.mark.parametrize("names", ["vrm", "mixamo"])
def test_a_skeleton_of_other_names_comes_back_as_any_rig_does(names: Names, trio: Scene, body: Body, tmp_path: Path):
    """Written for programs that retarget by these; a rig of theirs may look just so, so it is fitted."""
    paths = save_bvh(trio, tmp_path / "trio.bvh", body, names=names)
    assert sorted(read_bvh(paths[0]).names) == sorted(bone_names(names))
    found = load_rigs(paths, body, keep_floor=True)
    assert not any(source.exact for source in found.sources)
    assert (body.joints(found.scene) - body.joints(trio)).norm(dim=-1).mean() < 0.02


def test_frames_that_hold_nan_can_be_left_out_at_the_ends(trio: Scene, body: Body, tmp_path: Path):
    path = save_bvh(trio, tmp_path / "trio.bvh", body)[0]
    whole = read_bvh(path)
    path.write_text(re.sub(r"\S+\n$", "nan\n", path.read_text()))
    last = whole.frames - 1
    part = read_bvh(path, start=3, end=last)
    assert part.tracked is None and np.allclose(part.world()[1], whole.world()[1][3:last])
    with pytest.raises(ValueError, match=rf"frame {last} holds NaN or infinity; .*--start and --end"):
        read_bvh(path, start=3)


def test_frames_that_hold_nan_may_be_gaps_but_not_all_of_them(trio: Scene, body: Body, tmp_path: Path):
    path = save_bvh(trio, tmp_path / "trio.bvh", body)[0]
    path.write_text(re.sub(r"\S+\n$", "nan\n", path.read_text()))
    assert read_bvh(path, gaps=True).tracked.tolist() == [True] * 19 + [False]
    assert read_bvh(path, gaps=True, end=19).tracked is None
    with pytest.raises(ValueError, match="frame 19 holds NaN or infinity; leave such frames out"):
        read_bvh(path, gaps=True, start=19)
    path.write_text(re.sub(r"(?m)^(-?[\d.]+ .*) \S+$", r"\1 nan", path.read_text()))
    with pytest.raises(ValueError, match="frame 0 holds NaN or infinity; every frame does"):
        read_bvh(path, gaps=True)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.1, 0.3, 0.5, 0.9, 0.99])
def test_a_file_cut_anywhere_is_refused(share, trio: Scene, body: Body, tmp_path: Path):
    path = save_bvh(trio, tmp_path / "trio.bvh", body)[0]
    text = path.read_text()
    path.write_text(text[: int(share * len(text))])
    with pytest.raises(ValueError, match=r"truncated|not a BVH|incomplete|expected|without"):
        read_bvh(path)


def test_a_damaged_file_is_read_or_refused_but_never_breaks_the_reader(trio: Scene, body: Body, tmp_path: Path):
    path = save_bvh(trio.slice(0, 3), tmp_path / "trio.bvh", body)[0]
    text, draw = path.read_text(), np.random.default_rng(0)
    refused = 0
    for _ in range(150):
        letters = list(text)
        for _ in range(draw.integers(1, 4)):
            at = int(draw.integers(len(letters)))
            letters[at : at + int(draw.integers(0, 30))] = draw.choice(["", "{", "}", "x", "\n", "-", "1e999", "\0"])
        path.write_text("".join(letters))
        try:
            read_bvh(path)
        except ValueError as error:
            refused += 1
            assert str(path) in str(error)
    assert refused > 75


def test_scenes_that_cannot_be_written_are_named(trio: Scene, body: Body, tmp_path: Path):
    with pytest.raises(ValueError, match="got 2 scenes"):
        save_bvh(trio.repeat(2), tmp_path / "a.bvh", body)
    with pytest.raises(ValueError, match="nobody is present"):
        save_bvh(trio.replace(present=torch.zeros(1, 3, dtype=torch.bool)), tmp_path / "a.bvh", body)
    with pytest.raises(ValueError, match="belongs to body 'other'"):
        save_bvh(trio.replace(body="other"), tmp_path / "a.bvh", body)
    with pytest.raises(ValueError, match="unit 'km'"):
        save_bvh(trio, tmp_path / "a.bvh", body, unit="km")  # type: ignore[arg-type]
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_bvh(tmp_path / "none.bvh")
