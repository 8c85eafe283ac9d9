"""SMPL-X style files: what other tools read from them, and that nothing is lost on the way back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import roma
import torch

from magnet.body import Body, load_body
from magnet.export import load_smplx, save_smplx
from magnet.export.npz import read_smplx, scene_of
from magnet.export.rig import UP
from magnet.export.smpl_keys import SMPLX_PELVIS
from magnet.motion.scene import Scene
from magnet.synthesis import synthesize
from magnet.testing import random_scene


@pytest.fixture
def trio() -> Scene:
    return random_scene(1, 20, 3, torch.Generator().manual_seed(2)).replace(names=("trio",))


def test_joints_return_within_a_tenth_of_a_millimetre(trio: Scene, body: Body, tmp_path: Path) -> None:
    (path,) = save_smplx(trio, tmp_path / "trio.npz", body)
    back = load_smplx(path, body)
    assert (back.fps, back.body, back.names) == (trio.fps, trio.body, trio.names)
    assert (body.joints(back) - body.joints(trio)).abs().max() < 1e-4


@pytest.mark.parametrize("whose", ["open", "smplx"])
def test_keys_are_the_conventional_ones(whose: str, trio: Scene, body: Body, tmp_path: Path) -> None:
    """Read as another tool would: the root turns about SMPL-X's pelvis at rest, then transl is added."""
    theirs = body.J_template + torch.tensor(SMPLX_PELVIS)
    smplx = Body(**{**vars_of(body), "id": "smplx-neutral", "J_template": theirs})  # where SMPL-X's mean shape is
    if whose == "smplx":
        body, trio = smplx, trio.replace(body=smplx.id)
    rotation = pytest.importorskip("scipy.spatial.transform", reason="scipy is not installed").Rotation
    (path,) = save_smplx(trio, tmp_path / "trio.npz", body)
    with np.load(path, allow_pickle=False) as file:
        assert file["poses"].shape == (3, 20, 165)
        assert not file["poses"][..., 66:].any()
        assert (str(file["gender"]), float(file["mocap_frame_rate"]), str(file["body"])) == ("neutral", 30.0, trio.body)
        assert file["betas"].any() == (whose == "smplx")
        rest = smplx.rest_joints(torch.from_numpy(file["betas"]))[:, 0].numpy()
        pelvis = rest[:, None] + file["transl"]
        turned = rotation.from_rotvec(file["poses"][..., :3].reshape(-1, 3)).as_matrix().reshape(3, 20, 3, 3)
        knee = rotation.from_rotvec(file["poses"][..., 12:15].reshape(-1, 3)).as_matrix().reshape(3, 20, 3, 3)
    T_world_root = trio.T_world_root[0].transpose(0, 1).numpy()
    assert np.abs(pelvis - T_world_root[..., :3, 3]).max() < 1e-6
    assert np.abs(turned - T_world_root[..., :3, :3]).max() < 1e-5
    assert np.abs(knee - trio.body_rot[0, :, :, 3].transpose(0, 1).numpy()).max() < 1e-5


def test_one_file_a_person_holds_that_person(trio: Scene, body: Body, tmp_path: Path) -> None:
    gone = trio.replace(present=torch.tensor([[True, False, True]]))
    paths = save_smplx(gone, tmp_path / "trio", body, apart=True)
    assert [path.name for path in paths] == ["trio_person0.npz", "trio_person2.npz"], "numbered as in the scene"
    back = load_smplx(paths[1], body)
    assert back.agents == 1
    assert (body.joints(back) - body.joints(trio)[:, :, 2:]).abs().max() < 1e-4


def test_shapes_and_places_of_the_open_body_come_back_as_they_were(trio: Scene, body: Body, tmp_path: Path) -> None:
    (path,) = save_smplx(trio, tmp_path / "trio.npz", body)
    back = load_smplx(path, body)
    assert torch.equal(back.betas, trio.betas)
    assert torch.equal(back.T_world_root[..., :3, 3], trio.T_world_root[..., :3, 3])
    with np.load(path) as file:  # as they were written before `body_betas`
        old = {key: file[key] for key in file.files if key != "body_betas"} | {"betas": file["body_betas"]}
    place = trio.T_world_root[0, :, :, :3, 3].transpose(0, 1).double().numpy()
    np.savez(tmp_path / "old.npz", **{**old, "transl": place, "trans": place})
    assert torch.equal(load_smplx(tmp_path / "old.npz", body).T_world_root, back.T_world_root)


