"""Files that say which frames of a video somebody was seen in, and where in the world that was."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from magnet.body import load_body
from magnet.datamodules.fakes.motion import people
from magnet.datamodules.reading.recording import DataError, Recording
from magnet.datamodules.scenes import ScenesReader
from magnet.export.npz import read_smplx
from magnet.export.read_options import Reading
from magnet.export.reading import read as read_scene
from tests.datamodules.readers import world_joints

TRUE = people(60, 2, 30.0, 3)


def seen(p: int, frames: list[int], numbered: bool = True) -> dict[str, Any]:
    """One person in these frames, as video trackers give them."""
    poses = np.concatenate([TRUE.poses[frames, p].reshape(-1, 66), np.zeros((len(frames), 6))], axis=1)
    held = {"pose": poses, "trans": TRUE.transl[frames, p], "betas": np.tile(TRUE.betas[p], (len(frames), 1))}
    return held | ({"frame_ids": np.array(frames)} if numbered else {})


def read(root: Path, held: Any = None) -> Recording:
    if held is not None:
        (root / "video.pkl").write_bytes(pickle.dumps(held))
    reader = ScenesReader(root, fps=30.0)
    return reader.read(reader.found()[0])


def off(found: Recording, first: int) -> float:
    """Metres between people and where they were, from a frame of the video on, where they were seen."""
    wanted = TRUE.positions[first : first + found.frames]
    error = np.abs(world_joints(found, "smplx") - wanted).max(axis=(2, 3))
    assert found.valid is not None
    return float(error[found.valid].max())


@pytest.mark.parametrize("second", [(20, 60), (20, 50), (10, 40)])
def test_people_are_laid_on_each_other_by_the_numbers_of_frames(second: tuple[int, int], tmp_path: Path) -> None:
    found = read(tmp_path, {np.int64(0): seen(0, [*range(50)]), 1: seen(1, [*range(*second)])})
    assert found.frames == min(50, second[1]) - second[0]
    assert off(found, second[0]) < 1e-5
    (note,) = (note for note in found.notes if "frame_ids" in note)
    assert (
        f"0 to 49, {second[0]} to {second[1] - 1}: cut to what all have, {second[0]} to {found.frames + second[0] - 1}"
        in note
    )


def test_frames_in_which_somebody_was_not_seen_are_not_valid(tmp_path: Path) -> None:
    found = read(tmp_path, [seen(0, [*range(60)]), seen(1, [*range(20), *range(25, 60)])])
    assert (found.frames, off(found, 0) < 1e-5) == (60, True)
    assert found.valid is not None and np.argwhere(~found.valid).tolist() == [[frame, 1] for frame in range(20, 25)]
    assert any("person2: 5 of 60 frames are not in frame_ids, taken as not tracked: cut out" in n for n in found.notes)
    alone = read(tmp_path, seen(1, [*range(20), *range(25, 60)]))
    assert (alone.frames, alone.valid is not None and int(alone.valid.sum())) == (60, 55)


def test_people_first_arrays_have_numbers_for_all_or_for_each(tmp_path: Path) -> None:
    both = [seen(0, [*range(40)]), seen(1, [*range(10, 50)])]
    held = {key: np.stack([one[key] for one in both]) for key in both[0]}
    assert off(read(tmp_path, held), 10) < 1e-5
    same = [seen(p, [*range(5, 45)]) for p in (0, 1)]
    held = {key: np.stack([one[key] for one in same]) for key in same[0]} | {"frame_ids": np.arange(5, 45)}
    assert off(read(tmp_path, held), 5) < 1e-5


def test_every_second_frame_of_a_video_is_a_neighbour_of_the_next(tmp_path: Path) -> None:
    held = [seen(0, [*range(40)]), seen(1, [*range(10, 50)])]
    for one in held:
        one["frame_ids"] = 2 * one["frame_ids"] + 1
    found = read(tmp_path, held)
    assert (found.frames, off(found, 10) < 1e-5) == (30, True)
    assert any("frame_ids rise by 2: frames are taken for neighbours" in note for note in found.notes)


REFUSED: dict[str, tuple[list[dict[str, Any]], str]] = {
    "apart": ([seen(0, [*range(20)]), seen(1, [*range(30, 60)])], "never seen together: frame_ids 0 to 19, 30 to 59"),
    "one only": ([seen(0, [*range(20)]), seen(1, [*range(20)], False)], "person2 has none; give everybody theirs"),
    "falling": (
        [seen(0, [3, 2, 1]), seen(1, [1, 2, 3])],
        "person1: frame_ids: got 3 to 1 for 3 frames, expected whole",
    ),
    "no numbers": (
        [seen(0, [1, 2]) | {"frame_ids": np.array([1.0, 2.5])}, seen(1, [1, 2])],
        "expected whole numbers that rise",
    ),
    "far": (
        [seen(0, [1, 2]) | {"frame_ids": np.array([1, 2**40])}, seen(1, [1, 2])],
        r"by less than 1,000,000 in all",
    ),
    "too few": (
        [seen(0, [1, 2, 3]) | {"frame_ids": np.array([1, 2])}, seen(1, [1, 2, 3])],
        r"frame_ids: got shape \(2,\), expected \(3,\)",
    ),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_numbers_that_do_not_tell_are_refused(kind: str, tmp_path: Path) -> None:
    held, message = REFUSED[kind]
    with pytest.raises(DataError, match=message):
        read(tmp_path, held)


@pytest.mark.parametrize("ids", [[2, 1, *range(2, 60)], [*range(7)], [*np.linspace(0, 9, 60)]])
def test_one_person_alone_needs_no_numbers(ids: list[float], tmp_path: Path) -> None:
    held = seen(0, [*range(60)]) | {"frame_ids": np.array(ids)}
    for found in (read(tmp_path, held), read_scene(tmp_path / "video.pkl", options=Reading(in_fps=30.0))):
        (note,) = (note for note in found.notes if "frame_ids" in note)
        assert "video.pkl: frame_ids: got" in note and note.endswith("; left out, as one person alone needs none")
    np.savez(tmp_path / "video_A.npz", fps=30, **held)
    np.savez(tmp_path / "video_B.npz", fps=30, **seen(1, [*range(60)]))
    (tmp_path / "video.pkl").unlink()
    with pytest.raises(DataError, match=r"video_A\.npz: frame_ids: got .*; mend them, or leave them out"):
        read(tmp_path)


def test_frames_before_people_are_told_by_their_numbers(tmp_path: Path) -> None:
    both = [seen(p, [*range(6)]) for p in (0, 1)]
    held = {key: np.stack([one[key] for one in both], axis=1) for key in both[0]}
    refused = (
        r"\(6, 2, 72\), which is 6 people of 2 frames, but frame_ids number 6 frames; people come first: transpose"
    )
    with pytest.raises(DataError, match=refused):
        read(tmp_path, held | {"frame_ids": np.arange(6)})
    people_first = {key: np.swapaxes(value, 0, 1) for key, value in held.items()}
    with pytest.raises(DataError, match=r"got shape \(6, 2\), expected \(6,\), a number .*, or \(2, 6\) for 2 people"):
        read(tmp_path, people_first | {"frame_ids": held["frame_ids"]})


def pair(root: Path, first: int, rate: float = 30.0, numbered: bool = True) -> None:
    """Two people's files, the second from a later frame of the video on."""
    np.savez(root / "walk_A.npz", fps=30.0, **seen(0, [*range(50)]))
    np.savez(root / "walk_B.npz", fps=rate, **seen(1, [*range(first, 60)], numbered))


