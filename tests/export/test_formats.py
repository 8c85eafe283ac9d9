"""Every format by its suffix: what goes out comes back, and what cannot is named."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation, Slerp

import magnet
from magnet import checkpoints, cli
from magnet.body import Body, load_body, on_floor
from magnet.body.joints import JOINT_NAMES
from magnet.export import formats, load_bvh, resampled, save_smplx
from magnet.export.rig import UP
from magnet.motion.scene import Scene, cat_agents
from magnet.testing import random_scene


@pytest.mark.parametrize(("name", "smplx"), [("a.npz", False), ("a.npz", True), ("a.bvh", False)])
def test_what_can_be_read_back_holds_the_same_joints(name, smplx, duet: Scene, body: Body, tmp_path: Path):
    written = formats.write(duet, tmp_path / name, body, smplx=smplx)
    got = formats.read(written)
    assert (got.scene.fps, got.scene.agents, got.body.id) == (30.0, 2, body.id)
    assert (body.joints(got.scene) - body.joints(duet)).abs().max() < 1e-3


@pytest.mark.parametrize(("name", "smplx"), [("a.npz", False), ("a.npz", True), ("a.bvh", False)])
def test_a_part_is_read_by_the_frames_of_the_file_itself(name, smplx, duet: Scene, body: Body, tmp_path: Path):
    written = formats.write(duet, tmp_path / name, body, smplx=smplx)
    got = formats.read(written, options=formats.Reading(start=2, end=9, fps=15.0))
    assert (got.scene.fps, got.scene.frames) == (15.0, 4)
    assert (body.joints(got.scene) - body.joints(duet)[:, 2:9:2]).abs().max() < 1e-3
    T = duet.frames
    assert formats.read(written, options=formats.Reading(start=T - 1)).scene.frames == 1
    for start, end, said in (
        (T, None, f"holds {T} frames, so start {T} is behind them; give --start {T - 1} or less"),
        (0, T + 1, f"so end {T + 1} is behind them"),
        (-1, None, "start -1: expected 0 or more"),
        (4, 4, "start 4, end 4: expected 0 or more, and an end after the start"),
    ):
        with pytest.raises(ValueError, match=said):
            formats.read(written, options=formats.Reading(start=start, end=end))


@pytest.mark.parametrize("suffix", [".npz", ".bvh"])
def test_files_of_two_rates_have_no_part_in_common(suffix: str, duet: Scene, body: Body, tmp_path: Path):
    """A number of frames is another moment in each."""
    one = duet.replace(present=torch.tensor([[True, False]])).people()
    written = formats.write(one, tmp_path / f"a{suffix}", body)
    written += formats.write(one.replace(fps=60.0), tmp_path / f"b{suffix}", body)
    with pytest.raises(ValueError, match="--start and --end count frames, so cut each with magnet export"):
        formats.read(written, options=formats.Reading(start=2, fps=30.0, trim=True))
    assert formats.read(written, options=formats.Reading(fps=30.0, trim=True)).scene.agents == 2


@pytest.mark.parametrize("suffix", [s for s in formats.WRITTEN if s not in (".mp4", ".fbx")])
def test_every_suffix_writes_what_it_says(suffix, duet: Scene, body: Body, tmp_path: Path):
    if suffix in formats.USD:
        pytest.importorskip("pxr", reason="usd-core is not installed")
    written = formats.write(duet.slice(0, 3), tmp_path / f"deep/a{suffix}", body, style="skeleton")
    assert written and all(path.exists() and path.suffix == suffix for path in written)
    begins = {".npz": b"PK", ".bvh": b"HIERARCHY", ".glb": b"glTF", ".csv": b"scene,frame", ".gif": b"GIF89a",
              ".webp": b"RIFF", ".png": b"\x89PNG", ".usdc": b"PXR-USDC", ".usda": b"#usda"}  # fmt: skip
    assert all(path.read_bytes().startswith(begins.get(suffix, b"")) for path in written)


@pytest.mark.parametrize("suffix", [".GIF", ".PNG", ".WebP", ".NPZ", ".Glb", ".HTML", ".CSV"])
def test_a_suffix_may_be_in_capitals(suffix, duet: Scene, body: Body, tmp_path: Path):
    (path,) = formats.write(duet.slice(0, 2), tmp_path / f"a{suffix}", body, style="skeleton")
    assert path.stat().st_size > 100
    assert path.name == f"a{suffix}"


def test_a_frame_without_rotations_is_not_written_as_motion(duet: Scene, body: Body, tmp_path: Path):
    valid = torch.ones(1, duet.frames, dtype=torch.bool)
    valid[:, 3] = False
    T_world_root = duet.T_world_root.clone()
    T_world_root[:, 3] = 0.0
    broken = duet.replace(valid=valid, T_world_root=T_world_root)
    with pytest.raises(ValueError, match=r"not valid: .* is no rotation \(scene 0, frame 3.*cut such frames out"):
        formats.write(broken, tmp_path / "a.glb", body)
    formats.write(broken, tmp_path / "a.npz", body)
    formats.write(duet.replace(valid=valid), tmp_path / "a.glb", body)


@pytest.mark.slow
def test_a_page_and_a_film_can_be_light_and_a_film_is_of_the_size_asked_for(duet: Scene, body: Body, tmp_path: Path):
    (page,) = formats.write(duet, tmp_path / "a.html", body, style="light")
    assert '"styles":["light"]' in page.read_text()
    (film,) = formats.write(duet.slice(0, 2), tmp_path / "a.gif", body, style="light", size=(96, 64))
    with Image.open(film) as picture:
        assert picture.size == (96, 64)


def test_mp4_is_written_where_its_package_is(duet: Scene, body: Body, tmp_path: Path):
    pytest.importorskip("av", reason="PyAV is not installed")
    (path,) = formats.write(duet.slice(0, 3), tmp_path / "a.mp4", body, style="skeleton")
    assert b"ftyp" in path.read_bytes()[:16]


def test_several_scenes_go_into_a_file_each_where_a_format_holds_one(duet: Scene, body: Body, tmp_path: Path):
    both = duet.repeat(2)
    names = {
        suffix: [p.name for p in formats.write(both, tmp_path / f"a{suffix}", body)] for suffix in (".glb", ".bvh")
    }
    assert names[".glb"] == ["a_scene0.glb", "a_scene1.glb"]
    assert names[".bvh"] == ["a_scene0_0.bvh", "a_scene0_1.bvh", "a_scene1_0.bvh", "a_scene1_1.bvh"]
    assert [p.name for p in formats.write(both, tmp_path / "a.csv", body)] == ["a.csv"]
    assert formats.read(formats.write(both, tmp_path / "b.npz", body)).scene.scenes == 2


def test_the_table_says_where_every_joint_is(duet: Scene, body: Body, tmp_path: Path):
    gone = random_scene(2, 3, 2, torch.Generator().manual_seed(1), torch.tensor([[True, True], [False, True]]))
    (path,) = formats.write(gone, tmp_path / "a.csv", body)
    with path.open() as file:
        rows = list(csv.DictReader(file))
    assert [(r["scene"], r["frame"], r["person"]) for r in rows] == [
        *(("0", str(t), str(p)) for t in range(3) for p in range(2)),
        *(("1", str(t), "1") for t in range(3)),
    ]
    joints = body.joints(gone)
    for row in rows:
        b, t, p = (int(row[key]) for key in ("scene", "frame", "person"))
        there = [[float(row[f"{name}_{axis}_m"]) for axis in "xyz"] for name in JOINT_NAMES]
        assert (torch.tensor(there) - joints[b, t, p]).abs().max() < 1e-5
        assert float(row["time_s"]) == pytest.approx(t / 30, abs=1e-6)


def test_a_rate_that_is_asked_for_is_that_of_the_file(duet: Scene, body: Body, tmp_path: Path):
    got = formats.read(formats.write(duet, tmp_path / "a.bvh", body, fps=60.0))
    assert (got.scene.fps, got.scene.frames) == (60.0, 23)
    assert (body.joints(got.scene)[:, ::2] - body.joints(duet)).abs().max() < 1e-4


def test_rotations_between_frames_are_those_of_an_independent_slerp(duet: Scene):
    fast = resampled(duet, 100.0)
    at = np.arange(fast.frames) / 100
    want = Slerp(np.arange(12) / 30, Rotation.from_matrix(duet.body_rot[0, :, 1, 5].numpy()))(at).as_matrix()
    assert np.abs(fast.body_rot[0, :, 1, 5].numpy() - want).max() < 1e-5
    want = np.stack([np.interp(at, np.arange(12) / 30, x) for x in duet.T_world_root[0, :, 0, :3, 3].numpy().T], axis=1)
    assert np.abs(fast.T_world_root[0, :, 0, :3, 3].numpy() - want).max() < 1e-5


def test_a_frame_beside_one_that_is_not_valid_is_not_valid(duet: Scene):
    valid = torch.ones(1, 12, dtype=torch.bool)
    valid[0, 4] = False
    twice = resampled(duet.replace(valid=valid), 60.0).valid
    assert twice is not None and (~twice[0]).nonzero()[:, 0].tolist() == [7, 8, 9]


def test_several_npz_are_several_people(duet: Scene, body: Body, tmp_path: Path):
    from magnet.export import save_smplx

    got = formats.read(save_smplx(duet, tmp_path / "a.npz", body, apart=True))
    assert (body.joints(got.scene) - body.joints(duet)).abs().max() < 1e-4


def test_a_stranger_body_is_asked_for(duet: Scene, body: Body, tmp_path: Path):
    other = duet.replace(body="smplx-neutral")
    other.save(tmp_path / "a.npz")
    with pytest.raises(ValueError, match="belong to body 'smplx-neutral', not 'open-1'; give its file: --body"):
        formats.read(tmp_path / "a.npz")
    with pytest.raises(ValueError, match="belong to body 'smplx-neutral'"):
        formats.write(other, tmp_path / "a.glb", body)


def test_what_cannot_be_read_or_written_is_named(duet: Scene, body: Body, tmp_path: Path):
    (tmp_path / "a.npz").write_bytes(b"PK\x03\x04 cut")
    with pytest.raises(ValueError, match="not a readable npz"):
        formats.read(tmp_path / "a.npz")
    with pytest.raises(FileNotFoundError, match=r"b\.npz: no such file"):
        formats.read(tmp_path / "b.npz")
    for paths in ([], ["a.glb"], ["a.npz", "b.bvh"]):
        with pytest.raises(ValueError, match=r"expected \.npz or \.bvh files, all of one kind"):
            formats.read(paths)
    with pytest.raises(ValueError, match=r"cannot write a file with suffix '\.obj'; use \.npz"):
        formats.write(duet, tmp_path / "a.obj", body)
    formats.write(duet.repeat(2), tmp_path / "two.npz", body)
    with pytest.raises(ValueError, match="holds 2 scenes; several files are several people"):
        formats.read([tmp_path / "two.npz", tmp_path / "two.npz"])


def test_the_open_body_is_the_default(duet: Scene, tmp_path: Path):
    (path,) = formats.write(duet, tmp_path / "a.glb")
    assert path.read_bytes() == formats.write(duet, tmp_path / "b.glb", load_body("open"))[0].read_bytes()


def test_pictures_mark_what_the_scene_says_was_given_at_any_rate(duet: Scene, body: Body, tmp_path: Path, pixels_like):
    from magnet.export.cast import known_frames
    from magnet.export.drawing import CONTEXT

    given = torch.zeros(1, 12, 2, dtype=torch.bool)
    given[:, :6, 0] = True
    said = duet.replace(given=given)
    plain, marked = (Image.open(formats.write(s, tmp_path / f"{i}.png", body)[0]) for i, s in enumerate((duet, said)))
    assert pixels_like(marked, CONTEXT[0]) > 5 * pixels_like(plain, CONTEXT[0])
    assert torch.equal(known_frames(said, 3), given[0])
    twice = resampled(said, 60.0).given
    assert twice is not None and twice[0].sum(dim=0).tolist() == [11, 0]  # frame 5.5 is half generated
    both = formats.together([said.permute_agents([0]), duet.permute_agents([1])], ["a", "b"])
    assert torch.equal(both.given, given)  # type: ignore[arg-type]


# -- the floor ---------------------------------------------------------------------------------


def by_another_program(scene: Scene, person: int, path: Path, body: Body, up: str = "y", lies: bool = False) -> Path:
    """One person as AMASS writes people; whoever lies has the head at +z and the back on y = 0."""
    (made,) = save_smplx(scene.permute_agents(torch.tensor([person])), path, body)
    with np.load(made) as file:
        arrays = {key: file[key] for key in ("poses", "trans", "mocap_frame_rate")}
    turn = Rotation.from_matrix(UP["z" if lies else up].T)
    rest = body.rest_joints(torch.zeros(10))[0].double().numpy()
    poses, pelvis = arrays["poses"][0].copy(), turn.apply(arrays["trans"][0] + rest) + lies * np.array([0, 0.4, -1])
    poses[:, :3] = (turn * Rotation.from_rotvec(poses[:, :3])).as_rotvec()
    np.savez(made, poses=poses, trans=pelvis - rest, mocap_frame_rate=arrays["mocap_frame_rate"])
    return made


def test_whoever_lies_in_an_npz_beside_somebody_who_stands_stays_lying(duet: Scene, body: Body, tmp_path: Path):
    """As long as nobody walks, floors tell: a standing person's is where the other lies."""
    T_world_root = duet.T_world_root.clone()
    T_world_root[..., 2, 3] = 0.3 * T_world_root[..., 2, 3] + 0.1
    still = duet.replace(T_world_root=T_world_root, betas=torch.zeros_like(duet.betas))
    stands = by_another_program(still, 0, tmp_path / "stands.npz", body)
    lies = by_another_program(still, 1, tmp_path / "lies.npz", body, lies=True)
    got = formats.read([stands, lies], body)
    torso = got.scene.T_world_root[0, :, :, :3, 1].mean(dim=0)
    assert torso[0, 1] > 0.8 and torso[1, 2] > 0.8
    assert any("lies.npz: torsos point along z, so this person lies" in note for note in got.notes)
    assert formats.read([stands, lies], body, formats.Reading(up="z")).scene.T_world_root[0, :, 1, 1, 1].mean() > 0.8
    other = by_another_program(still, 1, tmp_path / "z.npz", body, up="z")
    both = formats.read([stands, other], body)
    assert (both.scene.T_world_root[0, :, :, 1, 1].mean(dim=0) > 0.8).all()
    assert sum("files have different axes" in note for note in both.notes) == 2


