"""GLB files read back: our own to rounding, and other programs' with bones, armatures and keys of their own."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import magnet
from magnet import cli
from magnet.body import Body
from magnet.body.joints import JOINT_NAMES, PARENTS
from magnet.export import formats, save_glb
from magnet.export.bones import BoneOptions
from magnet.export.glb_read import read_glb
from magnet.export.gltf_file import sampled
from magnet.export.read_options import Reading
from magnet.export.reading import read
from magnet.motion.scene import Scene, cat_agents
from tests.export import glb_strangers
from tests.export.strangers import NAMINGS

Floats = NDArray[np.float64]
Z_UP_CENTIMETRES = np.array([[0.01, 0, 0, 0.2], [0, 0, 0.01, 0.1], [0, -0.01, 0, 0], [0, 0, 0, 1.0]])
"""An armature as programs that are z up and in centimetres have it."""


def off(read: Scene, truth: Scene, body: Body) -> float:
    """Metres by which the farthest joint is off."""
    return float((body.joints(read) - body.joints(truth)).norm(dim=-1).max())


@pytest.mark.parametrize("root", ["floor", "none"])
@pytest.mark.parametrize("clips", ["scene", "person"])
def test_what_we_wrote_is_read_back_to_rounding(root: str, clips: str, duet: Scene, body: Body, tmp_path: Path) -> None:
    path = save_glb(duet, tmp_path / "a.glb", body, BoneOptions(root=root, clips=clips))
    got = read(path)
    assert got.scene.fps == duet.fps and got.scene.frames == duet.frames and got.scene.agents == 2
    assert off(got.scene, duet, body) < 1e-5 and torch.allclose(got.scene.betas, duet.betas, atol=1e-3)
    assert [note.partition(";")[0] for note in got.notes] == [
        f"a.glb person_{p}: the body's own skeleton" for p in range(2)
    ]


def test_people_of_several_files_and_kinds_are_one_scene(duet: Scene, body: Body, tmp_path: Path) -> None:
    one, other = (duet.people().select([p]) for p in range(2))
    paths = [*formats.write(one, tmp_path / "a.glb", body), *formats.write(other, tmp_path / "b.bvh", body)]
    assert off(magnet.read(*paths), duet, body) < 1e-4


def stranger(scene: Scene, body: Body, path: Path, naming: str = "", keys: Floats | None = None, **how: Any) -> Path:
    """The people of a scene on skeletons of another program."""
    glb = glb_strangers.Written()
    keys = np.arange(scene.frames) / scene.fps if keys is None else keys
    names = [NAMINGS[naming][name] if naming else name for name in JOINT_NAMES]
    for p in range(scene.agents):
        rest = body.rest_joints(scene.betas[0, p]).double().numpy()
        poses = scene.body_rot[0, :, p], scene.T_world_root[0, :, p]
        moved = [x.double().numpy() for x in body.bone_chain(*poses, body.rest_joints(scene.betas[0, p]))]
        own: dict[str, Any] = {"seed": p, "label": f"Armature{p}"}
        glb_strangers.person(glb, names, [-1, *PARENTS[1:]], *moved, rest, keys, **own | how)
    return glb.save(path)


@pytest.mark.parametrize("how", ["LINEAR", "STEP", "CUBICSPLINE"])
@pytest.mark.parametrize("armature", [None, Z_UP_CENTIMETRES], ids=["plain", "z up, cm"])
@pytest.mark.parametrize("skinned", [True, False])
def test_bones_of_any_rest_in_any_armature_are_the_same_motion(
    how: str, armature: Floats | None, skinned: bool, duet: Scene, body: Body, tmp_path: Path
) -> None:
    path = stranger(duet, body, tmp_path / "a.glb", how=how, armature=armature, skinned=skinned)
    got = read(path)
    assert got.scene.frames == duet.frames and got.scene.fps == 30.0
    assert off(got.scene, duet, body) < 1e-4 and "the body's own skeleton" in got.notes[0]


@pytest.mark.parametrize("naming", ["mixamo", "unreal", "rigify"])
def test_other_names_are_fitted_as_those_of_bvh_are(naming: str, duet: Scene, body: Body, tmp_path: Path) -> None:
    got = read(stranger(duet, body, tmp_path / "a.glb", naming), options=Reading(keep_floor=True))
    assert float((body.joints(got.scene) - body.joints(duet)).norm(dim=-1).mean()) < 0.02
    assert "limbs lie 0." in got.notes[0]


def test_quaternions_may_be_short_whole_numbers(duet: Scene, body: Body, tmp_path: Path) -> None:
    assert off(read(stranger(duet, body, tmp_path / "a.glb", component=5122)).scene, duet, body) < 1e-3


def test_uneven_keys_are_read_at_thirty_a_second_and_said(duet: Scene, body: Body, tmp_path: Path) -> None:
    keys = np.cumsum([0.0, *np.linspace(0.02, 0.4, duet.frames - 1)])
    got = read(stranger(duet, body, tmp_path / "a.glb", keys=keys))
    assert "its keys are uneven or few: read at 30 frames a second" in got.notes[0]
    assert got.scene.fps == 30.0 and got.scene.frames == int(keys[-1] * 30) + 1
    last = got.scene.slice(got.scene.frames - 1)  # nearly the last key
    assert off(last, duet.slice(duet.frames - 1), body) < 0.2


@pytest.mark.parametrize("fps", [24.0, 29.97, 60.0, 120.0])
def test_the_rate_is_that_of_the_keys(fps: float, duet: Scene, body: Body, tmp_path: Path) -> None:
    (one, _) = read_glb(stranger(duet.replace(fps=fps), body, tmp_path / "a.glb"))
    assert one.fps == fps and one.frames == duet.frames


def test_keys_that_are_left_out_where_nothing_changes_leave_the_rate(duet: Scene, body: Body, tmp_path: Path) -> None:
    keys = np.array([0, 1, 2, 3, 7, 8, 9, 10, 11, 20, 21, 22]) / 60.0
    (one, _) = read_glb(stranger(duet, body, tmp_path / "a.glb", keys=keys))
    assert one.fps == 60.0 and one.frames == 23


def test_hair_on_a_head_is_nobody_and_a_second_animation_is_told(duet: Scene, body: Body, tmp_path: Path) -> None:
    path = stranger(duet, body, tmp_path / "a.glb")
    glb = glb_strangers.opened(path)
    head = next(k for k, node in enumerate(glb.document["nodes"]) if node["name"] == "head")
    hair = glb.add("nodes", {"name": "hair", "translation": [0, 0.1, 0]})
    glb.document["nodes"][head]["children"].append(hair)
    glb.add("skins", {"joints": [hair]})
    glb.add("animations", glb.document["animations"][0] | {"name": "waves"})
    got = read(glb.save(path))
    assert got.scene.agents == 2 and off(got.scene, duet, body) < 1e-4
    assert "animation 'waves' is not read: it moves what 'Armature0 moves' moves" in "\n".join(got.notes)


def test_animals_and_things_are_left_out_and_told_of(duet: Scene, body: Body, tmp_path: Path) -> None:
    path = stranger(duet, body, tmp_path / "a.glb")
    glb = glb_strangers.opened(path)
    for number, skin in enumerate(glb.document["skins"][:1]):
        for k in skin["joints"]:
            glb.document["nodes"][k]["name"] = f"tail{number}.{k}"
    got = read(glb.save(path))
    assert got.scene.agents == 1 and off(got.scene, duet.people().select([1]), body) < 1e-4
    assert "left out, as their joints are not named like a person's: Armature0" in got.notes[0]
    for skin in glb.document["skins"][1:]:
        for k in skin["joints"]:
            glb.document["nodes"][k]["name"] = f"tail.{k}"
    with pytest.raises(ValueError, match=r"a\.glb: cannot tell which joint is left_hip"):
        read(glb.save(path))


def test_an_animation_is_chosen_by_its_name(duet: Scene, body: Body, tmp_path: Path) -> None:
    glb = glb_strangers.opened(stranger(duet, body, tmp_path / "a.glb"))
    for clip in list(glb.document["animations"]):
        still = [channel for channel in clip["channels"] if channel["target"]["path"] != "rotation"]
        glb.document["animations"].append(clip | {"name": "stand", "channels": still})
    path = glb.save(tmp_path / "b.glb")
    assert off(read(path).scene, duet, body) < 1e-4, "the first"
    stands = read(path, options=Reading(clip="stand", keep_floor=True))
    turned = stands.scene.body_rot[0, 1:] - stands.scene.body_rot[0, :1]
    assert float(turned.abs().max()) < 0.05 and "not read" not in "".join(stands.notes)
    with pytest.raises(ValueError, match="has no animation 'run'; it has Armature0 moves, Armature1 moves, stand"):
        read(path, options=Reading(clip="run"))
    for other in ("a.npz", "a.csv", "a.bvh"):
        (tmp_path / other).touch()
        with pytest.raises(ValueError, match=r"clip: chooses an animation of a \.glb"):
            read(tmp_path / other, options=Reading(clip="run"))
    assert cli.main(["export", str(path), str(tmp_path / "c.npz"), "--clip", "stand"]) == 0


def test_a_pose_before_the_motion_is_not_read_in_its_place(duet: Scene, body: Body, tmp_path: Path) -> None:
    """As Mixamo's empty take, and the T pose that characters of games have first: it was read, as one frame."""
    glb = glb_strangers.opened(stranger(duet, body, tmp_path / "a.glb"))
    moves = glb.document["animations"]
    zero, unturned = glb.numbers(np.zeros((1, 1)), "SCALAR"), glb.numbers(np.array([[0.0, 0.0, 0.0, 1.0]]), "VEC4")
    still = [{"sampler": 0, "target": channel["target"]} for clip in moves for channel in clip["channels"]]
    still = [channel for channel in still if channel["target"]["path"] == "rotation"]
    pose = {"name": "TPose", "channels": still, "samplers": [{"input": zero, "output": unturned}]}
    glb.document["animations"] = [pose, *moves]
    got = read(glb.save(tmp_path / "b.glb"))
    assert off(got.scene, duet, body) < 1e-4
    assert "animation 'TPose' is not read" in "".join(got.notes)


