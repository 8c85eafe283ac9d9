"""A user's npz and pkl files of SMPL's family, and magnet's own scenes."""

from __future__ import annotations

import pickle
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from magnet import cli
from magnet.body import load_body
from magnet.datamodules.clip import SPLITS
from magnet.datamodules.fakes.motion import made_up_body, people
from magnet.datamodules.prepared import Prepared
from magnet.datamodules.preparing.canonicalize import CanonicalizeOptions, canonicalize
from magnet.datamodules.preparing.check import check_store
from magnet.datamodules.preparing.convert import PrepareJob
from magnet.datamodules.preparing.prepare import prepare
from magnet.datamodules.reading.recording import DataError
from magnet.datamodules.scenes import ScenesReader
from magnet.export import save_csv
from magnet.export.npz import save_smplx
from magnet.motion.scene import Scene
from magnet.synthesis import synthesize
from tests.datamodules.readers import Foreign, world_joints

TRUE = people(40, 2, 30.0, 3)


def plain(p: int) -> dict[str, Any]:
    """One person as AMASS has them."""
    poses = np.concatenate([TRUE.poses[:, p].reshape(-1, 66), np.zeros((TRUE.frames, 99))], axis=1)
    return {"poses": poses, "trans": TRUE.transl[:, p], "betas": TRUE.betas[p], "mocap_framerate": 30.0}


def apart(p: int) -> dict[str, Any]:
    """Root and body by themselves, as joints."""
    shown = TRUE.poses[:, p]
    return {"global_orient": shown[:, :1], "body_pose": shown[:, 1:], "transl": TRUE.transl[:, p],
            "betas": np.tile(TRUE.betas[p], (TRUE.frames, 1)), "fps": 30}  # fmt: skip


def matrices(p: int) -> dict[str, Any]:
    turned = Rotation.from_rotvec(TRUE.poses[:, p].reshape(-1, 3)).as_matrix().reshape(-1, 22, 3, 3)
    return {**apart(p), "global_orient": turned[:, :1], "body_pose": turned[:, 1:]}


def scaled(p: int) -> dict[str, Any]:
    """As AIST++ has them."""
    poses = np.concatenate([TRUE.poses[:, p].reshape(-1, 66), np.zeros((TRUE.frames, 6))], axis=1)
    return {"smpl_poses": poses, "smpl_trans": 93.0 * TRUE.transl[:, p], "smpl_scaling": np.array([93.0]),
            "betas": TRUE.betas[p], "fps": 30.0}  # fmt: skip


def everybody(_: int) -> dict[str, Any]:
    """Both in one file, people first."""
    whole = [plain(0), plain(1)]
    return {key: np.stack([one[key] for one in whole]) for key in ("poses", "trans", "betas")} | {"fps": 30.0}


FORMS: dict[str, tuple[str, Callable[[int], Any], tuple[int, ...]]] = {
    "npz, a person each": ("npz", plain, (0, 1)),
    "npz, joints apart": ("npz", apart, (0, 1)),
    "npz, matrices": ("npz", matrices, (0, 1)),
    "npz, scaled": ("npz", scaled, (0, 1)),
    "npz, people first": ("npz", everybody, (0,)),
    "pkl, a person each": ("pkl", matrices, (0, 1)),
    "pkl, by name": ("pkl", lambda _: {"anna": apart(0), "ben": plain(1), "fps": 30}, (0,)),
    "pkl, a list": ("pkl", lambda _: [apart(0), plain(1)], (0,)),
    "pkl, inside": ("pkl", lambda p: {"smpl": scaled(p), "notes": "x"}, (0, 1)),
}


def made() -> Scene:
    """A scene of the open body's."""
    return synthesize("follow", 2, 120, torch.Generator().manual_seed(1), load_body()).scene.slice(0, 40)


def write(path: Path, held: Any) -> None:
    if path.suffix == ".pkl":
        path.write_bytes(pickle.dumps(held))
    else:
        np.savez(path, **held)


def read(root: Path, **options: Any):
    reader = ScenesReader(root, **options)
    return reader.read(reader.found()[0])