def upstairs(duet: Scene, path: Path, body: Body, ours: bool) -> Path:
    """A duet two metres over the floor, in a file of ours or, without the body's name, of another program."""
    T_world_root = duet.T_world_root.clone()
    T_world_root[..., 1, 3] += 2.0
    (path,) = formats.write(duet.replace(T_world_root=T_world_root), path, body, smplx=True)
    if not ours:
        with np.load(path) as file:
            np.savez(path, **{key: file[key] for key in file.files if key != "body"})
    return path


def test_another_programs_people_are_put_on_the_floor_and_ours_stay(duet: Scene, body: Body, tmp_path: Path):
    expected = duet.T_world_root[..., 1, 3]
    theirs = upstairs(duet, tmp_path / "a.npz", body, ours=False)
    lowered = formats.read(theirs)
    away = lowered.scene.T_world_root[..., 1, 3] - expected
    assert away.abs().max() < 0.25 and (away - away.flatten()[0]).abs().max() < 1e-2
    assert any("lowered by" in note and "--keep_floor" in note for note in lowered.notes)
    for kept in (
        formats.read(theirs, options=formats.Reading(keep_floor=True)),
        formats.read(upstairs(duet, tmp_path / "b.npz", body, ours=True)),
    ):
        assert torch.allclose(kept.scene.T_world_root[..., 1, 3], expected + 2, atol=1e-2)
        assert any(
            "m over y = 0, where models have their floor; `magnet export --on_floor` puts" in note
            for note in kept.notes
        )