def test_channels_that_are_an_animation_each_are_one_motion(duet: Scene, body: Body, tmp_path: Path) -> None:
    """Of each bone only the first channel was read, which left people with no turns or in one place."""
    glb = glb_strangers.opened(stranger(duet, body, tmp_path / "a.glb"))
    glb.document["animations"] = [
        {"channels": [channel | {"sampler": 0}], "samplers": [clip["samplers"][channel["sampler"]]]}
        for clip in glb.document["animations"]
        for channel in clip["channels"]
    ]
    got = read(glb.save(tmp_path / "b.glb"))
    assert off(got.scene, duet, body) < 1e-4 and "not read" not in "".join(got.notes)


def test_controls_beside_the_hips_hang_on_the_armature_which_is_the_root(
    duet: Scene, body: Body, tmp_path: Path
) -> None:
    path = stranger(duet, body, tmp_path / "a.glb", armature=Z_UP_CENTIMETRES)
    glb = glb_strangers.opened(path)
    top = next(k for k, node in enumerate(glb.document["nodes"]) if node["name"] == "Armature0")
    control = glb.add("nodes", {"name": "ik_target"})
    glb.document["nodes"][top]["children"].append(control)
    glb.document["skins"][0]["joints"].append(control)
    del glb.document["skins"][0]["inverseBindMatrices"]
    people = read_glb(glb.save(path))
    assert people[0].names[0] == "Armature0" and people[1].names[0] == "pelvis"
    assert off(read(path).scene, duet, body) < 1e-4


