"""People by joint positions: our own table, and those of trackers in their units, axes and gaps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import magnet
from magnet import checkpoints, cli
from magnet.body import Body
from magnet.body.joints import JOINT_NAMES
from magnet.export import save_csv
from magnet.export.cutting import Begin, shared_frames
from magnet.export.read_options import Reading
from magnet.export.reading import read
from magnet.motion.scene import Scene

COCO = [
    "nose",
    *(
        f"{side}_{part}"
        for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
        for side in ("left", "right")
    ),
]
TO = {"y": np.eye(3), "z": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])}
"""Rotation of our world to one of this axis up."""


@pytest.fixture(scope="module")
def salsa() -> Scene:
    """A generated couple's dance of two seconds."""
    return Scene.load(checkpoints.FOLDER / "duet" / "scenes" / "duet.npz")


def tracked(
    scene: Scene, body: Body, path: Path, up: str = "y", unit: float = 1.0, noise: float = 0.0, lost=()
) -> Path:
    """A tracker's table of COCO's keypoints. lost: (frame, person, joint's name) of cells that are empty"""
    joints = body.joints(scene)[0].double().numpy() @ TO[up].T
    joints = unit * (joints + np.random.default_rng(0).normal(0, noise, joints.shape))
    places = [JOINT_NAMES.index("head" if name == "nose" else name) for name in COCO]
    lines = ["frame,time_s,person," + ",".join(f"{name}_{axis}" for name in COCO for axis in "xyz")]
    for t in range(scene.frames):
        for p in range(scene.agents):
            cells = [
                "" if (t, p, name) in lost else f"{number:.5f}"
                for name, place in zip(COCO, places, strict=True)
                for number in joints[t, p, place]
            ]
            lines.append(f"{t},{t / scene.fps:.5f},{'AB'[p]}," + ",".join(cells))
    path.write_text("\n".join(lines) + "\n")
    return path


def off(got: Scene, truth: Scene, body: Body) -> float:
    """Mean distance of joints, in metres."""
    return float((body.joints(got) - body.joints(truth)).norm(dim=-1).mean())


def test_our_own_table_is_read_back_to_some_millimetres(salsa: Scene, body: Body, tmp_path: Path) -> None:
    got = read(save_csv(salsa, tmp_path / "a.csv", body))
    assert off(got.scene, salsa, body) < 0.006 and got.scene.fps == 30.0 and got.scene.valid is None
    assert "our own names, 22 joints; unit m, y up, 30 fps" in got.notes[0] and len(got.notes) == 1


@pytest.mark.parametrize(("up", "unit", "name"), [("y", 1.0, "m"), ("z", 100.0, "cm"), ("z", 1000.0, "mm")])
def test_twelve_joints_of_a_tracker_are_people_in_any_unit_and_axis(
    up: str, unit: float, name: str, salsa: Scene, body: Body, tmp_path: Path
) -> None:
    path = tracked(salsa, body, tmp_path / "a.csv", up, unit, noise=0.005)
    got = read(path, options=Reading(keep_floor=True))
    assert off(got.scene, salsa, body) < 0.02 and got.scene.agents == 2
    assert f"unit {name}, {up} up, 30 fps" in got.notes[0] and "warning" not in got.notes[0]


def test_feet_without_toes_are_level_on_the_floor(salsa: Scene, body: Body, tmp_path: Path) -> None:
    got = read(tracked(salsa, body, tmp_path / "a.csv"), options=Reading(keep_floor=True))
    toes, heels = ([JOINT_NAMES.index(f"{side}_{part}") for side in ("left", "right")] for part in ("foot", "ankle"))
    for scene in (got.scene, salsa):  # of a body at rest toes are 5 cm lower
        joints = body.joints(scene)[0]
        drop = (joints[:, :, heels, 1] - joints[:, :, toes, 1])[joints[:, :, heels, 1] < 0.10]
        assert len(drop) > 50 and 0.02 < float(drop.median()) < 0.08