@pytest.mark.parametrize("off", [0.15, -0.15])
def test_another_programs_people_are_put_on_the_floor_from_any_height(off: float, duet: Scene, body: Body, tmp_path):
    T_world_root = on_floor(duet, body).T_world_root.clone()
    T_world_root[..., 1, 3] += off - 2.0
    theirs = upstairs(duet.replace(T_world_root=T_world_root), tmp_path / "a.npz", body, ours=False)
    got = formats.read(theirs)
    assert torch.allclose(on_floor(got.scene, body).T_world_root, got.scene.T_world_root, atol=1e-5)
    kept = formats.read(theirs, options=formats.Reading(keep_floor=True)).scene
    moved = float((kept.T_world_root - got.scene.T_world_root)[..., 1, 3].mean())
    assert any(f"{'lowered' if moved > 0 else 'raised'} by {100 * abs(moved):.1f} cm" in note for note in got.notes)


def test_whoever_stands_on_the_floor_is_not_spoken_of(duet: Scene, body: Body, tmp_path: Path):
    for name, smplx in (("a.npz", False), ("b.npz", True), ("c.bvh", False)):
        notes = formats.read(formats.write(duet, tmp_path / name, body, smplx=smplx)).notes
        assert not any("y = 0" in note or "floor" in note for note in notes)


