"""Motion on characters of one's own: read back, it is the same; names, proportions, meshes and rest poses stay."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from magnet import checkpoints, cli
from magnet.body import Body
from magnet.body.fit import floor_height
from magnet.body.joints import JOINT_NAMES, PARENTS
from magnet.export import fbx, formats, save_bvh, save_glb
from magnet.export.bones import BoneOptions
from magnet.export.bvh_read import read_bvh
from magnet.export.glb_read import read_glb
from magnet.export.gltf_file import GltfFile
from magnet.export.onto_rig import save_onto
from magnet.export.read_options import Reading
from magnet.export.reading import read
from magnet.motion.scene import Scene
from tests.export import glb_strangers, strangers
from tests.export.test_glb_read import Z_UP_CENTIMETRES, stranger


@pytest.fixture(scope="module")
def salsa() -> Scene:
    """A generated couple of mean shape, twelve frames."""
    scene = Scene.load(checkpoints.FOLDER / "duet" / "scenes" / "duet.npz").slice(0, 12)
    return scene.replace(betas=torch.zeros_like(scene.betas))


def someone(scene: Scene, betas: tuple[float, ...] = ()) -> Scene:
    """One person, one frame, of a shape."""
    shape = torch.tensor([*betas, *[0.0] * (10 - len(betas))])
    one = scene.people().select([0]).slice(0, 1)
    return one.replace(betas=shape.expand_as(one.betas).clone())


def off(paths: list[Path], truth: Scene, body: Body) -> float:
    """Metres by which the farthest joint is off, read back."""
    got = read(paths, options=Reading(keep_floor=True)).scene
    return float((body.joints(got) - body.joints(truth)).norm(dim=-1).max())


@pytest.mark.parametrize("root", ["floor", "none"])
def test_a_character_of_our_own_moves_as_people_do(root: str, salsa: Scene, body: Body, tmp_path: Path) -> None:
    rig = save_glb(someone(salsa), tmp_path / "rig.glb", body, BoneOptions(root=root))
    paths = save_onto(salsa, tmp_path / "out.glb", body, [rig])
    assert [path.name for path in paths] == ["out_person0.glb", "out_person1.glb"]
    assert off(paths, salsa, body) < 1e-5
    before, after = GltfFile(rig).document, GltfFile(paths[0]).document
    assert before["meshes"] == after["meshes"] and before["skins"] == after["skins"]
    assert [node["name"] for node in before["nodes"]] == [node["name"] for node in after["nodes"]]
    assert [clip["name"] for clip in after["animations"]] == ["motion"]


@pytest.mark.parametrize("armature", [None, Z_UP_CENTIMETRES], ids=["plain", "z up, cm"])
@pytest.mark.parametrize("naming", ["", "mixamo"])
def test_bones_along_any_axes_in_any_armature_turn_the_same(
    naming: str, armature: np.ndarray | None, salsa: Scene, body: Body, tmp_path: Path
) -> None:
    rig = stranger(someone(salsa), body, tmp_path / "rig.glb", naming, armature=armature)
    paths = save_onto(salsa, tmp_path / "out.glb", body, [rig])
    assert off(paths, salsa, body) < (0.015 if naming else 1e-5)  # other names are fitted when they are read
    (was,), (now,) = read_glb(rig), read_glb(paths[1])
    assert was.names == now.names and np.allclose(was.offsets, now.offsets, atol=1e-6) and now.fps == salsa.fps
    assert np.abs(np.linalg.norm(now.place[:, 1:], axis=-1) - np.linalg.norm(was.offsets[1:], axis=-1)).max() < 1e-5


@pytest.mark.parametrize("unit", ["m", "cm"])
def test_a_bvh_keeps_its_names_unit_and_end_sites(unit: str, salsa: Scene, body: Body, tmp_path: Path) -> None:
    (rig,) = save_bvh(someone(salsa), tmp_path / "rig.bvh", body, unit=unit)
    paths = save_onto(salsa, tmp_path / "out.bvh", body, [rig])
    assert off(paths, salsa, body) < 1e-4
    heads = [path.read_text().partition("MOTION")[0].split() for path in (rig, paths[0])]
    assert heads[0] == heads[1]


def test_legs_and_spine_may_hang_beside_each_other(salsa: Scene, body: Body, tmp_path: Path) -> None:
    """As of Daz and Character Creator, whose root holds a pelvis with the legs, and beside it the spine."""
    one = salsa.people().select([0])
    rest = body.rest_joints(torch.zeros(10)).double().numpy()
    turned, at = (
        x.double().numpy()
        for x in body.bone_chain(one.body_rot[0, :, 0], one.T_world_root[0, :, 0], body.rest_joints(torch.zeros(10)))
    )
    names = ["hip", *(strangers.NAMINGS["mixamo"][name] for name in JOINT_NAMES)]
    parents = [-1, 0, *(parent + 1 for parent in PARENTS[1:])]
    parents[1 + JOINT_NAMES.index("spine1")] = 0
    twice = [np.concatenate([x[..., :1, :, :], x], axis=-3) for x in (turned, at[..., None], rest[..., None])]
    glb = glb_strangers.Written()
    keys = np.arange(one.frames) / 30
    glb_strangers.person(glb, names, parents, twice[0], twice[1][..., 0], twice[2][..., 0], keys)
    path = glb.save(tmp_path / "rig.glb")
    plain = Reading(keep_floor=True)
    for paths in ([path], save_onto(one, tmp_path / "out.glb", body, [path])):
        got = read(paths, options=plain).scene
        assert float((body.joints(got) - body.joints(one)).norm(dim=-1).max()) < 0.03
    chest, pelvis = (one.frames // 2, JOINT_NAMES.index("spine3")), JOINT_NAMES.index("pelvis")
    away = body.joints(got)[0, chest[0], 0, chest[1]] - body.joints(got)[0, chest[0], 0, pelvis]
    true = body.joints(one)[0, chest[0], 0, chest[1]] - body.joints(one)[0, chest[0], 0, pelvis]
    assert float((away - true).norm()) < 0.02


def test_a_rest_pose_with_arms_down_is_no_other_motion(salsa: Scene, body: Body, tmp_path: Path) -> None:
    """A rig whose bones rest turned: its arms hang, where ours are stretched out."""
    rest_at = body.rest_joints(torch.zeros(10)).double().numpy()
    rest_world = np.tile(np.eye(3), (22, 1, 1))
    for side, sign in (("left", -1.0), ("right", 1.0)):
        c, s = np.cos(1.0), sign * np.sin(1.0)
        for joint in ("shoulder", "elbow", "wrist"):
            rest_world[JOINT_NAMES.index(f"{side}_{joint}")] = [[c, -s, 0], [s, c, 0], [0, 0, 1]]
    hanging = rest_at.copy()
    for j in range(1, 22):
        hanging[j] = hanging[PARENTS[j]] + rest_world[PARENTS[j]] @ (rest_at[j] - rest_at[PARENTS[j]])
    still = np.tile(np.eye(3), (2, 22, 1, 1))
    root = np.tile(rest_at[0] + [0, 1, 0], (2, 1))
    naming = strangers.NAMINGS["mixamo"]
    rig = strangers.rerigged(
        tmp_path / "rig.bvh", naming, JOINT_NAMES, PARENTS, still, rest_world, hanging, root, fps=30.0
    )
    paths = save_onto(salsa, tmp_path / "out.bvh", body, [rig])
    got = read(paths, options=Reading(keep_floor=True)).scene
    assert float((body.joints(got) - body.joints(salsa)).norm(dim=-1).mean()) < 0.02


def test_who_has_a_characters_proportions_moves_it_exactly(salsa: Scene, body: Body, tmp_path: Path) -> None:
    shape = (4.0, -2.0, 1.0)  # which leans
    tall = salsa.replace(betas=torch.tensor([*shape, *[0.0] * 7]).expand_as(salsa.betas).clone())
    rig = save_glb(someone(salsa, shape), tmp_path / "rig.glb", body)
    assert off(save_onto(tall, tmp_path / "out.glb", body, [rig]), tall, body) < 2e-4


def test_characters_of_other_proportions_stand_on_the_floor(salsa: Scene, body: Body, tmp_path: Path) -> None:
    rigs = [
        save_glb(someone(salsa, betas), tmp_path / f"{name}.glb", body)
        for name, betas in (("tall", (3.0,)), ("small", (-3.0, 1.0)))
    ]
    got = read(save_onto(salsa, tmp_path / "out.glb", body, rigs), options=Reading(keep_floor=True)).scene
    assert torch.allclose(got.betas[0, :, 0], torch.tensor([3.0, -3.0]), atol=1e-3)
    here, ours = (floor_height(body.joints(each)[0], body, each.betas[0]) for each in (got, salsa))
    assert float((here - ours).abs().max()) < 0.05
    apart = got.T_world_root[0, :, :, [0, 2], 3] - salsa.T_world_root[0, :, :, [0, 2], 3]
    assert float(apart.abs().max()) < 0.06, "people stay where they are on the ground"


def test_an_fbx_goes_through_blender_twice(
    salsa: Scene, body: Body, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(script: Path, source: Path, made: Path, *_: str) -> None:
        made.write_bytes(source.read_bytes())

    monkeypatch.setattr(fbx, "run_script", run)
    rig = save_glb(someone(salsa), tmp_path / "a.glb", body).rename(tmp_path / "rig.fbx")
    paths = save_onto(salsa, tmp_path / "out.fbx", body, [rig])
    assert [path.name for path in paths] == ["out_person0.fbx", "out_person1.fbx"] and off(paths, salsa, body) < 1e-5
    both = save_glb(salsa, tmp_path / "b.glb", body).rename(tmp_path / "both.fbx")
    with pytest.raises(ValueError, match=rf"^{both}: holds person_0, person_1: expected one character"):
        save_onto(salsa, tmp_path / "out.fbx", body, [both])


def test_the_command_writes_a_file_a_person_and_says_what_cannot_be(
    salsa: Scene, body: Body, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    salsa.save("duet.npz")
    save_glb(someone(salsa), "hero.glb", body)
    save_bvh(someone(salsa), "hero.bvh", body)
    assert cli.main(["export", "duet.npz", "dance.glb", "--rig", "hero.glb"]) == 0
    assert "written: dance_person1.glb" in capsys.readouterr().out
    assert off([Path("dance_person0.glb"), Path("dance_person1.glb")], salsa, body) < 1e-5
    for words, said in (
        (["dance.png", "--rig", "hero.glb"], "--rig: is for .glb, .fbx, .bvh, and does nothing in .png"),
        (["dance.glb", "--rig", "hero.bvh"], "a character is written as it was read: got hero.bvh for dance.glb"),
        (["dance.glb", "--rig", *["hero.glb"] * 3], "got 3 characters for 2 people"),
        (["dance.glb", "--rig", "hero.glb", "--names", "vrm"], "--names: a character has its own"),
        (["dance.glb", "--rig_joint", "a=b"], "--rig_joint: names joints of a character, which --rig names"),
        (["hero.glb", "--person", "0", "--rig", "hero.glb"], "hero.glb: is read, and would be written over"),
        (["dance.glb", "--rig", "none.glb"], "--rig none.glb: no such file"),
    ):
        assert cli.main(["export", "duet.npz", *words]) == 2
        error = capsys.readouterr().err
        assert said in error and len(error.splitlines()) == 1


def test_out_may_stand_behind_the_characters(
    salsa: Scene, body: Body, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for number in range(2):
        save_bvh(salsa.slice(0, 8).permute_agents(torch.tensor([number])), f"{number}.bvh", body)
    save_bvh(someone(salsa), "hero.bvh", body)
    for words, name in (
        ("0.bvh --rig hero.bvh one.bvh", "one"),  # and again, when it is there
        ("0.bvh --rig hero.bvh one.bvh", "one"),
        ("--fps 30 0.bvh 1.bvh --rig hero.bvh hero.bvh two.bvh --on_floor", "two_person1"),
        ("0.bvh 1.bvh three.bvh --rig hero.bvh hero.bvh", "three_person0"),
    ):
        assert cli.main(["export", *words.split()]) == 0
        assert f"{name}.bvh" in capsys.readouterr().out and Path(f"{name}.bvh").is_file()
    assert cli.main(["export", *["0.bvh", "1.bvh", "four.bvh", "--rig", "hero.bvh", "her.bvh"]]) == 2
    assert "--rig her.bvh: no such file" in capsys.readouterr().err


def test_files_behind_the_characters_and_out_are_read_and_not_written_over(
    salsa: Scene, body: Body, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    save_bvh(someone(salsa), "hero.bvh", body)
    save_bvh(salsa.slice(0, 8).permute_agents(torch.tensor([0])), "0.bvh", body)
    recorded = Path("0.bvh").read_bytes()
    for _ in range(2):  # and again, when OUT is there
        assert cli.main(["export", *["--rig", "hero.bvh", "one.bvh", "--fps", "30", "0.bvh"]]) == 0
        assert Path("0.bvh").read_bytes() == recorded and read("one.bvh").scene.frames == 8


def test_rig_may_be_repeated(salsa: Scene, body: Body, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    salsa.save("duet.npz")
    rigs = [save_bvh(someone(salsa, shape), name, body)[0] for shape, name in (((), "a.bvh"), ((3.0,), "b.bvh"))]
    for words in ("one.bvh --rig a.bvh --rig b.bvh", "--rig a.bvh --rig b.bvh one.bvh"):
        assert cli.main(["export", "duet.npz", *words.split()]) == 0
        for person, rig in enumerate(rigs):
            assert np.allclose(read_bvh(f"one_person{person}.bvh").offsets[1:], read_bvh(rig).offsets[1:], atol=1e-4)
        for path in tmp_path.glob("one*"):
            path.unlink()


def test_several_scenes_get_a_file_a_person_each(salsa: Scene, body: Body, tmp_path: Path) -> None:
    rig = save_glb(someone(salsa), tmp_path / "rig.glb", body)
    written = formats.write(salsa.repeat(2), tmp_path / "out.glb", body, rigs=[rig])
    assert [path.name for path in written] == [f"out_scene{b}_person{p}.glb" for b in range(2) for p in range(2)]
    there = formats.files_of(tmp_path / "out.glb", [[0, 1]] * 2, rigs=True)
    assert there == written
