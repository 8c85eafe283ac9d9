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
        (["a_x,a_y,a_z"], "holds no rows under a line of names"),
        (["a_x,a_y,a_z", "1,2"], "line 2: 2 cells, fewer than names"),
        (["frame,a_x,a_y,a_z", "1,0,0,0", "1,0,0,0"], "line 3: a second row for frame 0; is a column person missing"),
        (["frame,a_x,a_y,a_z", "0.5,0,0,0"], "frame 0.5: expected whole numbers"),
        (["frame,a_x,a_y,a_z", "nan,0,0,0"], "frame nan: expected whole numbers"),
        (["a_x,a_y,a_z", "0,1e9,0"], r"a joint is 1e\+09 away: numbers are damaged"),
        (["frame,a_x,a_y,a_z", "0,0,0,0", "1e9,0,0,0"], "frames 0 to 1000000000, more than is read"),
        (["scene,a_x,a_y,a_z", "0,0,0,0", "1,0,0,0"], "holds 2 scenes; keep the rows of one"),
        (["a_x,a_y,a_z", '"' + "1" * 200_000], "line 2: field larger than field limit .* write it again as a table"),
        (["a_x_m,a_y_m,a_z_m,b_x_cm,b_y_cm,b_z_cm", "0,0,0,0,0,0"], "its columns are in different units"),
    ],
)
def test_what_cannot_be_meant_is_refused_in_one_line(lines: list[str], said: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=said) as caught:
        read_table(table(tmp_path / "a.csv", *lines))
    assert str(caught.value).startswith(str(tmp_path / "a.csv")) and "\n" not in str(caught.value)
