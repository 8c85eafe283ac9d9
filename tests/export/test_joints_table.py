"""Tables of joint positions as files have them: names of columns, rows in any order, what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from magnet.export.joints_table import read_table


def table(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("head", "unit"),
    [
        ("left_hip_x_m,left_hip_y_m,left_hip_z_m", "m"),
        ("left_hip_x,left_hip_y,left_hip_z", None),
        ("left_hip.X,left_hip.Y,left_hip.Z", None),
        ("left_hip x (mm),left_hip y (mm),left_hip z (mm)", "mm"),
        ("left_hipX_cm,left_hipY_cm,left_hipZ_cm", "cm"),
        ("x_left_hip,y_left_hip,z_left_hip", None),
        ("X.left_hip (mm),Y.left_hip (mm),Z.left_hip (mm)", "mm"),
    ],
)
def test_columns_are_joints_by_axis_and_unit(head: str, unit: str | None, tmp_path: Path) -> None:
    found = read_table(table(tmp_path / "a.csv", head, "1,2,3", "4,5,6"))
    assert found.names == ("left_hip",) and found.unit == unit and found.fps is None and found.people == ("",)
    assert found.at[:, 0, 0].tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize("sign", [",", ";", "\t"])
def test_rows_of_people_and_frames_may_come_in_any_order_and_some_be_missing(sign: str, tmp_path: Path) -> None:
    lines = ["time,Frame,person,note,a_x,a_y,a_z", "0.02,12,B,,1,2,3", "0.0,10,A,x,4,5,6", "0.01,11,B,,,8,9"]
    found = read_table(table(tmp_path / "a.csv", *(line.replace(",", sign) for line in lines)))
    assert found.people == ("B", "A") and found.fps == 100.0 and found.at.shape == (3, 2, 1, 3)
    assert found.at[2, 0, 0].tolist() == [1, 2, 3] and found.at[0, 1, 0].tolist() == [4, 5, 6]
    assert np.isnan(found.at[1, 0, 0, 0]) and found.at[1, 0, 0, 1] == 8 and np.isnan(found.at[1, 1]).all()


def test_columns_that_merely_end_in_an_axis_or_could_be_a_person_are_passed_over(tmp_path: Path) -> None:
    head = "id,timestamp,index,frame,person,time_s,a_x_m,a_y_m,a_z_m"
    found = read_table(table(tmp_path / "a.csv", head, "7,0,0,0,A,0,1,2,3", "8,500,1,1,A,0.5,4,5,6"))
    assert found.names == ("a",) and found.unit == "m" and found.people == ("A",) and found.fps == 2.0
    assert found.at[:, 0, 0].tolist() == [[1, 2, 3], [4, 5, 6]]
    assert read_table(table(tmp_path / "b.csv", "ID,a_x,a_y,a_z", "7,1,2,3", "8,4,5,6")).people == ("7", "8")


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (["a,b", "1,2"], "no columns of joints, such as left_hip_x_m, left_hip_y_m, left_hip_z_m; it has a, b"),
        (["frame,joint,x,y,z", "0,hip,1,2,3"], "a row for each joint is not read: make columns of them"),
        (["frame,a_x,a_y", "0,1,2"], "x and y alone are places in a picture: positions in space are needed"),
        (["a_x,a_y,a_z"], "holds no rows under a line of names"),
        (["a_x,a_y,a_z", "1,2"], "line 2: 2 cells, fewer than names"),
        (["frame,a_x,a_y,a_z", "1,0,0,0", "1,0,0,0"], "line 3: a second row for frame 0; is a column person missing"),
        (["frame,a_x,a_y,a_z", "", "1,0,0,0", ",,,", "1,0,0,0"], "line 5: a second row for frame 0"),
        (["a_x,a_y,a_z", "", "1,2"], "line 3: 2 cells, fewer than names"),
        (["id,a_x,a_y,a_z", "A,1,2,3", "A,1,2,3", "B,1,2,3"], "B has fewer rows .1. than A .2., and .* add a column"),
        (["frame,a_x,a_y,a_z", "0.5,0,0,0"], "frame 0.5: expected whole numbers"),
        (["frame,a_x,a_y,a_z", "nan,0,0,0"], "frame nan: expected whole numbers"),
        (["a_x,a_y,a_z", "0,1e9,0"], r"a joint is 1e\+09 away: numbers are damaged"),
        (["frame,a_x,a_y,a_z", "0,0,0,0", "1e9,0,0,0"], "frames 0 to 1000000000, more than is read"),
        (["id,a_x,a_y,a_z", *(f"{k},1,2,3" for k in range(300))], "its column id names 300 people; is it a row's"),
        (["scene,a_x,a_y,a_z", "0,0,0,0", "1,0,0,0"], "holds 2 scenes; keep the rows of one"),
        (["a_x,a_y,a_z", '"' + "1" * 200_000], "line 2: field larger than field limit .* write it again as a table"),
        (["a_x_m,a_y_m,a_z_m,b_x_cm,b_y_cm,b_z_cm", "0,0,0,0,0,0"], "its columns are in different units"),
    ],
)
def test_what_cannot_be_meant_is_refused_in_one_line(lines: list[str], said: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=said) as caught:
        read_table(table(tmp_path / "a.csv", *lines))
    assert str(caught.value).startswith(str(tmp_path / "a.csv")) and "\n" not in str(caught.value)


def test_a_table_in_another_encoding_is_told(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes("a_x,a_y,a_z\n1,2,3\n".encode("utf-16"))
    with pytest.raises(ValueError, match=r"a\.csv: is no text in UTF-8; save it again as CSV UTF-8"):
        read_table(tmp_path / "a.csv")


def test_without_frames_rows_of_one_time_are_of_one_frame(tmp_path: Path) -> None:
    lines = ["time_s,person,a_x,a_y,a_z"]
    for t in range(5):
        lines += [f"{t / 25},A,{t + 1},0,0", *([f"{t / 25 + 0.002},B,{t + 1},1,0"] if t >= 2 else [])]
    found = read_table(table(tmp_path / "a.csv", *lines))
    assert found.at.shape == (5, 2, 1, 3) and round(found.fps or 0) == 25
    assert np.isnan(found.at[:2, 1]).all() and found.at[2:, 1, 0, 0].tolist() == found.at[2:, 0, 0, 0].tolist()


@pytest.mark.parametrize("start", [0, 1_700_000_000])
@pytest.mark.parametrize("unit", [1, 10**3, 10**6, 10**7, 10**9])
def test_times_may_be_in_smaller_units_and_count_from_long_ago(unit: int, start: int, tmp_path: Path) -> None:
    rows = [f"{unit * start + unit * t // 25 if unit > 1 else start + t / 25},{t},1,2,3" for t in range(50)]
    assert read_table(table(tmp_path / "a.csv", "timestamp,frame,a_x,a_y,a_z", *rows)).fps == 25.0


@pytest.mark.parametrize("people", [1, 2])
def test_times_that_go_up_by_ones_are_numbers_of_frames(people: int, tmp_path: Path) -> None:
    rows = [f"{t},{who},{t},2,3" for t in (7, 8, 9, 11) for who in "AB"[:people]]
    found = read_table(table(tmp_path / "a.csv", "t,person,a_x,a_y,a_z", *rows))
    assert found.fps is None and found.told == "its column t counts frames" and found.first == 7
    assert found.at[:, -1, 0, 0].tolist()[:3] == [7, 8, 9] and np.isnan(found.at[3]).all() and len(found.at) == 5
    rows = [f"{30 * t},{t},1,2,3" for t in range(4)]  # each second one of a film of 30 a second
    found = read_table(table(tmp_path / "a.csv", "frame,time,a_x,a_y,a_z", *rows))
    assert (found.fps, found.step, found.told) == (1.0, 30, "")


def test_frames_that_are_counted_in_steps_tell_the_unit_of_times(tmp_path: Path) -> None:
    rows = [f"{5 * t},{200_000 * t},1,2,3" for t in range(9)]  # of ticks they would be 250 a second
    found = read_table(table(tmp_path / "a.csv", "frame,time,a_x,a_y,a_z", *rows))
    assert found.fps == 5.0 and found.told == "its times are taken as microseconds"


def test_a_joint_at_zero_is_missing(tmp_path: Path) -> None:
    found = read_table(table(tmp_path / "a.csv", "a_x,a_y,a_z,b_x,b_y,b_z", "0,0,0,1,0,0", "0.0,1,0,0,0,0.0"))
    assert np.isnan(found.at[[0, 1], 0, [0, 1]]).all() and found.at[0, 0, 1].tolist() == [1, 0, 0]


def test_numbers_may_have_decimal_commas_between_semicolons(tmp_path: Path) -> None:
    found = read_table(table(tmp_path / "a.csv", "time;a_x;a_y;a_z", "0,00;1,5;2;3", "0,04;4;5;-0,25"))
    assert found.fps == 25.0 and found.at[:, 0, 0].tolist() == [[1.5, 2, 3], [4, 5, -0.25]]


@pytest.mark.parametrize("first", ["sep=;", '"sep=;"', "SEP=;", "\ufeffsep=;", "sep=;;;;"])
def test_the_line_that_tells_spreadsheets_the_sign_is_no_line_of_names(first: str, tmp_path: Path) -> None:
    lines = ["time;a_x;a_y;a_z", "0,00;1,5;2;3", "0,04;4;5;-0,25"]
    found = read_table(table(tmp_path / "a.csv", first, *lines))
    assert found.fps == 25.0 and found.at[:, 0, 0].tolist() == [[1.5, 2, 3], [4, 5, -0.25]]
    bars = read_table(table(tmp_path / "b.csv", "sep=|", *(line.replace(";", "|") for line in lines)))
    assert bars.at.tolist() == found.at.tolist()
    with pytest.raises(ValueError, match=r"a\.csv, line 4: 2 cells, fewer than names"):
        read_table(table(tmp_path / "a.csv", first, *lines[:2], "0,04;4"))


def test_frames_that_are_counted_in_steps_are_the_files_frames(tmp_path: Path) -> None:
    found = read_table(
        table(tmp_path / "a.csv", "frame,time,a_x,a_y,a_z", *(f"{t},{t / 50},1,2,3" for t in (10, 15, 25)))
    )
    assert found.step == 5 and found.at.shape[0] == 4 and found.fps == 10.0 and np.isnan(found.at[2]).all()


@pytest.mark.parametrize("who", [",A", ""], ids=["a person is named", "nobody is"])
@pytest.mark.parametrize("unit", [1.0, 1000.0], ids=["s", "ms"])
def test_without_frames_times_tell_where_rows_are_missing(who: str, unit: float, tmp_path: Path) -> None:
    rows = [f"{round(unit * t / 30, 0 if unit > 1 else 3)},{t + 1},0,0{who}" for t in range(90) if not 30 <= t < 60]
    found = read_table(table(tmp_path / "a.csv", f"time,a_x,a_y,a_z{',person' if who else ''}", *rows))
    there = np.isfinite(found.at[:, 0, 0, 0])
    assert len(found.at) == 90 and found.fps == 30.0 and not there[30:60].any() and there.sum() == 60
    assert (found.at[there, 0, 0, 0] == np.nonzero(there)[0] + 1).all()


@pytest.mark.parametrize("late", [[0, 0, 0, 0, 0, 1], [0.0, 0.033, 0.066, 0.116, 0.149, 0.182]], ids=["coarse", "late"])
def test_times_that_are_coarse_or_half_a_frame_late_have_no_gaps(late: list[float], tmp_path: Path) -> None:
    found = read_table(table(tmp_path / "a.csv", "time,a_x,a_y,a_z", *(f"{time},1,2,3" for time in late)))
    assert len(found.at) == 6 and np.isfinite(found.at).all()


def test_times_far_apart_are_refused_rather_than_filled(tmp_path: Path) -> None:
    rows = (f"{time},1,2,3" for time in (0, 0.04, 0.08, 86400))
    with pytest.raises(ValueError, match=r"times of 86400 seconds, more frames than are read \(216000\)"):
        read_table(table(tmp_path / "a.csv", "time,a_x,a_y,a_z", *rows))


def test_a_row_without_anything_is_a_frame_without_anybody_where_rows_are_counted(tmp_path: Path) -> None:
    found = read_table(table(tmp_path / "a.csv", "a_x,a_y,a_z", "1,2,3", ",,", "", "4,5,6", ",,", ""))
    assert found.at.shape[0] == 3 and np.isnan(found.at[1]).all() and found.at[2, 0, 0].tolist() == [4, 5, 6]


@pytest.mark.parametrize("start", [0, 1_700_000_000])
@pytest.mark.parametrize("counted", ["", "frame,"])
def test_times_of_whole_seconds_are_seconds(counted: str, start: int, tmp_path: Path) -> None:
    """Of many rows in a second each; they were taken for milliseconds."""
    rows = [f"{counted and f'{k},'}{start + k // 30},1,2,3" for k in range(121)]
    found = read_table(table(tmp_path / "a.csv", f"{counted}timestamp,a_x,a_y,a_z", *rows))
    assert (found.fps, len(found.at), found.told) == (30.0, 121, "")


SIDES = [
    f"{side}_{part}" for side in ("left", "right") for part in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")
]


@pytest.mark.parametrize(
    "name", ["{who}_{joint}_{axis}", "{who}:{joint}.{axis}", "{joint}_{who}_{axis}", "{axis}_{who}_{joint}"]
)
@pytest.mark.parametrize("order", ["people first", "joints first"])
def test_people_may_be_side_by_side_in_a_row(name: str, order: str, tmp_path: Path) -> None:
    pairs = [(who, joint) for who in ("anna", "ben") for joint in SIDES]
    pairs = pairs if order == "people first" else sorted(pairs, key=lambda pair: SIDES.index(pair[1]))
    head = [name.format(who=who, joint=joint, axis=axis) for who, joint in pairs for axis in "xyz"]
    at = {pair: [100 * (pair[0] == "ben") + SIDES.index(pair[1]) + 1, 2, 3] for pair in pairs}
    row = ",".join(str(number) for pair in pairs for number in at[pair])
    found = read_table(table(tmp_path / "a.csv", "time," + ",".join(head), f"0,{row}", f"0.04,{row}"))
    assert found.people == ("anna", "ben") and set(found.names) == set(SIDES) and found.fps == 25.0
    for p, who in enumerate(found.people):
        assert found.at[1, p].tolist() == [at[who, joint] for joint in found.names]


def test_sides_are_no_people_and_who_has_other_joints_is_not_beside(tmp_path: Path) -> None:
    def named(names: list[str]) -> tuple[str, ...]:
        head = ",".join(f"{name}_{axis}" for name in names for axis in "xyz")
        return read_table(table(tmp_path / "a.csv", head, ",".join(["1"] * 3 * len(names)))).people

    assert named(SIDES) == ("",)
    assert named([f"rig_{name}" for name in SIDES]) == ("",)
    assert named([f"{who}_{name}" for who in "AB" for name in SIDES] + ["A_neck"]) == ("",)