def test_a_part_of_the_frames_is_that_of_the_scene(duet: Scene, body: Body, tmp_path: Path) -> None:
    path = save_glb(duet, tmp_path / "a.glb", body)
    assert off(magnet.read(path, start=3, end=9), duet.slice(3, 9), body) < 1e-5
    with pytest.raises(ValueError, match=r"a\.glb: holds 12 frames, so end 20 is behind them"):
        magnet.read(path, end=20)


def test_whoever_lies_is_read_as_lying(duet: Scene, body: Body, tmp_path: Path) -> None:
    T_lying = torch.eye(4)
    T_lying[:3, :3] = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    lies = cat_agents([duet.people().select([p]).transformed(T_lying) for p in range(2)])
    got = magnet.read(stranger(lies, body, tmp_path / "a.glb", armature=Z_UP_CENTIMETRES), keep_floor=True)
    assert off(got, lies, body) < 1e-4


# -- what cannot be read -----------------------------------------------------------------------


def test_what_is_no_glb_or_cut_short_is_refused_in_one_line(duet: Scene, body: Body, tmp_path: Path) -> None:
    path = save_glb(duet, tmp_path / "a.glb", body)
    whole = path.read_bytes()
    for data in (b"", b"glTF", b"PK\x03\x04 something else that is long enough", whole[:100], whole[:-9]):
        path.write_bytes(data)
        with pytest.raises(ValueError, match=r"a\.glb: not a whole \.glb file \(it .+\): export it again"):
            read_glb(path)
    (tmp_path / "a.gltf").write_text('{"asset":' + 10**5 * "[")
    with pytest.raises(ValueError, match=r"a\.gltf: not a whole \.gltf file \(.+\): export it again"):
        read_glb(tmp_path / "a.gltf")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda d: d.update(skins=[], animations=[]), "holds no skeleton"),
        (lambda d: d.update(extensionsRequired=["EXT_meshopt_compression"]), "its motion is compressed"),
        (lambda d: d["skins"][0]["joints"].append(999), "its parts do not go together"),
        (lambda d: d["accessors"][-1].update(count=10**12), "its parts do not go together"),
        (lambda d: d["nodes"][3]["children"].append(0), "its nodes hang in a circle"),
        (lambda d: d["animations"][0]["samplers"][0].update(input=10**6), "its parts do not go together"),
        (
            lambda d: d["buffers"].__setitem__(0, {"uri": "motion.bin"}),
            r"its numbers are in another file \(motion.bin\)",
        ),
        (lambda d: d.update(nodes=7), "its parts do not go together"),
        (lambda d: d["accessors"][0].update(count=10**13) or d["accessors"][0].pop("bufferView"), "do not go together"),
        (lambda d: d["bufferViews"][1].update(byteOffset=2**63), "its parts do not go together"),
        (lambda d: d["nodes"][0].update(scale=[1e308, 1, 1]), "it is damaged|a bone is mirrored, flat or skewed"),
        (
            lambda d: d["nodes"][0].update(matrix=[-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]),
            "a bone is mirrored, flat or skewed",
        ),
        (
            lambda d: d["nodes"][0].update(translation=[1e9, 0, 0]),
            r"a joint is 1e\+09 away from the one above",
        ),
        (lambda d: d["accessors"][0].update(count=0), "a translation has no frames"),
        (lambda d: d["accessors"][2].update(type="VEC3"), "a rotation has 3 numbers, expected 4"),
    ],
)
def test_what_is_damaged_is_refused_in_one_line(change, said: str, duet: Scene, body: Body, tmp_path: Path) -> None:
    glb = glb_strangers.opened(stranger(duet, body, tmp_path / "a.glb"))
    keep, glb.document["buffers"] = glb.document, [{"byteLength": len(glb.binary)}]
    change(glb.document)
    text = json.dumps(keep).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(glb.binary)) + struct.pack("<I4s", len(text), b"JSON")
    (tmp_path / "a.glb").write_bytes(head + text + struct.pack("<I4s", len(glb.binary), b"BIN\0") + glb.binary)
    with pytest.raises(ValueError, match=rf"^{tmp_path}/a\.glb: .*{said}") as caught:
        read(tmp_path / "a.glb")
    assert "\n" not in str(caught.value)