@pytest.mark.parametrize("apart", [False, True])
def test_what_was_given_comes_back_beside_the_conventional_keys(trio: Scene, body: Body, tmp_path, apart) -> None:
    given = torch.rand(1, 20, 3, generator=torch.Generator().manual_seed(1)) > 0.5
    (plain, *_) = save_smplx(trio, tmp_path / "plain", body, apart=apart)
    paths = save_smplx(trio.replace(given=given), tmp_path / "told", body, apart=apart)
    for p, path in enumerate(paths):
        with np.load(plain) as without, np.load(path) as file:
            assert set(file.files) - set(without.files) == {"given"}
        wanted = given[:, :, p : p + 1] if apart else given
        assert torch.equal(load_smplx(path, body).given, wanted)
        as_lists = {key: value.tolist() for key, value in dict(np.load(path)).items()}  # such as in a pickle
        assert torch.equal(scene_of(path, as_lists, body)[0].given, wanted)
    assert load_smplx(plain, body).given is None


def test_what_does_not_fit_is_named(trio: Scene, body: Body, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="got 2 scenes"):
        save_smplx(trio.repeat(2), tmp_path / "a.npz", body)
    with pytest.raises(ValueError, match="belongs to body 'other'"):
        save_smplx(trio.replace(body="other"), tmp_path / "a.npz", body)
    np.savez(tmp_path / "b.npz", poses=np.zeros((4, 165)))
    with pytest.raises(ValueError, match="lacks mocap_frame_rate, transl"):
        load_smplx(tmp_path / "b.npz", body)
    facts = {"transl": np.zeros((4, 3)), "betas": np.zeros(10), "mocap_frame_rate": 30.0}
    np.savez(tmp_path / "c.npz", poses=np.zeros((4, 63)), **facts)
    with pytest.raises(ValueError, match=r"poses \(1, 4, 63\).*66 or more"):
        load_smplx(tmp_path / "c.npz", body)
    nobody = {"poses": np.zeros((0, 4, 165)), "transl": np.zeros((0, 4, 3)), "betas": np.zeros((0, 10))}
    with pytest.raises(ValueError, match=r"poses \(0, 4, 165\).*of P people"):
        scene_of("nobody", {**facts, **nobody}, body)
    np.savez(tmp_path / "d.npz", poses=np.zeros((4, 165)), body="other", surface_model_type="smplx", **facts)
    with pytest.raises(ValueError, match="written for body 'other'"):
        load_smplx(tmp_path / "d.npz", body)


# -- files of other tools ----------------------------------------------------------------------


def foreign(scene: Scene, body: Body, path: Path, drop: tuple[str, ...], **more: np.ndarray) -> Path:
    """One person as other tools write it: without the names that only we give."""
    (first, *_) = save_smplx(scene, path, body, apart=True)
    with np.load(first) as file:
        arrays = {key: file[key] for key in file.files if key not in (*drop, "body", "name")}
    np.savez(path, **{**arrays, **more})
    return path


def test_amass_names_and_its_z_axis_are_understood(trio: Scene, body: Body, tmp_path: Path) -> None:
    N = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    body = Body(**{**vars_of(body), "id": "smplx-neutral"})
    lying = trio.replace(T_world_root=N @ trio.T_world_root, body=body.id)
    (ours,) = save_smplx(lying, tmp_path / "ours.npz", body)
    with np.load(ours) as file:
        poses, trans, betas = file["poses"][0], file["trans"][0], file["betas"][0]
    path = tmp_path / "amass.npz"
    halves = {"root_orient": poses[:, :3], "pose_body": poses[:, 3:66]}
    np.savez(path, trans=trans, betas=np.pad(betas, (0, 6)), mocap_framerate=120.0, **halves)
    back = load_smplx(path, body)
    assert back.fps == 120.0
    assert (body.joints(back)[:, :, 0] - body.joints(trio.replace(body=body.id))[:, :, 0]).abs().max() < 1e-4
    with pytest.raises(ValueError, match="up axis 'w'"):
        load_smplx(path, body, up="w")


