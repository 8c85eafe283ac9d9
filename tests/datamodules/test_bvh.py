"""BVH files of a user's own: what they are taken for, who is beside whom and when, how they are split."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from magnet.body import load_body
from magnet.datamodules.bvh import BVHReader
from magnet.datamodules.fakes.bvh import named, write_scenes
from magnet.datamodules.fakes.motion import FakeMotion, people, turned
from magnet.datamodules.preparing.canonicalize import CanonicalizeOptions, canonicalize
from magnet.datamodules.preparing.convert import convert
from magnet.datamodules.reading.own import FEW
from magnet.datamodules.reading.own_files import PersonFile
from magnet.datamodules.reading.recording import DataError, Reader
from magnet.datamodules.reading.rigs import read_joints
from magnet.export.bvh import save_bvh
from magnet.motion.rotations import from_rotvec
from magnet.synthesis import synthesize

TAKES, FRAMES = 4, 12


def written(root: Path, **scenes: FakeMotion) -> Path:
    root.mkdir(exist_ok=True)
    write_scenes(root, scenes)
    return root


def walk(frames: int = 48, fps: float = 120.0, seed: int = 0) -> FakeMotion:
    return turned(people(frames, 2, fps, seed), "+z")


def whole(reader: Reader, name: str = "walk"):
    return reader.read(next(take for take in reader.found() if take.name == name))


def test_what_a_file_means_is_said_in_its_notes(made: Path) -> None:
    reader = BVHReader(made)
    (note,) = reader.read(reader.takes()[0]).notes
    assert note == "names of 3ds Max Biped, Unreal, Rigify, Character Creator, 18 joints; cm, +z up, 120 fps"
    assert reader.summary() == ["4 scenes of 2 files each: walk1 (A, B), walk2 (A, B), walk3 (A, B), walk4 (A, B)"]


def test_a_skeleton_of_the_bodys_own_comes_back_exactly(tmp_path: Path) -> None:
    body = load_body()
    scene = synthesize("follow", 2, 120, torch.Generator().manual_seed(1), body).scene.slice(0, 64)
    save_bvh(scene, tmp_path / "walk.bvh", body, unit="cm")
    reader = BVHReader(tmp_path)
    made = canonicalize(whole(reader), body, "walk", "bvh", "train", "positions", CanonicalizeOptions(trust_fps=True))
    (clip,) = made.clips
    found, wanted = body.joints(clip.scene)[0], body.joints(scene)[0]
    shift = (found - wanted)[0, 0, 0]
    assert (found - wanted - shift).norm(dim=-1).max() < 2e-4
    assert "mean residual 0.0 cm" in made.notes[-1]


# -- who and when ------------------------------------------------------------------------------


def test_a_start_in_the_table_puts_people_beside_each_other_in_time(tmp_path: Path) -> None:
    root = written(tmp_path / "dl", walk=walk())
    (root / "people.csv").write_text("scene,person,file,role,start\nduo,a,walk_A.bvh,,0\nduo,b,walk_B.bvh,,0.1\n")
    reader = BVHReader(root)
    found, true = whole(reader, "duo"), walk()
    assert (found.frames, found.persons) == (36, ("a", "b"))  # 12 frames at 120 fps later, to the end of the first
    joints = list(found.joints)
    np.testing.assert_allclose(found.positions[:, 0], true.positions[12:48, 0][:, joints], atol=1e-5)
    np.testing.assert_allclose(found.positions[:, 1], true.positions[:36, 1][:, joints], atol=1e-5)
    assert "unequal numbers of frames (a 36, b 48), cut to the shortest" in found.notes
    (root / "people.csv").write_text("scene,file,start\nduo,walk_A.bvh,\nduo,walk_B.bvh,9\n")
    with pytest.raises(DataError, match=r"walk_A\.bvh: people of duo never overlap.*mend the starts"):
        whole(BVHReader(root), "duo")


def test_files_of_different_rates_are_brought_together(tmp_path: Path) -> None:
    root = written(tmp_path / "dl", walk=walk(48), slow=walk(24, 60.0))
    (root / "slow_B.bvh").rename(root / "walk_B.bvh")
    found, true = whole(BVHReader(root)), walk(45)
    assert (found.fps, found.frames) == (30.0, 12)
    np.testing.assert_allclose(found.positions, true.positions[::4][:, :, list(found.joints)], atol=2e-3)
    assert "files of 60 and 120 frames a second, all brought to 30" in found.notes


def mixed(root: Path) -> Path:
    """Two people of one walk, the first's file z up and the second's y up."""
    written(root, walk=walk(240))
    written(root / "other", walk=turned(walk(240), "+y"))
    (root / "other" / "walk_B.bvh").replace(root / "walk_B.bvh")
    (root / "other" / "walk_A.bvh").unlink()
    return root


def test_files_of_different_up_axes_are_each_turned_by_their_own(tmp_path: Path) -> None:
    reader = BVHReader(mixed(tmp_path / "dl"))
    found, true = whole(reader), turned(walk(240), "+y")
    assert found.up == "+y"
    np.testing.assert_allclose(found.positions, true.positions[:, :, list(found.joints)], atol=1e-5)
    assert {note.split("; ")[1] for note in found.notes} == {"cm, +z up, 120 fps", "cm, +y up, 120 fps"}
    same = whole(BVHReader(written(tmp_path / "same", walk=true)))
    one, other = (
        canonicalize(each, load_body(), "walk", "bvh", "train", "positions", CanonicalizeOptions()).clips[0].scene
        for each in (found, same)
    )
    assert (load_body().joints(one) - load_body().joints(other)).norm(dim=-1).max() < 1e-3


def test_whoever_lies_beside_somebody_who_stands_is_in_the_same_world(tmp_path: Path) -> None:
    root = written(tmp_path / "dl", walk=turned(walk(48), "+y"))
    standing, lying = (BVHReader(root).open(PersonFile(name, root / f"walk_{name}.bvh"), False)[0][0] for name in "AB")
    flat = from_rotvec(torch.tensor([0.0, 0.0, torch.pi / 2], dtype=torch.float64)).numpy()
    local = lying.file.local.copy()
    local[:, 0] = flat @ local[:, 0]
    lying = replace(lying, file=replace(lying.file, local=local))
    for place, tracks in ((1, [standing, lying]), (0, [lying, standing])):
        found = BVHReader(root).recording("walk", tracks, ("", ""), ())
        assert found.up == "+y"
        spread = np.ptp(found.positions[:, place], axis=1).mean(axis=0)
        assert spread[0] > 1.2 > 0.8 > spread[1], "along x, and low"


def test_people_alone_are_pointed_to_how_they_could_be_together(tmp_path: Path) -> None:
    root = written(tmp_path / "dl", walk=walk(8))
    (root / "walk_A.bvh").rename(root / "anna.bvh")
    (root / "walk_B.bvh").rename(root / "ben_B.bvh")
    reader = BVHReader(root)
    assert any("no names tell who was recorded together" in line and "docs/own.md" in line for line in reader.summary())
    assert "named like one of several people, but no other file goes with it" in whole(reader, "ben_B").notes
    assert [take.name for take in BVHReader(root, pattern="{scene}n*_{person}").found()] == ["be"]


# -- splits ------------------------------------------------------------------------------------


@pytest.mark.parametrize("scenes", [1, 2, 3])
def test_few_scenes_are_split_in_time_and_no_frame_is_in_two_parts(scenes: int, tmp_path: Path) -> None:
    assert scenes < FEW
    root = written(tmp_path / "dl", **{f"walk{k}": walk(40 + k, seed=k) for k in range(scenes)})
    reader = BVHReader(root)
    for k in range(scenes):
        parts = [reader.read(take) for take in reader.takes() if take.name.startswith(f"walk{k} ")]
        joined = np.concatenate([part.positions for part in parts])
        np.testing.assert_array_equal(joined, whole(reader, f"walk{k}").positions)
        assert len(parts[0].positions) > len(joined) / 2
    assert any("split in time" in line for line in reader.summary())


def test_a_scene_that_is_called_as_a_part_of_another_is_refused(tmp_path: Path) -> None:
    root = written(tmp_path / "dl", **{"walk": walk(40, seed=1), "walk (test)": walk(40, seed=2)})
    with pytest.raises(DataError, match=r"'walk \(test\)' is called as a part of 'walk'; rename it"):
        BVHReader(root).takes()


@pytest.mark.parametrize("scenes", range(1, 8))
def test_whole_scenes_leave_no_split_empty(scenes: int, tmp_path: Path) -> None:
    for k in range(scenes):
        (tmp_path / f"x{k}_A.bvh").touch()
        (tmp_path / f"x{k}_B.bvh").touch()
    reader = BVHReader(tmp_path, split="scenes")
    splits = [take.split for take in reader.takes()]
    assert set(splits) == set(("train", "test", "val")[:scenes])
    assert splits.count("train") >= max(1, scenes // 2 - 1)


# -- what is found in a file, and what a user knows better -------------------------------------


def renamed(root: Path, change) -> None:
    for path in root.glob("*.bvh"):
        path.write_text(re.sub(r"(ROOT|JOINT) (\w+)", lambda match: f"{match[1]} {change(match[2])}", path.read_text()))


def test_names_that_nobody_knows_are_mapped_by_a_file(tmp_path: Path) -> None:
    from magnet.body.joints import JOINT_NAMES

    root = written(tmp_path / "dl", walk=walk(8))
    bones = {named(joint): f"Bone{k}" for k, joint in enumerate(JOINT_NAMES)}
    renamed(root, bones.__getitem__)
    with pytest.raises(DataError, match=r"walk_A\.bvh: cannot tell which joint is left_hip.*--reader\.joints FILE"):
        whole(BVHReader(root))
    (tmp_path / "map.txt").write_text(
        "".join(f"{joint} Bone{k}  # ours, theirs\n" for k, joint in enumerate(JOINT_NAMES))
    )
    found, true = whole(BVHReader(root, joints=tmp_path / "map.txt")), walk(8)
    np.testing.assert_allclose(found.positions, true.positions[:, :, list(found.joints)], atol=1e-5)


@pytest.mark.parametrize("line", ["left_hip", "hip Bone1", "left_hip A\nleft_hip B"])
def test_a_line_that_maps_nothing_is_named(line: str, tmp_path: Path) -> None:
    (tmp_path / "map.txt").write_text(line)
    with pytest.raises(ValueError, match=r"map\.txt, line \d: got .*expected OUR_NAME THEIR_NAME"):
        read_joints(tmp_path / "map.txt")


def test_an_axis_that_the_user_says_is_held_against_the_motion(tmp_path: Path) -> None:
    reader = BVHReader(written(tmp_path / "dl", walk=walk(8)))
    error = convert(reader, reader.found()[0], load_body(), CanonicalizeOptions(min_frames=1, up="+y")).error
    assert error and "declared up axis is +y, but people stand along +z" in error


@pytest.mark.slow
def test_proportions_that_are_nobodys_are_refused_unless_they_are_asked_for(tmp_path: Path) -> None:
    root = written(tmp_path / "dl", walk=walk(48))
    for path in root.glob("*.bvh"):  # hands at the end of arms thrice as long
        lines = path.read_text().splitlines()
        for k, line in enumerate(lines):
            if re.search(r"JOINT (lowerarm|hand)_", line):
                words = lines[k + 2].split()
                lines[k + 2] = " ".join([words[0], *(str(3 * float(x)) for x in words[1:])])
        path.write_text("\n".join(lines) + "\n")
    reader = BVHReader(root)
    error = convert(reader, reader.found()[0], load_body(), CanonicalizeOptions(min_frames=1)).error
    assert error and re.search(r"mean error of [\d.]+ cm, expected at most 4\.0 cm; worst is \w+", error)
    kept = BVHReader(root, worst_fit=0.3)
    assert convert(kept, kept.found()[0], load_body(), CanonicalizeOptions(min_frames=1, trust_fps=True)).error is None


def gapped(root: Path, frames: slice) -> Path:
    """A walk whose second person was not tracked in some frames."""
    written(root, walk=walk(240, 120.0))
    path = next(path for path in root.iterdir() if path.stem.endswith("B"))
    lines = path.read_text().splitlines()
    first = next(number for number, line in enumerate(lines) if line.startswith("Frame Time")) + 1
    for number in range(first + frames.start, first + frames.stop):
        lines[number] = " ".join(["nan"] * len(lines[number].split()))
    path.write_text("\n".join(lines) + "\n")
    return root


def test_frames_of_no_numbers_are_cut_out_and_the_others_stay_as_they_are(tmp_path: Path) -> None:
    body, options = load_body(), CanonicalizeOptions(min_frames=10, trust_fps=True)
    written(tmp_path / "whole", walk=walk(240, 120.0))
    whole_take, gap_take = (
        whole(BVHReader(root)) for root in (tmp_path / "whole", gapped(tmp_path / "gap", slice(100, 108)))
    )
    assert gap_take.valid is not None and np.argwhere(~gap_take.valid).tolist() == [[t, 1] for t in range(100, 108)]
    assert any("8 of 240 frames hold NaN or infinity, taken as not tracked" in note for note in gap_take.notes)
    (one,) = canonicalize(whole_take, body, "walk", "bvh", "train", "positions", options).clips
    first, last = canonicalize(gap_take, body, "walk", "bvh", "train", "positions", options).clips
    assert (first.name, last.name) == ("walk [0:25]", "walk [27:60]")
    for clip, part in ((first, slice(0, 25)), (last, slice(27, 60))):
        close = (body.joints(clip.scene) - body.joints(one.scene)[:, part])[0]
        close = (close - close[:, :1, :1]).norm(dim=-1)  # each clip has an origin of its own: of the first one's pelvis
        assert close[:, 0].max() < 1e-4 and close[:, 1].max() < 0.01


def test_files_of_other_rates_keep_their_gaps(tmp_path: Path) -> None:
    reader = BVHReader(gapped(tmp_path, slice(100, 108)))
    take = next(take for take in reader.found() if take.name == "walk")
    tracks = [reader.open(PersonFile("", file), False)[0][0] for file in take.files]
    slow = [track.resampled(30.0) for track in tracks]
    assert [np.flatnonzero(~track.valid).tolist() for track in slow] == [[], [25, 26]]
    assert slow[1].slice(26, 30).valid.tolist() == [False, True, True, True]


def test_somebody_who_was_never_tracked_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"every frame does"):
        whole(BVHReader(gapped(tmp_path, slice(0, 240))))