def test_joints_that_are_lost_are_bridged_and_frames_without_hips_are_not_valid(
    salsa: Scene, body: Body, tmp_path: Path
) -> None:
    wrist = [(t, 0, "left_wrist") for t in range(20, 24)]
    hip = [(t, 1, "right_hip") for t in (40, 41)]
    got = read(tracked(salsa, body, tmp_path / "a.csv", lost=[*wrist, *hip]), options=Reading(keep_floor=True))
    assert got.scene.valid is not None and (~got.scene.valid[0]).nonzero()[:, 0].tolist() == [40, 41]
    assert "2 of 64 frames lack somebody's hips or shoulders: not valid" in got.notes[0]
    away = (body.joints(got.scene) - body.joints(salsa)).norm(dim=-1)[0, 20:24, 0, JOINT_NAMES.index("left_wrist")]
    assert float(away.max()) < 0.15
    smooth = body.joints(got.scene)[0, :, 1].diff(n=2, dim=0).norm(dim=-1).amax()
    assert float(smooth) < 2 * float(body.joints(salsa)[0, :, 1].diff(n=2, dim=0).norm(dim=-1).amax())


def test_a_table_without_a_time_asks_for_the_rate_and_a_file_a_person_is_one_scene(
    salsa: Scene, body: Body, tmp_path: Path
) -> None:
    paths = []
    for p in range(2):
        path = tracked(salsa.people().select([p]), body, tmp_path / f"{p}.csv")
        rows = [line.split(",") for line in path.read_text().splitlines()]
        path.write_text("\n".join(",".join([row[0], *row[3:]]) for row in rows) + "\n")
        paths.append(path)
    with pytest.raises(ValueError, match=r"0\.csv: says no time; say its frames a second: --in_fps 30"):
        magnet.read(*paths)
    got = magnet.read(*paths, in_fps=60, fps=None, keep_floor=True)
    assert got.fps == 60 and off(got, salsa, body) < 0.02