@pytest.mark.parametrize("form", FORMS)
def test_every_form_shows_the_same_joints(form: str, tmp_path: Path) -> None:
    suffix, held, files = FORMS[form]
    for p in files:
        write(tmp_path / f"walk_{'AB'[p]}.{suffix}", held(p))
    found = read(tmp_path)
    assert (found.fps, found.up, found.frames, len(found.persons)) == (30.0, "+y", TRUE.frames, 2)
    np.testing.assert_allclose(world_joints(found, "smplx"), TRUE.positions, atol=1e-5)


GONE = slice(10, 14)
"""Frames in which the second person was not tracked."""


def lost(held: Any, form: str, p: int, number: float) -> Any:
    """What a file holds, without the second person in some frames: their rotations or places are no numbers."""
    if "people first" in form:
        held["poses"][1, GONE] = number
        return held
    if form == "pkl, by name":
        part, key = held["ben"], "trans"
    elif form == "pkl, a list":
        part, key = held[1], "poses"
    elif p == 0:
        return held
    else:
        part = held.get("smpl", held)
        key = next(key for key in ("smpl_trans", "body_pose", "poses") if key in part)
    part[key] = np.array(part[key])  # a copy
    part[key][GONE] = number
    return held


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_frames_of_no_numbers_are_not_tracked_and_the_others_stay_as_they_are(
    form: str, number: float, tmp_path: Path
) -> None:
    suffix, held, files = FORMS[form]
    for p in files:
        write(tmp_path / f"walk_{'AB'[p]}.{suffix}", lost(held(p), form, p, number))
    found = read(tmp_path)
    assert found.valid is not None
    there = np.ones((TRUE.frames, 2), dtype=bool)
    there[GONE, 1] = False
    np.testing.assert_array_equal(found.valid, there)
    shown = np.abs(world_joints(found, "smplx") - TRUE.positions).max(axis=(2, 3))
    assert shown[there].max() < 1e-5
    (note,) = (note for note in found.notes if "NaN" in note)
    assert "4 of 40 frames hold NaN or infinity, taken as not tracked: cut out" in note


def test_shapes_of_lost_frames_do_not_count(tmp_path: Path) -> None:
    held = {key: np.array(value) for key, value in plain(0).items()}
    shape = held["betas"]
    held["betas"] = np.tile(shape, (TRUE.frames, 1))
    held["betas"][GONE] = held["trans"][GONE] = np.nan
    write(tmp_path / "walk.pkl", held)
    np.testing.assert_allclose(read(tmp_path).betas[0], shape[:10])


def test_both_kinds_of_npz_that_magnet_writes_come_back(tmp_path: Path) -> None:
    body = load_body()
    scene = made()
    wanted = body.joints(scene)[0]
    for kind in ("scene", "smplx"):
        (tmp_path / kind).mkdir()
        if kind == "scene":
            scene.save(tmp_path / kind / "walk.npz")
        else:
            save_smplx(scene, tmp_path / kind / "walk.npz", body)
        found = read(tmp_path / kind)
        clips = canonicalize(found, body, "walk", "scenes", "train", "any", CanonicalizeOptions(trust_fps=True))
        joints = body.joints(clips.clips[0].scene)[0]
        assert (joints - wanted - (joints - wanted)[0, 0, 0]).norm(dim=-1).max() < 2e-4, kind


def test_without_a_body_file_the_open_body_dances_in_its_mean_shape_and_a_note_says_so(tmp_path: Path) -> None:
    for p in (0, 1):
        write(tmp_path / f"walk_{'AB'[p]}.npz", plain(p) | {"gender": "female"})
    clips = canonicalize(read(tmp_path), load_body(), "walk", "scenes", "train", "any", CanonicalizeOptions())
    assert not clips.clips[0].scene.betas.any()
    assert any("in its mean shape: limbs are approximate without --body FILE" in note for note in clips.notes)
    assert not any("female" in note for note in clips.notes)


def test_people_of_one_file_have_their_names_and_genders(tmp_path: Path) -> None:
    held = {"anna": apart(0), "ben": plain(1), "gender": ["female", "male"]}
    write(tmp_path / "walk.pkl", held)
    found = read(tmp_path)
    assert (found.persons, found.genders) == (("anna", "ben"), ("female", "male"))
    write(tmp_path / "walk.pkl", {0: apart(0), 1: plain(1)})
    assert read(tmp_path).persons == ("0", "1")
    write(tmp_path / "walk.pkl", [apart(0), plain(1)])
    assert read(tmp_path).persons == ("person1", "person2")


