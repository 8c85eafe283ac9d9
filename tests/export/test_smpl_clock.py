"""Files of SMPL's family that number the frames of a video: everybody is at their moment, as `magnet data` has it."""

from __future__ import annotations

import pickle
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from magnet.body import load_body
from magnet.cli.main import main
from magnet.datamodules import registry
from magnet.datamodules.scenes import ScenesReader
from magnet.errors import DataError
from magnet.export.bvh import save_bvh
from magnet.export.read_options import Reading
from magnet.export.reading import Read, read
from magnet.export.smpl_clock import frame_numbers, shared_clock
from magnet.motion.scene import Scene
from tests.datamodules.test_scenes_on_one_clock import TRUE, seen

VIDEO = {"anna": [*range(40)], "ben": [*range(10, 50)]}


def write(folder: Path, frames: dict[str, list[int]], numbered: bool = True, **facts: float) -> list[Path]:
    """A file a person, of these frames of a video."""
    files = []
    for p, (name, each) in enumerate(frames.items()):
        files.append(folder / f"{name}.npz")
        np.savez(files[-1], **{"fps": 30.0, **seen(p, each, numbered), **facts})
    return files


def places(scene: Scene) -> np.ndarray:
    """Where pelvises are over the ground, from where they began. -> (T, P, 2)"""
    at = scene.T_world_root[0, ..., [0, 2], 3].double().numpy()
    return at - at[:1, :1]


def wanted(first: int, stop: int) -> np.ndarray:
    at = TRUE.transl[first:stop, :, [0, 2]]
    return at - at[:1, :1]


def notes_of(found: Read) -> list[str]:
    return [note for note in found.notes if "frame_ids" in note]


def test_files_of_several_people_are_laid_on_each_other_by_their_frames(tmp_path: Path) -> None:
    files = write(tmp_path, {"walk_A": [*range(50)], "walk_B": [*range(15, 60)]})
    found = read(files)
    assert (found.scene.frames, found.scene.valid) == (35, None)
    assert np.allclose(places(found.scene), wanted(15, 50), atol=1e-5)
    assert notes_of(found) == [f"{files[0]}: frame_ids are 0 to 49, 15 to 59: cut to what all have, 15 to 49"]
    reader = ScenesReader(tmp_path)
    prepared = reader.read(reader.found()[0])
    assert prepared.transl is not None
    at = prepared.transl[..., [0, 2]]
    assert np.allclose(places(found.scene), at - at[:1, :1], atol=1e-5)


def test_people_of_one_file_each_have_their_own_frames(tmp_path: Path) -> None:
    both = [seen(0, [*range(40)]), seen(1, [*range(10, 50)])]
    held = {key: np.stack([one[key] for one in both]) for key in both[0]}
    np.savez(tmp_path / "both.npz", fps=30.0, **held)
    found = read(tmp_path / "both.npz")
    assert found.scene.frames == 30 and np.allclose(places(found.scene), wanted(10, 40), atol=1e-5)
    np.savez(tmp_path / "one.npz", fps=30.0, **{**held, "frame_ids": np.arange(40)[None]})
    assert read(tmp_path / "one.npz").scene.frames == 40  # one row of numbers for all


def test_frames_in_which_somebody_was_not_seen_are_not_valid_and_hold_the_pose_before(tmp_path: Path) -> None:
    files = write(tmp_path, {"A": [*range(60)], "B": [*range(20), *range(25, 60)]})
    found = read(files)
    assert found.scene.valid is not None
    assert np.flatnonzero(~found.scene.valid[0].numpy()).tolist() == [*range(20, 25)]
    lost = found.scene.T_world_root[0, 19:25, 1]
    assert torch.equal(lost, lost[:1].expand_as(lost))
    assert np.allclose(places(found.scene)[25:], wanted(0, 60)[25:], atol=1e-5)
    assert notes_of(found) == [
        "B.npz: 5 of 60 frames are not in frame_ids, taken as not tracked: they hold the pose before, and are not valid"
    ]
    alone = read(files[1])
    assert alone.scene.frames == 60 and alone.scene.valid is not None and int(alone.scene.valid.sum()) == 55