def test_several_files_of_a_scene_are_laid_on_each_other_by_the_numbers_of_frames(tmp_path: Path) -> None:
    pair(tmp_path, 15)
    found = read(tmp_path)
    assert (found.frames, off(found, 15) < 1e-5) == (35, True)
    assert any("walk_A.npz: frame_ids are 0 to 49, 15 to 59: cut to what all have, 15 to 49" in n for n in found.notes)
    reader = ScenesReader(tmp_path)
    assert reader.part_of(reader.takes()[0]).whole == 35 / 30


def test_a_table_that_says_when_files_begin_beats_the_numbers_of_frames(tmp_path: Path) -> None:
    pair(tmp_path, 15)
    for starts, first in ((("", ""), 15), (("0", "0.5"), 15), (("0", "0"), 0)):
        rows = [f"walk,{who},walk_{who}.npz,{start}\n" for who, start in zip("AB", starts, strict=True)]
        (tmp_path / "people.csv").write_text("scene,person,file,start\n" + "".join(rows))
        found = read(tmp_path)
        assert np.allclose(found.transl[0, 0], TRUE.transl[first, 0])  # type: ignore[index]
        assert np.allclose(found.transl[0, 1], TRUE.transl[15, 1])  # type: ignore[index]


def test_files_of_other_rates_that_begin_with_other_frames_need_a_table(tmp_path: Path) -> None:
    pair(tmp_path, 15, rate=60.0)
    with pytest.raises(DataError, match=r"begin at 0 \(walk_A.npz\), 15 \(walk_B.npz\); say when each begins"):
        read(tmp_path)
    pair(tmp_path, 0, rate=60.0)
    assert read(tmp_path).frames == 30
    pair(tmp_path, 0, numbered=False)
    with pytest.raises(DataError, match=r"walk_B.npz has none; give everybody theirs, or leave all out"):
        read(tmp_path)


def test_places_in_the_world_beat_those_that_a_camera_sees(tmp_path: Path) -> None:
    held = [seen(p, [*range(60)], False) for p in (0, 1)]
    seen_so = [{**one, "pose_world": one["pose"], "trans_world": one["trans"]} for one in held]
    for one in seen_so:
        one["pose"], one["trans"] = np.zeros_like(one["pose"]), np.zeros_like(one["trans"])
    found = read(tmp_path, seen_so)
    assert off(found, 0) < 1e-5
    assert "pose_world and trans_world are taken, not what the camera sees" in found.notes
    alone = {key: one for key, one in seen_so[0].items() if key not in ("pose", "trans")}
    assert read(tmp_path, [alone, alone]).frames == 60
    np.savez(tmp_path / "camera.npz", fps=30, **seen_so[0])
    np.savez(tmp_path / "plain.npz", fps=30, **held[0])
    body = load_body()
    shown, wanted = (read_smplx(tmp_path / f"{name}.npz", body)[0] for name in ("camera", "plain"))
    assert (shown.T_world_root - wanted.T_world_root).abs().max() == 0