def test_keys_of_years_do_not_fill_the_memory(duet: Scene, body: Body, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"it lasts 1e\+09 seconds, more than is read"):
        read_glb(stranger(duet.slice(0, 2), body, tmp_path / "a.glb", keys=np.array([0.0, 1e9])))


def test_the_command_takes_them(duet: Scene, body: Body, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = save_glb(duet, tmp_path / "a.glb", body)
    assert cli.main(["export", str(path), str(tmp_path / "b.npz")]) == 0
    assert off(Scene.load(tmp_path / "b.npz"), duet, body) < 1e-5
    assert "a.glb person_1: the body's own skeleton" in capsys.readouterr().out
    assert cli.main(["export", str(path), str(path)]) == 2  # its only recording, perhaps
    assert "is read, and would be written over" in capsys.readouterr().err


def test_joints_under_a_parent_that_is_scaled_along_one_axis_are_where_the_file_has_them(
    duet: Scene, body: Body, tmp_path: Path
) -> None:
    scene = duet.people().select([0])
    glb = glb_strangers.opened(stranger(scene, body, tmp_path / "a.glb"))
    glb.document["nodes"][0]["scale"] = [1.0, 1.25, 1.0]
    (person,) = read_glb(glb.save(tmp_path / "b.glb"))
    turned, at = person.world()
    found = at[:, [person.names.index(name) for name in JOINT_NAMES]]
    assert np.abs(found - body.joints(scene)[0, :, 0].numpy() * [1.0, 1.25, 1.0]).max() < 1e-4
    assert np.abs(turned @ turned.swapaxes(-1, -2) - np.eye(3)).max() < 1e-6


def test_a_spline_of_quaternions_does_not_go_round_where_keys_change_their_sign() -> None:
    angle = np.array([0.0, 0.4, 0.8, 1.2]) / 2
    own, slope = (np.stack([np.sin(angle + a), 0 * angle, 0 * angle, np.cos(angle + a)], -1) for a in (0, np.pi / 2))
    values = np.stack([0.2 * slope, own, 0.2 * slope], axis=1)  # keys a second apart
    at = np.linspace(0, 3, 31)
    truth = sampled(np.arange(4.0), values.reshape(-1, 4), "CUBICSPLINE", at, turns=True)
    signed = values * np.array([1.0, -1, -1, 1])[:, None, None]
    found = sampled(np.arange(4.0), signed.reshape(-1, 4), "CUBICSPLINE", at, turns=True)
    assert np.abs(np.abs((found * truth).sum(-1)) - (truth**2).sum(-1)).max() < 1e-9
    signed[1, 2] = [0.0, 0, 0, 48]  # as Blender has it across a change of sign
    found = sampled(np.arange(4.0), signed.reshape(-1, 4), "CUBICSPLINE", at, turns=True)
    found /= np.linalg.norm(found, axis=-1, keepdims=True)
    assert np.abs((found * truth).sum(-1) / np.linalg.norm(truth, axis=-1)).min() > 0.999
