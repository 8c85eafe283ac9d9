"""Scenes read from files: parts, several people, axes, units and floors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import magnet
from magnet import checkpoints
from magnet.body import Body, on_floor
from magnet.export import formats, load_rigs, reading, save_smplx
from magnet.export.rig import UP
from magnet.motion.scene import Scene


@pytest.mark.parametrize(("name", "smplx"), [("a.npz", False), ("a.npz", True), ("a.bvh", False)])
def test_what_can_be_read_back_holds_the_same_joints(name, smplx, duet: Scene, body: Body, tmp_path: Path):
    written = formats.write(duet, tmp_path / name, body, smplx=smplx)
    got = reading.read(written)
    assert (got.scene.fps, got.scene.agents, got.body.id) == (30.0, 2, body.id)
    assert (body.joints(got.scene) - body.joints(duet)).abs().max() < 1e-3


@pytest.mark.parametrize(("name", "smplx"), [("a.npz", False), ("a.npz", True), ("a.bvh", False)])
def test_a_part_is_read_by_the_frames_of_the_file_itself(name, smplx, duet: Scene, body: Body, tmp_path: Path):
    written = formats.write(duet, tmp_path / name, body, smplx=smplx)
    got = reading.read(written, options=reading.Reading(start=2, end=9, fps=15.0))
    assert (got.scene.fps, got.scene.frames) == (15.0, 4)
    assert (body.joints(got.scene) - body.joints(duet)[:, 2:9:2]).abs().max() < 1e-3
    T = duet.frames
    assert reading.read(written, options=reading.Reading(start=T - 1)).scene.frames == 1
    for start, end, said in (
        (T, None, f"holds {T} frames, so start {T} is behind them; give --start {T - 1} or less"),
        (0, T + 1, f"so end {T + 1} is behind them"),
        (-1, None, "start -1: expected 0 or more"),
        (4, 4, "start 4, end 4: expected 0 or more, and an end after the start"),
    ):
        with pytest.raises(ValueError, match=said):
            reading.read(written, options=reading.Reading(start=start, end=end))


@pytest.mark.parametrize("suffix", [".npz", ".bvh"])
def test_files_of_two_rates_have_no_part_in_common(suffix: str, duet: Scene, body: Body, tmp_path: Path):
    """A number of frames is another moment in each."""
    one = duet.replace(present=torch.tensor([[True, False]])).people()
    written = formats.write(one, tmp_path / f"a{suffix}", body)
    written += formats.write(one.replace(fps=60.0), tmp_path / f"b{suffix}", body)
    with pytest.raises(ValueError, match="--start and --end count frames, so cut each with magnet export"):
        reading.read(written, options=reading.Reading(start=2, fps=30.0, trim=True))
    got = reading.read(written, options=reading.Reading(fps=30.0, trim=True))
    said = "files of 30 and 60 frames a second, all brought to 30"
    assert got.scene.agents == 2 and got.notes.count(said) == 1
    assert not any("brought" in note for note in reading.read(written[:1] * 2, options=reading.Reading(fps=20.0)).notes)


@pytest.mark.parametrize("suffix", [".npz", ".bvh", ".csv"])
@pytest.mark.parametrize("files", [1, 2])
def test_files_of_another_rate_are_said_to_be_resampled(
    files: int, suffix: str, duet: Scene, body: Body, tmp_path: Path
) -> None:
    one = duet.slice(0, 8).replace(present=torch.tensor([[True, False]])).people()
    written = [formats.write(one, tmp_path / f"{n}{suffix}", body)[0] for n in range(files)]
    for rate, said in ((15.0, ["resampled from 30 to 15 frames a second"]), (30.0, []), (None, [])):
        notes = reading.read(written, options=reading.Reading(fps=rate)).notes
        assert [note for note in notes if "resampled" in note] == said


def test_several_npz_are_several_people(duet: Scene, body: Body, tmp_path: Path):
    from magnet.export import save_smplx

    got = reading.read(save_smplx(duet, tmp_path / "a.npz", body, apart=True))
    assert (body.joints(got.scene) - body.joints(duet)).abs().max() < 1e-4


def test_a_stranger_body_is_asked_for(duet: Scene, body: Body, tmp_path: Path):
    other = duet.replace(body="smplx-neutral")
    other.save(tmp_path / "a.npz")
    with pytest.raises(ValueError, match="belong to body 'smplx-neutral', not 'open-1'; give its file: --body"):
        reading.read(tmp_path / "a.npz")
    with pytest.raises(ValueError, match="belong to body 'smplx-neutral'"):
        formats.write(other, tmp_path / "a.glb", body)


def test_what_cannot_be_read_is_named(duet: Scene, body: Body, tmp_path: Path):
    (tmp_path / "a.npz").write_bytes(b"PK\x03\x04 cut")
    with pytest.raises(ValueError, match="not a readable npz"):
        reading.read(tmp_path / "a.npz")
    with pytest.raises(FileNotFoundError, match=r"b\.npz: no such file"):
        reading.read(tmp_path / "b.npz")
    for paths in ([], ["a.usdz"], ["a.npz", "b.bvh"], ["a.glb", "b.npz"]):
        with pytest.raises(ValueError, match=r"expected \.npz, \.pkl and \.pt, or \.csv files alone, or files of skel"):
            reading.read(paths)
    formats.write(duet.repeat(2), tmp_path / "two.npz", body)
    with pytest.raises(ValueError, match="holds 2 scenes; several files are several people"):
        reading.read([tmp_path / "two.npz", tmp_path / "two.npz"])


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
    got = reading.read([stands, lies], body)
    torso = got.scene.T_world_root[0, :, :, :3, 1].mean(dim=0)
    assert torso[0, 1] > 0.8 and torso[1, 2] > 0.8
    assert any("lies.npz: torsos point along z, so this person lies" in note for note in got.notes)
    assert reading.read([stands, lies], body, reading.Reading(up="z")).scene.T_world_root[0, :, 1, 1, 1].mean() > 0.8
    other = by_another_program(still, 1, tmp_path / "z.npz", body, up="z")
    both = reading.read([stands, other], body)
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
    lowered = reading.read(theirs)
    away = lowered.scene.T_world_root[..., 1, 3] - expected
    assert away.abs().max() < 0.25 and (away - away.flatten()[0]).abs().max() < 1e-2
    assert any("lowered by" in note and "--keep_floor" in note for note in lowered.notes)
    for kept in (
        reading.read(theirs, options=reading.Reading(keep_floor=True)),
        reading.read(upstairs(duet, tmp_path / "b.npz", body, ours=True)),
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
    got = reading.read(theirs)
    assert torch.allclose(on_floor(got.scene, body).T_world_root, got.scene.T_world_root, atol=1e-5)
    kept = reading.read(theirs, options=reading.Reading(keep_floor=True)).scene
    moved = float((kept.T_world_root - got.scene.T_world_root)[..., 1, 3].mean())
    assert any(f"{'lowered' if moved > 0 else 'raised'} by {100 * abs(moved):.1f} cm" in note for note in got.notes)


def test_how_far_people_were_moved_is_told_of_those_who_are_there(duet: Scene, body: Body, tmp_path: Path) -> None:
    """Beside a file of ours with free slots, whose nobody is not moved."""
    alone = duet.permute_agents(torch.tensor([0]))
    theirs = upstairs(alone, tmp_path / "theirs.npz", body, ours=False)
    root = alone.T_world_root.clone()
    root[..., 1, 3] += 2.0
    ours = alone.replace(T_world_root=root).pad_agents(3).save(tmp_path / "ours.npz")
    got, kept = (reading.read([theirs, ours], options=reading.Reading(keep_floor=keep)) for keep in (False, True))
    moved = float((kept.scene.T_world_root - got.scene.T_world_root)[0, 0, 0, 1, 3])
    assert moved > 1.5 and any(f"lowered by {moved:.2f} m" in note for note in got.notes)


def test_whoever_stands_on_the_floor_is_not_spoken_of(duet: Scene, body: Body, tmp_path: Path):
    for name, smplx in (("a.npz", False), ("b.npz", True), ("c.bvh", False)):
        notes = reading.read(formats.write(duet, tmp_path / name, body, smplx=smplx)).notes
        assert not any("y = 0" in note or "floor" in note for note in notes)


def test_a_bvh_that_is_moved_onto_the_floor_says_so_and_names_what_leaves_it(
    duet: Scene, body: Body, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = formats.write(duet, tmp_path / "a.bvh", body)[0]
    for metres, said in ((0.0004, None), (0.1, "lowered by 10.0 cm"), (-0.1, "raised by 10.0 cm")):
        found = replace(load_rigs(path, body), floor=metres)
        monkeypatch.setattr(reading, "load_rigs", lambda *_, found=found, **__: found)
        notes = [note for note in reading.read(path).notes if "onto the floor" in note]
        assert notes == ([f"everybody was {said} onto the floor; --keep_floor leaves them"] if said else [])


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
    assert not reading.warned(magnet.read(*couple(kind, tmp_path), **options).notes)


def test_whoever_really_lies_is_read_with_the_axis_that_is_said(tmp_path: Path) -> None:
    one = Scene.load(checkpoints.FOLDER / "duet" / "scenes" / "duet.npz").slice(0, 16).people().select([0])
    T_lying = torch.eye(4)
    T_lying[:3, :3] = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    lies = on_floor(one.transformed(T_lying))
    read = magnet.read(*formats.write(lies, tmp_path / "lies.bvh"), up="y")
    assert torch.allclose(read.T_world_root, lies.T_world_root, atol=1e-4) and not reading.warned(read.notes)


@pytest.mark.parametrize("suffix", [".usdc", ".usd", ".html"])
def test_what_is_only_written_is_said_to_be_so(suffix: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"\(.bvh, .glb, .gltf, .vrm, .vrma, .fbx\); {suffix} can be written but"):
        reading.read(tmp_path / f"a{suffix}")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"fps": 1e9}, r"fps: got 1e\+09, expected over 0 and at most 1000"),
        ({"start": 1.5}, "start: got 1.5, expected a whole number"),
        ({"end": "a"}, "end: got 'a', expected a whole number"),
        ({"unit": []}, r"unit: got \[\], expected a word, or None"),
        ({"trim": None}, "trim: got None, expected True or False"),
        ({"joints": ["left_hip"]}, r"joints: got \['left_hip'\], expected names by ours"),
    ],
)
def test_options_that_cannot_be_are_refused_in_one_line(options: dict, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        reading.Reading(**options)


def test_files_come_one_by_one_in_lists_or_as_a_folder_gives_them(duet: Scene, tmp_path: Path) -> None:
    formats.write(duet, tmp_path / "a.bvh")
    paths = sorted(tmp_path.glob("*.bvh"))
    for given in (paths, [paths], [iter(paths)]):
        assert magnet.read(*given).agents == 2
    with pytest.raises(ValueError, match="paths: got int, expected files' names, or lists of them"):
        magnet.read(3)  # type: ignore[arg-type]