def test_who_is_in_a_file_in_the_world_and_as_a_camera_sees_them_is_one_person(tmp_path: Path) -> None:
    one = seen(0, [*range(60)], False)
    held = {"smpl_params_global": one, "smpl_params_incam": one | {"trans": np.zeros((60, 3))}}
    found = read(tmp_path, held)
    assert found.persons == ("smpl_params_global",) and found.transl is not None
    assert np.allclose(found.transl[:, 0], one["trans"])
    assert read_scene(tmp_path / "video.pkl", options=Reading(in_fps=30.0)).scene.agents == 1
    assert len(read(tmp_path, {"anna_incam": one, "ben_incam": one}).persons) == 2


def test_what_torch_saved_is_read_as_a_pickle_of_the_same_is(tmp_path: Path) -> None:
    one = {key: torch.from_numpy(value).float() for key, value in seen(0, [*range(60)], False).items()}
    root, body = one["pose"][:, :3], one["pose"][:, 3:66]
    world = {"body_pose": body, "global_orient": root, "transl": one["trans"], "betas": one["betas"]}
    held = {"smpl_params_global": world, "smpl_params_incam": world | {"transl": torch.zeros(60, 3)}}
    torch.save({**held, "K_fullimg": torch.eye(3).expand(60, 3, 3), "net_outputs": {}}, tmp_path / "video.pt")
    found = read(tmp_path)
    assert (found.frames, len(found.persons)) == (60, 1) and found.transl is not None
    assert np.allclose(found.transl[:, 0], one["trans"])
    shown = read_scene(tmp_path / "video.pt", options=Reading(in_fps=30.0)).scene
    (tmp_path / "video.pt").unlink()
    arrays = {name: {key: value.numpy() for key, value in part.items()} for name, part in held.items()}
    wanted = read(tmp_path, arrays)
    assert found.poses is not None and wanted.poses is not None and (found.poses == wanted.poses).all()
    pickled = read_scene(tmp_path / "video.pkl", options=Reading(in_fps=30.0)).scene
    assert (pickled.T_world_root == shown.T_world_root).all() and (pickled.body_rot == shown.body_rot).all()


@pytest.mark.parametrize("inside", [True, False], ids=["people", "alone"])
def test_people_of_prompt_hmr_are_read_in_the_world_at_the_frames_they_were_seen_in(
    inside: bool, tmp_path: Path
) -> None:
    people_seen = {}
    for p, frames in enumerate(([*range(50)], [*range(20, 60)])):
        one = seen(p, frames, False)
        pose = np.concatenate([one["pose"][:, :66], np.zeros((len(frames), 99))], axis=1)
        world = {"pose": pose, "trans": one["trans"], "shape": one["betas"]}
        camera = {key: np.zeros_like(value) for key, value in world.items()}
        people_seen[p + 1] = {"track_id": p + 1, "frames": np.array(frames), "smplx_cam": camera, "smplx_world": world}
    held = {"camera": {"img_focal": 1000.0}, "people": people_seen, "masks": None} if inside else people_seen
    found = read(tmp_path, held)
    assert (found.frames, found.persons) == (30, ("1", "2")) and off(found, 20) < 1e-5
    shown = read_scene(tmp_path / "video.pkl", options=Reading(in_fps=30.0))
    assert (shown.scene.agents, shown.scene.frames) == (2, 30)


def test_what_a_file_has_is_named_by_its_own_keys(tmp_path: Path) -> None:
    one = seen(0, [*range(60)], False)
    (tmp_path / "a.pkl").write_bytes(pickle.dumps({0: {"pose_world": one["pose"], "trans_world": one["trans"]}}))
    with pytest.raises(ValueError, match=r"a\.pkl, 0: lacks mocap_frame_rate; it has pose_world, trans_world; say"):
        read_scene(tmp_path / "a.pkl")
    (tmp_path / "a.pkl").unlink()
    with pytest.raises(DataError, match=r"translations: got shape \(60, 1, 3\), expected \(60, 3\)"):
        read(tmp_path, one | {"trans": one["trans"][:, None]})


@pytest.mark.parametrize(
    "more",
    [
        {"frame_ids": np.arange(60)[:, None]},
        {"frame_ids": [f"{frame:06d}.jpg" for frame in range(60)]},
        {"frame_ids": None, "pose_world": None, "trans_world": None},
    ],
    ids=["column", "pictures", "none"],
)
def test_frames_in_a_column_or_named_or_said_to_be_none_are_nothing_wrong(more: dict[str, Any], tmp_path: Path) -> None:
    found = read(tmp_path, seen(0, [*range(60)], numbered=False) | more)
    assert (found.frames, found.notes) == (60, ()) and found.transl is not None
    assert np.allclose(found.transl[:, 0], TRUE.transl[:, 0])