def test_keys_that_other_programs_call_as_ours_mean_nothing(tmp_path: Path) -> None:
    write(tmp_path / "walk.npz", {**plain(0), "meta": np.array("subject 5"), "body": np.array("smplx")})
    assert read(tmp_path).body == ""
    assert read(tmp_path).frames == TRUE.frames


def test_people_whose_shapes_are_of_different_families_are_refused(tmp_path: Path) -> None:
    write(tmp_path / "walk_A.npz", scaled(0))  # SMPL's 72 numbers
    write(tmp_path / "walk_B.npz", plain(1))  # SMPL-X's 165
    with pytest.raises(DataError, match="shape numbers are of different bodies: smpl, smplx"):
        read(tmp_path)


def test_a_dict_of_people_in_a_npz_is_named_as_what_it_is(tmp_path: Path) -> None:
    np.savez(tmp_path / "walk.npz", anna=np.array(plain(0), dtype=object), ben=np.array(plain(1), dtype=object))
    with pytest.raises(DataError, match=r"anna, ben holds pickled objects.* as \.pkl"):
        read(tmp_path)


def damaged(change: Callable[[dict[str, Any]], Any]) -> dict[str, Any]:
    held = plain(0)
    change(held)
    return held


REFUSED: dict[str, tuple[Any, str]] = {
    "rate": (damaged(lambda h: h.pop("mocap_framerate")), r"says no frame rate .*give --reader\.fps, such as 30"),
    "keys": ({"joints": np.zeros((3, 3))}, r"has neither poses nor root_orient and pose_body.*it has joints"),
    "place": (damaged(lambda h: h.pop("trans")), r"lacks trans or transl; it has betas, mocap_framerate, poses"),
    "lengths": (
        damaged(lambda h: h.update(trans=h["trans"][:-1])),
        r"unequal numbers of frames: rotations 40, translations 39",
    ),
    "NaN": (damaged(lambda h: h["poses"].__setitem__((..., 4), np.nan)), r"every frame holds NaN or infinity"),
    "shape": (damaged(lambda h: h.update(betas=np.full(10, np.nan))), r"betas: 10 of 10 numbers are NaN or infinite"),
    "few": (
        damaged(lambda h: h.update(poses=h["poses"][:, :40])),
        r"rotations: got shape \(40, 40\), expected \(frames, 66",
    ),
    "mirrored": ({**matrices(0), "body_pose": -matrices(0)["body_pose"]}, "matrices that are no rotations"),
    "code": (Foreign(), r"a pickle can run code"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_what_is_wrong_with_a_file_is_said_with_its_name(kind: str, tmp_path: Path) -> None:
    held, message = REFUSED[kind]
    write(tmp_path / "walk.pkl", held)
    with pytest.raises(DataError, match=message) as caught:
        read(tmp_path)
    assert "walk.pkl" in str(caught.value)


def test_a_rate_that_the_user_gives_stands_in_for_one_that_is_missing(tmp_path: Path) -> None:
    write(tmp_path / "walk.pkl", REFUSED["rate"][0])
    assert read(tmp_path, fps=25.0).fps == 25.0


def test_several_scenes_in_one_file_are_refused_with_the_command_that_parts_them(tmp_path: Path) -> None:
    made().repeat(2).save(tmp_path / "two.npz")
    with pytest.raises(DataError, match=r"two\.npz: holds 2 scenes, expected one.*magnet export two\.npz"):
        read(tmp_path)


def test_shapes_of_another_body_are_refused(tmp_path: Path) -> None:
    body = load_body()
    made().replace(body="theirs").save(tmp_path / "walk.npz")
    with pytest.raises(DataError, match=r"belong to body 'theirs', not to 'open-1'.*--body"):
        canonicalize(read(tmp_path), body, "walk", "scenes", "train", "any", CanonicalizeOptions())


def test_a_body_file_beside_the_scenes_is_no_scene(tmp_path: Path) -> None:
    ScenesReader.write_fake(tmp_path, takes=3, frames=8)
    assert [take.name for take in ScenesReader(tmp_path).found()] == ["amass1", "magnet3", "pickle2"]


def test_shapes_of_another_family_than_the_bodys_are_refused(tmp_path: Path) -> None:
    write(tmp_path / "walk.npz", scaled(0))  # SMPL's 72 numbers
    body = made_up_body("smplx")
    assert body.family == "smplx"
    with pytest.raises(DataError, match=r"are SMPL's by the number of joints, but body .* is SMPL-X's: give that"):
        canonicalize(read(tmp_path), body, "walk", "scenes", "train", "any", CanonicalizeOptions())
    assert canonicalize(
        read(tmp_path), made_up_body("smpl"), "walk", "scenes", "train", "any", CanonicalizeOptions()
    ).clips


def test_scenes_are_prepared_without_a_body_file_too(tmp_path: Path) -> None:
    for p in (0, 1):
        write(tmp_path / f"walk_{'AB'[p]}.npz", plain(p))
    order = PrepareJob("scenes", str(tmp_path), {"split": "scenes"}, "open", CanonicalizeOptions())
    assert prepare(order, tmp_path / "store").folder.manifest["body"]["id"] == load_body().id


def test_a_scene_that_comes_later_leaves_the_prepared_ones_as_they_are(tmp_path: Path) -> None:
    from magnet.datamodules.fakes.scenes import scenes, write_scenes

    shown = scenes(6, 40, 0)
    *first, last = shown
    write_scenes(tmp_path / "dl", {name: shown[name] for name in first})
    order = PrepareJob("scenes", str(tmp_path / "dl"), {}, str(tmp_path / "dl/body.npz"), CanonicalizeOptions())
    assert prepare(order, tmp_path / "store").made == 5
    write_scenes(tmp_path / "dl", {last: shown[last]})
    again = prepare(order, tmp_path / "store")
    assert (again.made, again.kept) == (1, 5) and check_store(again.folder).problems == []
    data = Prepared(root=str(tmp_path / "store"), body_model=order.body_file)
    assert {clip.name for split in SPLITS for clip in data.clips(split)} == set(shown)


def test_a_store_has_one_folder_by_either_name() -> None:
    assert Prepared(root="here").path == Prepared(path="here").path == Prepared(path="here", root="here").path
    with pytest.raises(ValueError, match="path here and root there are two names of one thing"):
        Prepared(path="here", root="there")


def test_a_scene_of_magnets_own_may_lack_frames_of_somebody(tmp_path: Path) -> None:
    scene = made()
    root = scene.T_world_root.clone()
    root[0, 5:7, 1] = torch.nan
    scene.replace(T_world_root=root).save(tmp_path / "walk.npz")
    found = read(tmp_path)
    assert found.valid is not None and np.argwhere(~found.valid).tolist() == [[5, 1], [6, 1]]
    assert any("person 2: 2 of 40 frames hold NaN or infinity" in note for note in found.notes)


def test_a_take_with_a_gap_becomes_two_clips(tmp_path: Path) -> None:
    long = people(150, 2, 60.0, 3)
    for p in (0, 1):
        poses, place = long.poses[:, p].reshape(-1, 66).copy(), long.transl[:, p].copy()
        poses[70 : 74 if p else 72] = np.nan
        write(tmp_path / f"walk_{'AB'[p]}.npz", {"poses": poses, "trans": place, "betas": np.zeros(10), "fps": 60.0})
    options = CanonicalizeOptions(min_frames=16)
    clips = canonicalize(read(tmp_path), load_body(), "walk", "scenes", "train", "any", options).clips
    assert [clip.name for clip in clips] == ["walk [0:35]", "walk [37:75]"]
    for clip in clips:
        assert clip.scene.body_rot.isfinite().all() and clip.scene.T_world_root.isfinite().all()


def test_a_folder_of_tables_of_joints_is_told_the_way_by_which_it_is_prepared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    made = synthesize("follow", 2, 120, torch.Generator().manual_seed(1), load_body()).scene
    save_csv(made, "dl/a take.csv", load_body())
    for words in (["check", "dl"], ["prepare", "scenes", "--root", "dl", "store"]):
        assert cli.main(["data", *words]) == 2
        said = capsys.readouterr().err.split("of tables of joint positions make scenes first, one by one: magnet ")[1]
        first, then = said.split(" (docs/own.md)")[0].split(", then magnet ")
    assert cli.main(shlex.split(first)) == 0 and cli.main([*then.split(), "--workers", "1"]) == 0
    assert "1 scene" in capsys.readouterr().out
