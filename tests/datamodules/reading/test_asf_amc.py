"""The ASF/AMC reader and its glitch finder."""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from magnet.datamodules.fakes.cmu import write_amc, write_asf
from magnet.datamodules.reading.asf_amc import AmcRecording, AsfSkeleton, read_amc, read_asf, together
from magnet.datamodules.reading.cmu_joints import repaired
from magnet.motion.runs import true_runs
from tests.datamodules.slow_cmu import slow_ends


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    return write_asf(tmp_path / "60.asf"), write_amc(tmp_path / "60_01.amc", 90)


def read(files: tuple[Path, Path], fps: float = 60.0) -> AmcRecording:
    return read_amc(files[1], read_asf(files[0]), fps)


def changed(files: tuple[Path, Path], old: str, new: str, count: int = 1) -> tuple[Path, Path]:
    text = files[1].read_bytes().decode()
    assert old in text
    files[1].write_bytes(text.replace(old, new, count).encode())
    return files


def assert_ends_are_the_references(asf: Path, amc: Path, recording: AmcRecording, frames: list[int]) -> None:
    _, end = recording.world()
    for frame in frames:
        for name, place in slow_ends(asf, amc, frame).items():
            found = end[frame, recording.skeleton.names.index(name)]
            np.testing.assert_allclose(found, place, atol=1e-9, err_msg=f"{name}, frame {frame}")


def test_bone_ends_are_the_slow_references(files: tuple[Path, Path]) -> None:
    assert_ends_are_the_references(*files, read(files), [0, 7, 89])


@pytest.mark.parametrize("take", ["salsa/60_10", "salsa/61_10", "singles/143_35", "singles/05_01"])
def test_bone_ends_of_real_recordings_are_the_slow_references(cmu_root: Path, take: str) -> None:
    amc = cmu_root / f"{take}.amc"
    asf = amc.with_name(amc.name.split("_")[0] + ".asf")
    recording = read_amc(amc, read_asf(asf), 60)
    assert_ends_are_the_references(asf, amc, recording, [0, 100, recording.frames - 1])


def test_real_couples_are_as_the_recordings_readme_says(cmu_root: Path) -> None:
    people = [read_amc(cmu_root / f"salsa/{s}_05.amc", read_asf(cmu_root / f"salsa/{s}.asf"), 60) for s in (60, 61)]
    leader, follower = together(people)
    assert leader.frames == follower.frames and len(leader.skeleton.names) == 31
    assert sum(leader.skeleton.moving.values()) == 62
    apart = np.linalg.norm((leader.root - follower.root)[:, [0, 2]], axis=-1)
    assert 0.19 <= apart.min() <= 0.43 and 0.61 <= np.median(apart) <= 0.85


def calls_of(path: Path, skeleton: AsfSkeleton) -> Counter[str]:
    """How often functions of Python, and of C, are called to read a file."""
    events: list[str] = []
    before = sys.getprofile()
    sys.setprofile(lambda frame, event, value: events.append(event))
    try:
        read_amc(path, skeleton, 60)
    finally:
        sys.setprofile(before)
    return Counter(events)


def test_a_line_of_a_large_file_costs_four_calls_and_a_frame_none_beside(tmp_path: Path) -> None:
    skeleton = read_asf(write_asf(tmp_path / "60.asf"))
    files = [write_amc(tmp_path / f"60_{frames}.amc", frames) for frames in (50, 400)]
    few, many = (calls_of(file, skeleton) for file in files)
    less, more = (len(file.read_text().splitlines()) for file in files)
    assert many["call"] - few["call"] <= 4 * (more - less)
    assert many["c_call"] - few["c_call"] <= 7.1 * (more - less)


def test_bones_may_come_in_another_order_in_a_later_frame(files: tuple[Path, Path]) -> None:
    before = read(files)
    lines = files[1].read_text().split("\n")
    start = lines.index("40")
    end = lines.index("41")
    files[1].write_text("\n".join([*lines[: start + 1], *lines[start + 1 : end][::-1], *lines[end:]]))
    after = read(files)
    np.testing.assert_array_equal(before.local, after.local)


# -- time --------------------------------------------------------------------------------------


def test_frames_at_whole_steps_are_returned_as_they_are(files: tuple[Path, Path]) -> None:
    recording = read(files)
    half = recording.resampled(30)
    assert half.fps == 30 and half.frames == 45
    np.testing.assert_array_equal(half.local, recording.local[::2])
    np.testing.assert_array_equal(half.root, recording.root[::2])


def test_frames_between_lie_on_the_geodesic_at_exact_times(files: tuple[Path, Path]) -> None:
    recording = read(files, fps=50)
    found = recording.resampled(30)
    times = np.arange(recording.frames) / 50
    assert found.frames == int(times[-1] * 30 + 1e-9) + 1
    for k in (0, 5):
        slerp = Slerp(times, Rotation.from_matrix(recording.local[:, k]))
        np.testing.assert_allclose(found.local[:, k], slerp(np.arange(found.frames) / 30).as_matrix(), atol=1e-9)
    for axis in range(3):
        line = np.interp(np.arange(found.frames) / 30, times, recording.root[:, axis])
        np.testing.assert_allclose(found.root[:, axis], line, atol=1e-12)