@pytest.mark.parametrize("up", ["-y", "z", "-z", "x", "-x"])
def test_a_file_of_another_program_is_turned_upright_whichever_axis_points_up(up, trio: Scene, body: Body, tmp_path):
    turn = np.eye(4)
    turn[:3, :3] = UP[up].T  # from our world to the file's
    path = foreign(trio, body, tmp_path / "there.npz", ("surface_model_type",))
    with np.load(path) as file:
        arrays = dict(file)
    root = roma.rotvec_to_rotmat(torch.from_numpy(arrays["poses"][:, :3])).numpy()
    rest = np.array(SMPLX_PELVIS)  # which turns with the world, unlike transl
    turned = roma.rotmat_to_rotvec(torch.from_numpy(turn[:3, :3] @ root)).numpy()
    place = (arrays["transl"] + rest) @ turn[:3, :3].T - rest
    poses = np.concatenate([turned, arrays["poses"][:, 3:]], axis=1)
    np.savez(path, **{**arrays, "poses": poses, "transl": place, "trans": place, "body": "somebody"})
    upright, found = read_smplx(path, body)
    assert found == up
    wanted = read_smplx(foreign(trio, body, tmp_path / "here.npz", ()), body)[0]
    assert (upright.T_world_root - wanted.T_world_root).abs().max() < 1e-4
    assert torch.equal(upright.T_world_root, load_smplx(path, body, up).T_world_root)


def vars_of(body: Body) -> dict:
    names = ("J_template", "J_shapedirs", "v_template", "shapedirs", "weights", "faces", "posedirs")
    return {name: getattr(body, name) for name in names}


def test_shapes_of_smplx_mean_nothing_to_the_open_body(trio: Scene, body: Body, tmp_path: Path) -> None:
    back = load_smplx(foreign(trio, body, tmp_path / "a.npz", ()), body)
    assert not back.betas.any()
    assert (back.body_rot[:, :, 0] - trio.body_rot[:, :, 0]).abs().max() < 1e-5
    assert not load_smplx(foreign(trio, body, tmp_path / "b.npz", ("betas",)), body).betas.any()


def test_numbers_that_are_none_are_refused(trio: Scene, body: Body, tmp_path: Path) -> None:
    broken = np.full((20, 3), np.nan)
    with pytest.raises(ValueError, match=r"a\.npz: every frame holds NaN or infinity: nothing was tracked"):
        load_smplx(foreign(trio, body, tmp_path / "a.npz", ("transl",), transl=broken), body)
    with pytest.raises(ValueError, match=r"b\.npz: betas: expected finite numbers"):
        load_smplx(foreign(trio, body, tmp_path / "b.npz", ("betas",), betas=broken[0]), body)
    with pytest.raises(FileNotFoundError, match="no such file"):
        load_smplx(tmp_path / "none.npz", body)


def test_shapes_of_lost_frames_do_not_count(tmp_path: Path) -> None:
    rows = np.arange(50.0).reshape(5, 10)
    rows[3, 4], rows[1] = np.inf, np.nan
    body = Body(**{**vars_of(load_body()), "id": "smplx-neutral"})
    held = {"poses": np.zeros((5, 66)), "transl": np.zeros((5, 3)), "mocap_frame_rate": 30.0}
    assert scene_of("a.npz", {**held, "betas": rows}, body)[0].betas[0, 0].tolist() == rows[2].tolist()
    with pytest.raises(ValueError, match=r"a\.npz: betas: expected finite numbers"):
        scene_of("a.npz", {**held, "betas": rows * np.nan}, body)


def scaled(tmp_path: Path, metres: float = 1.0, radians: float = 1.0) -> Path:
    """Somebody walking, as other programs write it, with lengths and turns times a factor."""
    scene = synthesize("circle", 2, 120, torch.Generator().manual_seed(0), load_body()).scene.permute_agents(
        torch.tensor([0])
    )
    arrays = dict(np.load(save_smplx(scene, tmp_path / "ours.npz", load_body())[0]))
    path = tmp_path / "foreign.npz"
    np.savez(
        path,
        poses=arrays["poses"] * radians,
        trans=arrays["transl"] * metres,
        mocap_framerate=np.array(30.0),
        betas=arrays["betas"],
    )
    return path


def test_lengths_in_centimetres_are_refused_until_they_are_called_so(tmp_path: Path) -> None:
    path, body = scaled(tmp_path, metres=100.0), load_body()
    with pytest.raises(ValueError, match=r"pelvises are \d+ m over or under the floor.*--in_unit cm"):
        read_smplx(path, body)
    read = read_smplx(path, body, unit="cm")[0]
    plain = read_smplx(scaled(tmp_path), body)[0]
    assert torch.allclose(read.T_world_root, plain.T_world_root, atol=1e-4)
    assert float(read_smplx(scaled(tmp_path, metres=100.0), body, unit="m")[0].T_world_root[..., 1, 3].max()) > 30
    with pytest.raises(ValueError, match="unit 'parsec': expected one of m, cm"):
        read_smplx(path, body, unit="parsec")


