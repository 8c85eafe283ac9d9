"""Frames of a table's rows by their times: what is told, and what two recordings, rates or people leave untold."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from magnet.export.joints_table import JointTable, read_table

ONE, TWO = "time,a_x,a_y,a_z", "person,time,a_x,a_y,a_z"
CLOCK = [t / 30 for t in range(60)]


def read(folder: Path, head: str, rows: Iterable[str]) -> JointTable:
    (folder / "a.csv").write_text("\n".join([head, *rows]) + "\n")
    return read_table(folder / "a.csv")


def alone(times: Iterable[float]) -> list[str]:
    return [f"{time:.4f},{time + 1:.4f},0,0" for time in times]


def rows_of(name: str, times: Iterable[float]) -> list[str]:
    return [f"{name},{time:.4f},{time + 1:.4f},0,0" for time in times]


def whole(found: JointTable) -> bool:
    return bool(np.isfinite(found.at).all())


@pytest.mark.parametrize("late", [0.0, 0.017, 0.5], ids=["at 0", "between frames", "later"])
@pytest.mark.parametrize("order", [1, -1], ids=["first", "second"])
def test_a_clock_that_starts_again_is_two_recordings(late: float, order: int, tmp_path: Path) -> None:
    both = [CLOCK, [time + late for time in CLOCK]][::order]
    said = r"a.csv, line 62: times go back from \S+ to \S+ and through the same moments again"
    with pytest.raises(
        ValueError, match=rf"{said}, as of two recordings, or of two .*: save each in a file of its own"
    ):
        read(tmp_path, ONE, alone(both[0] + both[1]))
    for who in "AB":
        rows = [row for name in "AB" for times in (both if name == who else both[:1]) for row in rows_of(name, times)]
        with pytest.raises(ValueError, match=rf"line \d+: times go back .* for {who}, as of two recordings: save each"):
            read(tmp_path, TWO, rows)


@pytest.mark.parametrize("head", ["frame,a_x,a_y,a_z", "frame,time,a_x,a_y,a_z"])
def test_frames_that_start_again_are_two_recordings(head: str, tmp_path: Path) -> None:
    times = "," if "time" not in head else ",{:.4f},"
    rows = [f"{t}{times.format(k / 30)}1,2,3" for k, t in enumerate([*range(60), *range(60)])]
    with pytest.raises(ValueError, match="line 62: frames go back from 59 to 0 and through the same moments again"):
        read(tmp_path, head, rows)


def test_times_that_start_again_where_frames_go_on_are_two_recordings(tmp_path: Path) -> None:
    rows = [f"{k},{time:.4f},1,2,3" for k, time in enumerate(CLOCK + CLOCK)]
    with pytest.raises(ValueError, match=r"line 62: times go back from 1.9667 to 0 s where frames go on, as of two"):
        read(tmp_path, "frame,time,a_x,a_y,a_z", rows)


def test_rows_may_come_in_any_order_of_time(tmp_path: Path) -> None:
    mixed = np.random.default_rng(0).permutation(60)
    orders = [
        [CLOCK[k] for k in mixed],
        CLOCK[::-1],
        [*CLOCK[30:], *CLOCK[:30]],
        [*CLOCK[:9], CLOCK[10], CLOCK[9], *CLOCK[11:]],
    ]
    for times in orders:
        found = read(tmp_path, ONE, alone(times))
        assert found.fps == 30.0 and found.at[:, 0, 0, 0].round(3).tolist() == [round(time + 1, 3) for time in CLOCK]
    found = read(tmp_path, TWO, [*rows_of("A", CLOCK), *rows_of("B", CLOCK)])
    assert found.at.shape[:2] == (60, 2) and whole(found)


def test_a_rate_that_changes_leaves_each_row_at_its_time(tmp_path: Path) -> None:
    for later in (60, 25, 50):
        times = [*CLOCK, *(2 + np.arange(2 * later) / later)]
        found = read(tmp_path, ONE, alone(times))
        assert found.fps is not None
        at = found.at[:, 0, 0, 0] - 1
        there = np.isfinite(at)
        assert there.sum() == len(times)
        assert np.abs(np.arange(len(at)) / found.fps - at)[there].max() < 0.6 / found.fps


def test_rows_that_no_rate_fits_are_refused(tmp_path: Path) -> None:
    gaps = [*([1 / 30] * 40), *([1 / 200] * 3), *([1 / 20] * 40)]
    with pytest.raises(ValueError, match=r"rows come between 20 and 200 times a second, .* bring them to one rate"):
        read(tmp_path, ONE, alone(np.cumsum(gaps)))


def test_people_of_different_rates_need_a_file_each(tmp_path: Path) -> None:
    for other, said in ((60, "60"), (25, "25")):
        rows = [*rows_of("A", CLOCK), *rows_of("B", np.arange(2 * other) / other)]
        with pytest.raises(
            ValueError, match=rf"different rates \(A 30, B ({said}|59.9) a second\): give each a file of"
        ):
            read(tmp_path, TWO, rows)
    seldom = [*rows_of("A", CLOCK), *rows_of("B", [t for k, t in enumerate(CLOCK) if k % 5 in (0, 1, 3)])]
    found = read(tmp_path, TWO, seldom)  # is often lost
    assert len(found.at) == 60 and np.isfinite(found.at[:, 1, 0, 0]).sum() == 36


def test_people_of_clocks_that_are_part_of_a_frame_apart_share_frames(tmp_path: Path) -> None:
    found = read(tmp_path, TWO, [*rows_of("A", CLOCK), *rows_of("B", [time + 1 / 60 for time in CLOCK])])
    assert found.fps == 30.0 and len(found.at) <= 61 and np.isfinite(found.at[1:60]).all()
    found = read(tmp_path, TWO, [*rows_of("A", np.arange(1200) / 120), *rows_of("B", 0.004 + np.arange(1200) / 119.9)])
    assert len(found.at) <= 1201 and round(found.fps or 0) == 120
    rough = np.random.default_rng(0).normal(0.0, 0.003, (2, 60))
    found = read(tmp_path, TWO, [*rows_of("A", CLOCK + rough[0]), *rows_of("B", CLOCK + rough[1])])
    assert len(found.at) == 60 and whole(found) and abs((found.fps or 0) - 30) < 0.2


def test_clocks_that_run_apart_are_refused(tmp_path: Path) -> None:
    rows = [*rows_of("A", np.arange(900) / 30), *rows_of("B", 0.01 + np.arange(900) / 29)]
    with pytest.raises(
        ValueError, match=r"times of people run apart for \w by up to [\d.]+ s: bring them to one clock"
    ):
        read(tmp_path, TWO, rows)


@pytest.mark.parametrize("start", [0, 1_700_000_000])
@pytest.mark.parametrize("apart", [True, False], ids=["one after the other", "by turns"])
@pytest.mark.parametrize("digits", [0, 1])
def test_several_people_may_have_many_rows_of_one_time(digits: int, apart: bool, start: int, tmp_path: Path) -> None:
    """Whole seconds, or tenths, as spreadsheets write them."""
    each = [[f"{who},{start + int(10**digits * t / 30) / 10**digits},{t + 1},0,0" for t in range(121)] for who in "AB"]
    rows = each[0] + each[1] if apart else [row for pair in zip(*each, strict=True) for row in pair]
    found = read(tmp_path, TWO, rows)
    assert found.fps == 30.0 and found.at[:, :, 0, 0].tolist() == [[t + 1, t + 1] for t in range(121)]


def test_rows_of_one_time_of_which_somebody_lacks_some_are_refused(tmp_path: Path) -> None:
    rows = [f"{who},{t // 30},1,2,3" for t in range(121) for who in "AB" if who == "A" or t != 40]
    with pytest.raises(
        ValueError, match=r"a.csv: at 1 s A has 30 rows and B 29, .*; add a column frame, or write times"
    ):
        read(tmp_path, TWO, rows)


def test_rows_of_nobody_that_jump_between_two_places_are_two_people(tmp_path: Path) -> None:
    rows = [f"{time:.4f},{time / 9 + who:.4f},0,{time / 9:.4f}" for time in CLOCK for who in (0, 1)]
    with pytest.raises(
        ValueError, match="2 rows of each time, at different places by turns, as of 2 people: add a col"
    ):
        read(tmp_path, ONE, rows)
    found = read(tmp_path, ONE, [f"{k // 2},{k / 90:.4f},0,0" for k in range(120)])  # one who goes on
    assert len(found.at) == 120


@pytest.mark.parametrize("row", [9, 20, 50])
@pytest.mark.parametrize("late", [2, 3, 8, -8])
def test_a_row_that_comes_late_or_early_is_no_second_recording(row: int, late: int, tmp_path: Path) -> None:
    times = [time for k, time in enumerate(CLOCK) if k != row]
    times.insert(row + late, CLOCK[row])
    found = read(tmp_path, ONE, alone(times))
    assert found.fps == 30.0 and found.at[:, 0, 0, 0].round(3).tolist() == [round(time + 1, 3) for time in CLOCK]


@pytest.mark.parametrize("fps", [5.0, 15.0, 30.0, 60.0])
@pytest.mark.parametrize("begin", [0.0, 0.3, 0.9])
def test_times_in_whole_seconds_say_the_rate_by_when_they_change(fps: float, begin: float, tmp_path: Path) -> None:
    """The first and the last second are not whole."""
    times = [int(begin + 1e-6 + t / fps) for t in range(int(4.5 * fps))]
    rows = [f"{time},{t},0,0" for t, time in enumerate(times)]
    assert read(tmp_path, ONE, rows).fps == pytest.approx(fps)
    assert read(tmp_path, TWO, [f"{name},{row}" for name in "AB" for row in rows]).fps == pytest.approx(fps)