# -- bad input ---------------------------------------------------------------------------------


def test_truncated_file_names_line_frame_and_missing_bones(files: tuple[Path, Path]) -> None:
    text = files[1].read_text()
    files[1].write_text(text[: text.index("\n60\n") + 300])
    with pytest.raises(ValueError, match=r"60_01\.amc:\d+: .*"):
        read(files)
    cut = text[: text.index("\nlhand", text.index("\n60\n"))]
    files[1].write_text(cut)
    with pytest.raises(ValueError, match=r"60_01\.amc:\d+: frame 60 ends without .*lhand.*truncated"):
        read(files)


def test_unknown_bone_is_named_with_its_line(files: tuple[Path, Path]) -> None:
    with pytest.raises(ValueError, match=r"60_01\.amc:\d+: unknown bone 'tail'; 60\.asf has root"):
        read(changed(files, "ltoes", "tail"))


def test_wrong_number_of_values_is_named_with_its_line(files: tuple[Path, Path]) -> None:
    with pytest.raises(ValueError, match=r"60_01\.amc:\d+: got 2 numbers, expected 1"):
        read(changed(files, "ltoes", "ltoes 1.0"))


def test_text_for_a_number_is_named_with_its_line(files: tuple[Path, Path]) -> None:
    with pytest.raises(ValueError, match=r"60_01\.amc:\d+: .*'six'"):
        read(changed(files, "root 0", "root six"))


@pytest.mark.parametrize("word", ["nan", "inf"])
def test_nan_and_infinity_are_named_with_their_line(files: tuple[Path, Path], word: str) -> None:
    with pytest.raises(ValueError, match=r"60_01\.amc:4: .*(NaN|:5:)|60_01\.amc:5: holds NaN"):
        read(changed(files, "root 0", f"root {word}"))


def test_no_frames_is_an_error(files: tuple[Path, Path]) -> None:
    files[1].write_text(":FULLY-SPECIFIED\n:DEGREES\n")
    with pytest.raises(ValueError, match="holds no frames"):
        read(files)


def test_missing_frames_are_an_error(files: tuple[Path, Path]) -> None:
    with pytest.raises(ValueError, match="frame 51 follows frame 49: frames are missing"):
        text = files[1].read_bytes().decode().replace("\r", "")
        files[1].write_text(text[: text.index("\n50\n")] + text[text.index("\n51\n") :])
        read(files)


def test_skeleton_without_hierarchy_is_an_error(files: tuple[Path, Path]) -> None:
    files[0].write_text(files[0].read_text().split(":hierarchy")[0])
    with pytest.raises(ValueError, match="lacks :root order or :hierarchy"):
        read(files)


def test_unequal_lengths_are_an_error_that_trim_mends(files: tuple[Path, Path]) -> None:
    first = read(files)
    second = replace(first, root=first.root[:80], local=first.local[:80], path=Path("61_01.amc"))
    with pytest.raises(ValueError, match=r"60_01\.amc has 90 frames, 61_01\.amc 80; .*trim=True"):
        together([first, second])
    assert [person.frames for person in together([first, second], trim=True)] == [80, 80]


# -- glitches ----------------------------------------------------------------------------------


def test_a_frame_that_jumps_is_found_and_interpolated(files: tuple[Path, Path]) -> None:
    recording = read(files)
    root = recording.root.copy()
    root[40] += [0.5, 0.0, 0.0]
    mended, found = repaired(replace(recording, root=root))
    assert found.jumps == found.body_jumps == 2 and found.repaired[40] and not found.masked.any()
    assert np.abs(mended.root - recording.root).max() < 0.01
    kept = ~found.repaired
    np.testing.assert_array_equal(mended.local[kept], recording.local[kept])


def test_a_long_glitch_is_masked(files: tuple[Path, Path]) -> None:
    recording = read(files)
    local = recording.local.copy()
    local[30:45, 0] = local[30:45, 0] @ np.diag([-1.0, 1.0, -1.0])  # turned round for a quarter of a second
    _, found = repaired(replace(recording, local=local))
    ((start, stop),) = true_runs(found.masked)
    assert 25 <= start <= 30 and 45 <= stop <= 50


def test_a_clean_recording_is_returned_as_it_is(files: tuple[Path, Path]) -> None:
    recording = read(files)
    mended, found = repaired(recording)
    assert mended is recording and found.jumps == 0


def test_jumps_in_the_salsa_takes_are_those_of_the_recordings_readme(cmu_root: Path) -> None:
    # Its 72 count four takes more; what it says of single takes is met exactly.
    jumps = {}
    for take in (5, 8, 9, 11):
        recording = read_amc(cmu_root / f"salsa/61_{take:02}.amc", read_asf(cmu_root / "salsa/61.asf"), 60)
        jumps[take] = repaired(recording)[1].jumps
    assert jumps == {5: 7, 8: 7, 9: 13, 11: 7}