def test_what_is_pickled_in_an_npz_names_the_file_and_is_passed_over_where_it_is_not_needed(
    trio: Scene, body: Body, tmp_path: Path
) -> None:
    (path,) = save_smplx(trio, tmp_path / "trio.npz", body)
    with np.load(path) as file:
        held = dict(file)
    np.savez(path, **{**held, "name": np.array(None)})  # type: ignore[arg-type]
    assert load_smplx(path, body).names == ()
    np.savez(path, **{**held, "body": np.array(None)})  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"trio\.npz: not a readable npz \(Object arrays"):
        load_smplx(path, body)


def test_of_many_arrays_under_other_names_the_first_are_named(body: Body, tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", **{f"take_{k:04}": np.zeros(1) for k in range(3000)})  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"it has take_0000, .*, take_0019 and 2980 more; "):
        load_smplx(tmp_path / "a.npz", body)


def test_turns_in_degrees_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"turns of up to .* radians; degrees"):
        read_smplx(scaled(tmp_path, radians=180 / np.pi), load_body())


# -- keys of other programs --------------------------------------------------------------------


def as_amass(a: dict) -> dict:
    return {"poses": a["poses"], "trans": a["transl"], "mocap_framerate": 30.0}


def as_smplx(a: dict) -> dict:
    poses = a["poses"]
    return {"global_orient": poses[:, :3], "body_pose": poses[:, 3:66], "transl": a["transl"], "fps": 30,
            "betas": np.zeros((1, 10))}  # fmt: skip


def as_interx(a: dict) -> dict:
    poses = a["poses"]
    return {"root_orient": poses[:, :3], "pose_body": poses[:, 3:66].reshape(-1, 21, 3), "trans": a["transl"]}


def as_aist(a: dict) -> dict:
    return {"smpl_poses": a["poses"][:, :72], "smpl_trans": 93 * a["transl"], "smpl_scaling": [93.0], "fps": 30}


def as_matrices(a: dict) -> dict:
    turned = roma.rotvec_to_rotmat(torch.from_numpy(a["poses"][:, :66].reshape(-1, 22, 3))).numpy()
    return {"global_orient": turned[:, :1], "body_pose": turned[:, 1:], "transl": a["transl"], "fps": 30,
            "betas": np.tile(a["betas"], (len(turned), 1))}  # fmt: skip


def as_root_matrix(a: dict) -> dict:
    matrices = as_matrices(a)
    return matrices | {"global_orient": matrices["global_orient"][:, 0], "body_pose": a["poses"][:, 3:66]}


@pytest.mark.parametrize("named", [as_amass, as_smplx, as_interx, as_aist, as_matrices, as_root_matrix])
def test_every_naming_that_training_reads_shows_the_same_motion(named, trio: Scene, body: Body, tmp_path) -> None:
    path = foreign(trio, body, tmp_path / "plain.npz", ())
    wanted = load_smplx(path, body)
    np.savez(tmp_path / "named.npz", **named(dict(np.load(path))))
    fps = 30.0 if named is as_interx else None
    back = read_smplx(tmp_path / "named.npz", body, in_fps=fps)[0]
    assert back.fps == 30.0
    assert (back.T_world_root - wanted.T_world_root).abs().max() < 1e-5
    assert (back.body_rot - wanted.body_rot).abs().max() < 1e-5


def test_a_file_without_a_rate_names_the_option_and_one_with_a_rate_keeps_it(trio: Scene, body: Body, tmp_path) -> None:
    path = foreign(trio, body, tmp_path / "a.npz", ("mocap_frame_rate",))
    with pytest.raises(ValueError, match=r"lacks mocap_frame_rate; it has .*--in_fps 30"):
        load_smplx(path, body)
    assert read_smplx(path, body, in_fps=25.0)[0].fps == 25.0
    with pytest.raises(ValueError, match=r"says 30 frames a second; --in_fps 25 is for files that say nothing"):
        read_smplx(foreign(trio, body, tmp_path / "b.npz", ()), body, in_fps=25.0)