def test_whole_seconds_that_change_once_tell_no_rate(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("time_s,left_hip_x,left_hip_y,left_hip_z\n" + "".join(f"{t // 30},{t},1,2\n" for t in range(50)))
    with pytest.raises(ValueError, match="its times tell no rate, as where they hardly change; say its frames a sec"):
        read(path)


@pytest.mark.parametrize("without", ["time", ""])
def test_one_frame_needs_no_rate(without: str, salsa: Scene, body: Body, tmp_path: Path) -> None:
    path = tracked(salsa.slice(8, 9), body, tmp_path / "a.csv")
    if without:
        rows = [line.split(",") for line in path.read_text().splitlines()]
        path.write_text("\n".join(",".join([row[0], *row[2:]]) for row in rows) + "\n")
    got = read(path, options=Reading(keep_floor=True))
    assert got.scene.fps == 30 and got.scene.frames == 1 and off(got.scene, salsa.slice(8, 9), body) < 0.1
    assert "it has one frame and so no rate: 30 frames a second, unless --in_fps says others" in got.notes[0]
    told = read(path, options=Reading(in_fps=60, fps=None))
    assert told.scene.fps == 60 and "no rate" not in told.notes[0]


def test_another_rate_than_that_of_the_times_is_refused(salsa: Scene, body: Body, tmp_path: Path) -> None:
    path = tracked(salsa, body, tmp_path / "a.csv")
    assert read(path, options=Reading(in_fps=30)).scene.fps == 30
    with pytest.raises(ValueError, match=r"a\.csv: says 30 frames a second; --in_fps 60 is for files that say nothing"):
        read(path, options=Reading(in_fps=60))


def test_few_frames_a_second_are_doubted_and_what_is_said_counts_instead(
    salsa: Scene, body: Body, tmp_path: Path
) -> None:
    path = tracked(salsa.replace(fps=4.0), body, tmp_path / "a.csv")
    assert "warning: its times make 4 frames a second" in read(path).notes[0]
    told = read(path, options=Reading(in_fps=30, keep_floor=True))
    assert told.scene.fps == 30 and off(told.scene, salsa, body) < 0.02 and "warning" not in told.notes[0]
    assert "its times make 4 frames a second; 30, as said, are taken" in told.notes[0]
    path = counted(tracked(salsa, body, tmp_path / "b.csv"))
    with pytest.raises(
        ValueError, match=r"b\.csv: its column time_s counts frames, and it says no time; say its frames"
    ):
        read(path)
    assert off(read(path, options=Reading(in_fps=30, keep_floor=True)).scene, salsa, body) < 0.02


def counted(path: Path) -> Path:
    """The same table, whose times are numbers of frames."""
    rows = [line.split(",") for line in path.read_text().splitlines()]
    path.write_text("\n".join(",".join([row[1] if not n else row[0], *row[2:]]) for n, row in enumerate(rows)) + "\n")
    return path


def test_joints_that_are_in_no_frame_are_named(salsa: Scene, body: Body, tmp_path: Path) -> None:
    lost = [(t, 1, name) for t in range(salsa.frames) for name in ("left_ankle", "right_wrist")]
    got = read(tracked(salsa, body, tmp_path / "a.csv", lost=lost))
    assert "warning: left_ankle, right_wrist of B: in no frame; made up of the body at rest" in got.notes[0]


@pytest.mark.parametrize(
    ("twelve", "backwards", "axis"), [(True, False, "x"), (True, True, "y"), (False, False, "z"), (False, True, "x")]
)
def test_people_of_a_left_handed_world_look_mirrored_and_others_do_not(
    twelve: bool, backwards: bool, axis: str, salsa: Scene, body: Body, tmp_path: Path
) -> None:
    scene = salsa.frames_at(torch.arange(salsa.frames - 1, -1, -1)) if backwards else salsa
    path = tracked(scene, body, tmp_path / "a.csv", "z") if twelve else save_csv(scene, tmp_path / "a.csv", body)
    assert "mirrored" not in read(path).notes[0]
    rows = [line.split(",") for line in path.read_text().splitlines()]
    those = [k for k, name in enumerate(rows[0]) if name.removesuffix("_m").endswith(f"_{axis}")]
    other = [[str(-float(cell)) if k in those else cell for k, cell in enumerate(row)] for row in rows[1:]]
    path.write_text("\n".join(",".join(row) for row in [rows[0], *other]) + "\n")
    said = "knees" if twelve else "knees and toes"
    assert f"warning: looks mirrored: {said} point backwards; if its world is left-handed" in read(path).notes[0]


def one_each(scene: Scene, body: Body, folder: Path, later: int, columns: str, by: int = 0) -> list[Path]:
    """A table of each of two people, with these columns. The second lacks the first `later` frames, the first
    half as many at the end, and the second's clock is `by` frames ahead."""
    paths = []
    for p in range(2):
        path = tracked(scene.people().select([p]), body, folder / f"{p}.csv")
        head, *rows = (line.split(",") for line in path.read_text().splitlines())
        kept = [k for k, name in enumerate(head) if name not in {"frame", "time_s", "person"} - set(columns.split())]
        for row in rows if p else []:
            row[:2] = str(int(row[0]) + by), str(float(row[1]) + by / scene.fps)
        rows = [head, *(rows[later:] if p else rows[: len(rows) - later // 2])]
        path.write_text("\n".join(",".join(row[k] for k in kept) for row in rows) + "\n")
        paths.append(path)
    return paths


@pytest.mark.parametrize(("columns", "trim"), [("frame", True), ("time_s", False), ("frame time_s", False)])
def test_files_of_one_clock_are_cut_to_the_moments_that_they_share(
    columns: str, trim: bool, salsa: Scene, body: Body, tmp_path: Path
) -> None:
    options = Reading(trim=trim, keep_floor=True, in_fps=30)
    got = read(one_each(salsa, body, tmp_path, 20, columns), options=options)
    assert got.scene.frames == 34 and off(got.scene, salsa.slice(20, 54), body) < 0.02
    what = "frame numbers" if "frame" in columns else "times"
    assert f"by their {what} files begin up to 0.667 s apart: each was cut to the 1.13 s of all" in got.notes
    part = read(one_each(salsa, body, tmp_path, 20, columns), options=replace(options, start=2, end=30))
    assert off(part.scene, salsa.slice(22, 30), body) < 0.02
    with pytest.raises(ValueError, match=rf"by their {what} files share no moment: .*0\.csv from 0 to 2\.13333 s, "):
        read(one_each(salsa, body, tmp_path, 0, columns, by=100), options=options)


def test_times_without_a_common_moment_count_for_nothing_beside_frames_that_begin_together() -> None:
    """As of sensors that count time since they were switched on."""
    paths = [Path("a.csv"), Path("b.csv")]
    begins = [Begin(0.0, second, 30.0) for second in (0.0, 100.0)]
    kept, notes = shared_frames(paths, [300, 300], [30.0, 30.0], begins)
    assert kept == [slice(None)] * 2
    assert notes == [
        "by their times files share no moment, and they begin at the same frame number: taken to begin together"
    ]
    kept, notes = shared_frames(paths, [300, 300], [30.0, 30.0], [Begin(0.0, second, 30.0) for second in (0.0, 2.0)])
    assert kept == [slice(60, 300), slice(0, 240)] and "by their times files begin up to 2 s apart" in notes[0]


def test_files_that_begin_together_or_tell_no_moment_are_as_they_were(salsa: Scene, body: Body, tmp_path: Path) -> None:
    options = Reading(keep_floor=True, in_fps=30)
    got = read(one_each(salsa, body, tmp_path, 0, "frame"), options=options)
    assert off(got.scene, salsa, body) < 0.02 and not any("apart" in note for note in got.notes)
    with pytest.raises(ValueError, match=r"lengths differ: .* cut all to the shortest with --trim"):
        read(one_each(salsa, body, tmp_path, 20, ""), options=options)


def test_unknown_joints_can_be_told_and_a_wrong_axis_or_unit_is_doubted(
    salsa: Scene, body: Body, tmp_path: Path
) -> None:
    path = tracked(salsa, body, tmp_path / "a.csv")
    path.write_text(path.read_text().replace("left_wrist", "point_9"))
    with pytest.raises(ValueError, match=r"cannot tell which joint is left_wrist; it has nose, .*--joint left_wrist="):
        read(path)
    told = read(path, options=Reading(joints={"left_wrist": "point_9"}, keep_floor=True))
    assert off(told.scene, salsa, body) < 0.02
    path = tracked(salsa, body, tmp_path / "b.csv")
    assert "up z, as said, leaves nobody upright: torsos point along y" in read(path, options=Reading(up="z")).notes[0]
    assert "unit cm, as said, makes legs 0.00" in read(path, options=Reading(unit="cm")).notes[0]
    path = tracked(salsa, body, tmp_path / "c.csv", unit=7.0)
    with pytest.raises(ValueError, match=r"legs are .* long, which fits no unit of length; say --in_unit"):
        read(path)


def test_the_commands_take_them(salsa: Scene, body: Body, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tracked(salsa, body, tmp_path / "a.csv", "z", 1000.0)
    assert cli.main(["export", str(path), str(tmp_path / "b.npz")]) == 0
    assert off(Scene.load(tmp_path / "b.npz"), salsa, body) < 0.1
    assert "a.csv: joint positions" in capsys.readouterr().out
    assert cli.main(["export", str(path), str(path)]) == 2
    assert "is read, and would be written over" in capsys.readouterr().err
