"""GLB and FBX files of a user's own: who is in a scene, what they are taken for, what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from magnet import cli
from magnet.body import load_body
from magnet.datamodules.fakes.glb import write_file
from magnet.datamodules.fakes.motion import FakeMotion, people, turned
from magnet.datamodules.glb import GLBReader
from magnet.datamodules.prepared import Prepared
from magnet.datamodules.preparing.canonicalize import CanonicalizeOptions
from magnet.datamodules.preparing.check import recognise
from magnet.datamodules.preparing.convert import PrepareJob, convert
from magnet.datamodules.preparing.prepare import prepare
from magnet.datamodules.reading.recording import DataError
from magnet.datamodules.store.windows import recorded_windows
from magnet.export import fbx, save_bvh, save_glb
from magnet.export.formats import write
from magnet.motion.scene import Scene
from magnet.synthesis import synthesize
from tests.export import glb_strangers

TAKES, FRAMES = 4, 12


def walk(frames: int = 24, fps: float = 60.0, seed: int = 0) -> FakeMotion:
    return people(frames, 2, fps, seed)


def one_of(motion: FakeMotion, person: int) -> FakeMotion:
    """A person alone."""
    kept = slice(person, person + 1)
    poses, transl, positions = motion.poses[:, kept], motion.transl[:, kept], motion.positions[:, kept]
    return replace(motion, poses=poses, transl=transl, positions=positions, betas=motion.betas[kept])


def duet() -> Scene:
    return synthesize("follow", 2, 120, torch.Generator().manual_seed(1), load_body()).scene.slice(0, 64)


def motionless(path: Path) -> Path:
    """A chair, and nobody."""
    glb = glb_strangers.Written()
    glb.document["scenes"][0]["nodes"].append(glb.add("nodes", {"name": "chair"}))
    return glb.save(path)


# -- who is in a scene -------------------------------------------------------------------------


def test_people_of_one_file_are_one_scene(made: Path) -> None:
    reader = GLBReader(made)
    assert reader.summary() == ["4 scenes of 1 file each: walk1, walk2, walk3, walk4"]
    found = reader.read(reader.takes()[0])
    assert (found.persons, found.fps, found.up) == (("dancer1", "dancer2"), 60.0, "+y")
    assert found.notes == ("names of Mixamo, MotionBuilder, 18 joints; m, +y up, 60 fps",)
    np.testing.assert_allclose(found.positions, people(24, 2, 60.0).positions[:, :, list(found.joints)], atol=1e-5)


def test_files_of_a_person_each_go_together_by_their_names(tmp_path: Path) -> None:
    for person, letter in enumerate("AB"):
        write_file(tmp_path / f"walk_{letter}.glb", one_of(walk(), person))
    reader = GLBReader(tmp_path)
    assert reader.summary()[0] == "1 scene of 2 files: walk (A, B)"
    (take,) = reader.found()
    found = reader.read(take)
    assert found.persons == ("A", "B") and len(found.notes) == 1
    np.testing.assert_allclose(found.positions, walk().positions[:, :, list(found.joints)], atol=1e-5)
    write_file(tmp_path / "walk_B.glb", walk())
    with pytest.raises(DataError, match=r"walk_B\.glb: holds 2 people, but other files belong to its scene, too"):
        reader.read(take)


def test_vrm_animations_of_a_couple_are_one_scene(tmp_path: Path) -> None:
    scene = duet()
    write(scene, tmp_path / "walk.vrma")
    reader = GLBReader(tmp_path)
    assert reader.summary()[0] == "1 scene of 2 files: walk (person0, person1)"
    found = reader.read(reader.found()[0])
    joints = load_body().joints(scene)[0, :, :, list(found.joints)]
    np.testing.assert_allclose(found.positions, joints, atol=1e-4)


def test_files_that_differ_in_their_suffix_alone_are_named(tmp_path: Path) -> None:
    for name in ("walk.glb", "walk.fbx", "run.glb"):
        (tmp_path / name).touch()
    assert "walk.fbx and walk.glb differ in their suffix alone: if one was made of" in GLBReader(tmp_path).summary()[-1]


def test_a_folder_that_holds_bvh_too_is_not_read_as_both(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("dl").mkdir()
    save_glb(duet(), "dl/duet.glb", load_body())
    assert recognise(Path("dl")) == "glb"
    save_bvh(duet(), "dl/duet.bvh", load_body())
    words = ["data", "check", "dl", "--workers", "1", "--picture", "none", "--trust_fps", "--min_frames", "4"]
    assert cli.main(words) == 2
    said = (
        "dl could be bvh or glb: say which with --name; bvh reads .bvh and glb reads .glb, .gltf, .vrma and .fbx alone"
    )
    assert said in capsys.readouterr().err
    assert cli.main([*words, "--name", "glb"]) == 0
    assert "all assertions hold" in capsys.readouterr().out


# -- what they are taken for -------------------------------------------------------------------


@pytest.mark.parametrize(("suffix", "label"), [(".glb", "person_"), (".vrma", "person")])
def test_what_we_wrote_comes_back_exactly_from_a_store(suffix: str, label: str, tmp_path: Path) -> None:
    body, scene = load_body(), duet()
    (tmp_path / "dl").mkdir()
    write(scene, tmp_path / f"dl/duet{suffix}")
    options = CanonicalizeOptions(min_frames=4, trust_fps=True)
    job = PrepareJob("glb", str(tmp_path / "dl"), {"split": "scenes"}, "open", options)
    manifest = prepare(job, tmp_path / "store").folder.manifest
    assert manifest["skipped"] == []
    assert [entry["persons"] for entry in manifest["persons"]] == [[f"{label}0", f"{label}1"]]
    assert any("mean residual 0.0 cm" in entry["note"] for entry in manifest["notes"])
    store = Prepared(path=str(tmp_path / "store"), body_model="open").open_store("train")
    found = store.gather(recorded_windows(store, [(0, 0)]), 64)
    assert torch.allclose(found.betas[0, :2], scene.betas[0], atol=1e-4)
    assert (found.body_rot[0, :, :2] - scene.body_rot[0]).abs().max() < 1e-4
    joints, wanted = body.joints(found)[0, :, :2], body.joints(scene)[0]
    shift = (joints - wanted)[0, 0, 0]
    assert (joints - wanted - shift).norm(dim=-1).max() < 2e-4


def test_the_axis_is_that_of_the_format_unless_the_user_says_another(tmp_path: Path) -> None:
    write_file(tmp_path / "walk.glb", turned(walk(120), "+z"))
    reader, body = GLBReader(tmp_path), load_body()
    (take,) = reader.found()
    error = convert(reader, take, body, CanonicalizeOptions()).error
    assert error and "declared up axis is +y, but people stand along +z" in error and "give --up=+z" in error
    said = convert(reader, take, body, CanonicalizeOptions(up="+z"))
    assert said.error is None and said.frames == (60,)


def test_keys_that_are_no_frames_are_noted(tmp_path: Path) -> None:
    write_file(tmp_path / "walk.glb", walk(8))
    glb = glb_strangers.opened(tmp_path / "walk.glb")
    clock = glb.numbers(np.arange(8)[:, None] / 4, "SCALAR")
    for clip in glb.document["animations"]:
        for sampler in clip["samplers"]:
            sampler["input"] = clock
    glb.save(tmp_path / "walk.glb")
    reader = GLBReader(tmp_path)
    found = reader.read(reader.found()[0])
    assert (found.fps, found.frames) == (30.0, 53)
    assert [note for note in found.notes if "keys" in note] == [
        "its keys are uneven or few: read at 30 frames a second"
    ]


# -- what is refused ---------------------------------------------------------------------------


def test_what_holds_nobody_and_fbx_without_blender_are_named_and_the_others_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing() -> list[str]:
        raise ImportError(fbx.NEEDS)

    monkeypatch.setattr(fbx, "blender", missing)
    root = tmp_path / "dl"
    root.mkdir()
    save_glb(duet(), root / "duet.glb", load_body())
    motionless(root / "room.glb")
    (root / "old.fbx").write_bytes(b"Kaydara FBX Binary")
    job = PrepareJob("glb", str(root), {"split": "scenes"}, "open", CanonicalizeOptions(min_frames=4, trust_fps=True))
    every = {"duet": "train", "room": "train", "old": "train"}
    manifest = prepare(job, tmp_path / "store", splits=every).folder.manifest
    skipped = {entry["take"]: entry["why"] for entry in manifest["skipped"]}
    assert manifest["splits"]["train"]["takes"] == 1 and set(skipped) == {"room", "old"}
    assert skipped["room"].startswith("room.glb: holds no skeleton: ") and "leave it out" in skipped["room"]
    assert skipped["old"].startswith("old.fbx: ") and "pip install bpy" in skipped["old"]
    assert not any("\n" in why for why in skipped.values())


def test_fbx_goes_through_blender(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What Blender makes of it is read as a GLB is."""

    def converted(path: Path, glb: Path) -> Path:
        write_file(glb, walk())
        return glb

    monkeypatch.setattr("magnet.export.rig_files.converted", converted)
    (tmp_path / "walk.FBX").touch()
    reader = GLBReader(tmp_path)
    assert reader.read(reader.found()[0]).persons == ("dancer1", "dancer2")