def test_a_part_counts_the_frames_of_each_file_and_then_people_are_laid_on_each_other(tmp_path: Path) -> None:
    files = write(tmp_path, {"A": [*range(60)], "B": [*range(10, 60)]})
    found = read(files, options=Reading(start=5, end=40))
    assert found.scene.frames == 25 and np.allclose(places(found.scene), wanted(15, 40), atol=1e-5)


def test_numbers_that_do_not_go_together_are_refused(tmp_path: Path) -> None:
    apart = write(tmp_path, {"A": [*range(20)], "B": [*range(30, 60)]})
    with pytest.raises(ValueError, match=r"never seen together: frame_ids 0 to 19, 30 to 59; take each alone"):
        read(apart)
    turns = write(tmp_path, {"A": [*range(0, 40, 2)], "B": [*range(1, 41, 2)]})
    with pytest.raises(ValueError, match="never seen together: frame_ids 0 to 38, 1 to 39"):
        read(turns)
    lacks = [*write(tmp_path, {"A": [*range(20)]}), *write(tmp_path, {"C": [*range(20)]}, numbered=False)]
    with pytest.raises(ValueError, match=r"but C.npz has none; give everybody theirs, or leave all out"):
        read(lacks)
    quick = [*write(tmp_path, {"A": [*range(20)]}), *write(tmp_path, {"D": [*range(5, 40)]}, fps=60.0)]
    with pytest.raises(ValueError, match=r"begin at 0 \(A.npz\), 5 \(D.npz\); cut each alone to one beginning"):
        read(quick, options=Reading(fps=30.0))
    level = [*write(tmp_path, {"A": [*range(20)]}), *write(tmp_path, {"D": [*range(40)]}, fps=60.0)]
    assert read(level, options=Reading(fps=30.0)).scene.frames == 20


def test_frames_that_a_file_of_another_rate_lacks_are_not_valid(tmp_path: Path) -> None:
    files = write(tmp_path, {"A": [*range(20), *range(25, 60)]})
    quick = {key: np.repeat(value, 2, axis=0) for key, value in seen(1, [*range(60)]).items()}
    np.savez(tmp_path / "B.npz", fps=60.0, **{**quick, "frame_ids": np.arange(120)})
    found = read([*files, tmp_path / "B.npz"], options=Reading(fps=30.0))
    assert found.scene.frames == 60 and found.scene.valid is not None
    assert np.flatnonzero(~found.scene.valid[0].numpy()).tolist() == [*range(20, 25)]
    at = found.scene.T_world_root[0, :, 0, [0, 2], 3].double().numpy()
    assert np.allclose((at - at[:1])[25:], wanted(0, 60)[25:, 0], atol=1e-5)


def test_a_pickle_is_read_as_magnet_data_reads_it(tmp_path: Path) -> None:
    held = {name: seen(p, each) | {"fps": 30.0} for p, (name, each) in enumerate(VIDEO.items())}
    (tmp_path / "video.pkl").write_bytes(pickle.dumps(held))
    found = read(tmp_path / "video.pkl")
    assert np.allclose(places(found.scene), wanted(10, 40), atol=1e-5)
    assert notes_of(found) == [
        f"{tmp_path / 'video.pkl'}, anna: frame_ids are 0 to 39, 10 to 49: cut to what all have, 10 to 39"
    ]
    both = {key: np.stack([one[key] for one in held.values()]) for key in ("pose", "trans", "frame_ids")}
    (tmp_path / "both.pkl").write_bytes(pickle.dumps(both))
    assert torch.equal(read(tmp_path / "both.pkl", options=Reading(in_fps=30.0)).scene.body_rot, found.scene.body_rot)
    (tmp_path / "list.pkl").write_bytes(pickle.dumps([*held.values(), {"notes": None}]))
    assert torch.equal(read(tmp_path / "list.pkl").scene.T_world_root, found.scene.T_world_root)