def test_a_bvh_that_is_moved_onto_the_floor_says_so_and_names_what_leaves_it(
    duet: Scene, body: Body, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = formats.write(duet, tmp_path / "a.bvh", body)[0]
    for metres, said in ((0.0004, None), (0.1, "lowered by 10.0 cm"), (-0.1, "raised by 10.0 cm")):
        found = replace(load_bvh(path, body), floor=metres)
        monkeypatch.setattr(formats, "load_bvh", lambda *_, found=found, **__: found)
        notes = [note for note in formats.read(path).notes if "onto the floor" in note]
        assert notes == ([f"everybody was {said} onto the floor; --keep_floor leaves them"] if said else [])


def test_a_new_format_is_a_function_and_a_line(duet, tmp_path, body, monkeypatch, capsys):
    """Where a thing goes (CONTRIBUTING): one that writes how far everybody goes, reached as every other is."""

    def save_way(scene: Scene, path: Path, options: formats.WriteOptions) -> list[Path]:
        ground = scene.T_world_root[..., [0, 2], 3].diff(dim=1).norm(dim=-1).sum(dim=1)
        path.write_text("".join(f"{metres:.3f}\n" for metres in ground[0].tolist()))
        return [path]

    monkeypatch.setitem(formats.WRITTEN, ".way", formats.Format(save_way))
    assert len(formats.write(duet.repeat(2), tmp_path / "a.way", body)) == 2
    scene = duet.save(tmp_path / "duet.npz")
    assert cli.main(["export", str(scene), str(tmp_path / "b.way")]) == 0
    assert len((tmp_path / "b.way").read_text().split()) == duet.agents
    with pytest.raises(ValueError, match=r"use .*\.way"):
        formats.write(duet, tmp_path / "a.obj", body)


def couple(kind: str, folder: Path) -> list[Path]:
    """Two people who stand, in metres, y up, as files of people."""
    scene = Scene.load(checkpoints.FOLDER / "duet" / "scenes" / "duet.npz").slice(0, 16)
    return formats.write(scene, folder / f"take{kind}", smplx=kind == ".npz", each=kind == ".npz")


WRONG = {
    "up z": ({"up": "z"}, r"up z, as said, leaves nobody upright; the files look like y up: --up=y"),
    "up -y": ({"up": "-y"}, r"up -y, as said, leaves nobody upright; the files look like y up"),
    "unit cm": ({"unit": "cm"}, r"unit cm, as said, .* m .*; the files look like m: --in_unit m"),
}


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("kind", [".bvh", ".npz"])
def test_an_axis_or_unit_that_nobody_can_have_is_warned_of(kind: str, wrong: str, tmp_path: Path) -> None:
    options, said = WRONG[wrong]
    with pytest.warns(UserWarning, match=said) as caught:
        magnet.read(*couple(kind, tmp_path), **options)
    assert len([one for one in caught if "as said" in str(one.message)]) == 1


@pytest.mark.parametrize("options", [{}, {"up": "y"}, {"unit": "m"}], ids=str)
@pytest.mark.parametrize("kind", [".bvh", ".npz"])
def test_an_axis_and_unit_that_fit_are_not_warned_of(kind: str, options: dict, tmp_path: Path) -> None:
    assert not formats.warned(magnet.read(*couple(kind, tmp_path), **options).notes)


def test_whoever_really_lies_is_read_with_the_axis_that_is_said(tmp_path: Path) -> None:
    one = Scene.load(checkpoints.FOLDER / "duet" / "scenes" / "duet.npz").slice(0, 16).people().select([0])
    T_lying = torch.eye(4)
    T_lying[:3, :3] = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    lies = on_floor(one.transformed(T_lying))
    read = magnet.read(*formats.write(lies, tmp_path / "lies.bvh"), up="y")
    assert torch.allclose(read.T_world_root, lies.T_world_root, atol=1e-4) and not formats.warned(read.notes)


@pytest.mark.parametrize("suffix", [".glb", ".csv", ".usdc", ".usd", ".html"])
def test_what_is_only_written_is_said_to_be_so(suffix: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"expected .npz or .bvh files, all of one kind; {suffix} can be written but"):
        formats.read(tmp_path / f"a{suffix}")


@pytest.mark.parametrize("suffix", [".npz", ".bvh", ".csv", ".glb", ".html"])
def test_a_scene_without_frames_is_not_written(suffix: str, duet: Scene, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="0 frames of 2 people: there is nothing to write"):
        formats.write(duet.slice(0, 0), tmp_path / f"a{suffix}")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("options", [{}, {"smplx": True, "each": True}], ids=["bvh", "npz"])
def test_files_of_more_people_from_before_are_named_and_stay(options: dict, duet: Scene, tmp_path: Path) -> None:
    kind = ".npz" if options else ".bvh"
    four = magnet.Motion.of(cat_agents([duet, duet]))
    four.save(tmp_path / f"st{kind}", **options)
    said = f"^st_2{kind}, st_3{kind}: lie beside what was written and are no part of it"
    with pytest.warns(UserWarning, match=said):
        magnet.Motion.of(duet).save(tmp_path / f"st{kind}", **options)
    assert len(list(tmp_path.iterdir())) == 4
    assert not formats.left_over([tmp_path / f"st_{p}{kind}" for p in range(4)])
    assert not formats.left_over([tmp_path / f"st_1{kind}"])  # a person alone, who is called so


def test_files_of_people_before_and_between_those_written_are_named(tmp_path: Path) -> None:
    """Whoever is exported alone keeps a number, so that others' files may lie below it."""
    files = [tmp_path / f"st_{person}.bvh" for person in (0, 1, 2, 3, 4, 6)]
    for file in files:
        file.touch()
    assert formats.left_over([files[1], files[3]]) == [files[0], files[2], files[4]]
    assert not formats.left_over([files[3], tmp_path / "other_1.bvh"])  # no people of one scene


def test_commands_name_files_of_more_people_from_before(
    duet: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    formats.write(cat_agents([duet, duet]), tmp_path / "st.bvh")
    assert cli.main(["export", str(duet.save(tmp_path / "duet")), str(tmp_path / "st.bvh")]) == 0
    assert "st_2.bvh, st_3.bvh: lie beside" in capsys.readouterr().out