def test_people_of_a_pickle_share_their_world(tmp_path: Path) -> None:
    held = [seen(p, [*range(60)], False) | {"fps": 30.0} for p in (0, 1)]
    lying = np.concatenate([np.tile([np.pi / 2, 0.0, 0.0], (60, 1)), np.zeros((60, 69))], axis=1)
    held.append({**held[0], "pose": lying})
    (tmp_path / "three.pkl").write_bytes(pickle.dumps(held))
    scene = read(tmp_path / "three.pkl").scene
    assert [int(axis) for axis in scene.T_world_root[0, :, :, :3, 1].mean(dim=0).abs().argmax(dim=-1)] == [1, 1, 2]


@pytest.mark.parametrize("kind", ["npz", "pkl", "bvh"])
def test_frames_that_hold_nan_are_not_valid_and_hold_the_pose_before(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"lost.{kind}"
    if kind == "bvh":
        (path,) = save_bvh(read(write(tmp_path, {"A": [*range(40)]})).scene, path, load_body())
        lines = path.read_text().splitlines()
        lines[-20:-15] = [re.sub(r"\S+", "nan", line) for line in lines[-20:-15]]
        path.write_text("\n".join(lines))
    else:
        held = seen(0, [*range(40)], False) | {"fps": 30.0}
        held["pose"][20:25, 7] = held["trans"][20:25] = np.nan
        np.savez(path, **held) if kind == "npz" else path.write_bytes(pickle.dumps(held))
    found = read(path)
    assert found.scene.valid is not None
    assert np.flatnonzero(~found.scene.valid[0].numpy()).tolist() == [*range(20, 25)]
    assert torch.equal(found.scene.T_world_root[0, 20:25], found.scene.T_world_root[0, 19:20].expand(5, 1, 4, 4))
    said = "5 of 40 frames hold NaN or infinity, taken as not tracked: they hold the pose before, and are not valid"
    assert f"lost.{kind}: {said}" in "\n".join(found.notes)
    reader = registry.reader("bvh" if kind == "bvh" else "scenes")(tmp_path)
    prepared = reader.read(next(take for take in reader.found() if take.files == (path,)))
    assert prepared.valid is not None and torch.equal(torch.from_numpy(prepared.valid[:, 0]), found.scene.valid[0])


def test_files_that_number_no_frames_or_name_pictures_are_read_as_they_lie(tmp_path: Path) -> None:
    files = write(tmp_path, {"A": [*range(40)], "B": [*range(15, 55)]}, numbered=False)
    assert read(files).scene.frames == 40
    for name, ids in (("names", np.array([f"{n}.jpg" for n in range(40)])), ("objects", np.array([None] * 40))):
        np.savez(tmp_path / f"{name}.npz", fps=30.0, **seen(0, [*range(40)], False), frame_ids=ids)
        found = read(tmp_path / f"{name}.npz")
        assert found.scene.frames == 40 and not notes_of(found)


def test_magnet_export_says_what_it_cut(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = write(tmp_path, {"A": [*range(50)], "B": [*range(15, 60)]})
    assert main(["export", *map(str, files), str(tmp_path / "out.npz")]) == 0
    assert "cut to what all have, 15 to 49" in capsys.readouterr().out
    assert Scene.load(tmp_path / "out.npz").frames == 35


def test_numbers_of_every_kind_are_told_from_what_is_none() -> None:
    assert frame_numbers("file", {}, 3, 1) == ((None,), ())
    for ids in (np.array([[4], [5], [6]]), np.array([4.0, 5.0, 6.0]), np.array([[4, 5, 6]])):
        for one in frame_numbers("file", {"frame_ids": ids}, 3, 2)[0]:
            assert one is not None and one.tolist() == [4, 5, 6]
    with pytest.raises(DataError, match=r"frame_ids: got shape \(2, 3\), expected \(3,\)"):
        frame_numbers("file", {"frame_ids": np.zeros((2, 3))}, 3, 3)
    with pytest.raises(DataError, match="whole numbers that rise"):
        frame_numbers("file", {"frame_ids": np.array([1.0, np.nan, 3.0])}, 3, 1)
    with pytest.raises(DataError, match="file: frame_ids: lists of unequal length"):
        frame_numbers("file", {"frame_ids": [[1, 2], [3]]}, 3, 2)
    assert shared_clock("file", [None, None], ["A", "B"]) is None
