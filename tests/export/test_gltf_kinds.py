"""glTF in its other dresses: a text with files beside it, VRM avatars and VRM animations."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from magnet import checkpoints
from magnet.body import Body
from magnet.body.joints import JOINT_NAMES
from magnet.export import formats, save_glb
from magnet.export.bones import BoneOptions, bone_names
from magnet.export.gltf_file import GltfFile
from magnet.export.onto_rig import save_onto
from magnet.export.read_options import Reading
from magnet.export.reading import read
from magnet.motion.rotations import from_quat
from magnet.motion.scene import Scene
from magnet.testing import random_scene
from tests.export import glb_strangers
from tests.export.test_glb_read import off, stranger
from tests.export.test_onto_rig import someone

PICTURE = b"\x89PNG of no matter what"


@pytest.fixture(scope="module")
def couple() -> Scene:
    """A generated couple of mean shape, twelve frames."""
    scene = Scene.load(checkpoints.FOLDER / "duet" / "scenes" / "duet.npz").slice(0, 12)
    return scene.replace(betas=torch.zeros_like(scene.betas))


def as_text(glb: Path, uri: Callable[[bytes], str] | None = None, picture: str = "") -> Path:
    """The .gltf of a .glb: its numbers in a file beside it, or in a URI."""
    file = glb_strangers.opened(glb)
    beside = glb.with_name("its numbers.bin")
    beside.write_bytes(file.binary)
    said = "its%20numbers.bin" if uri is None else uri(file.binary)
    file.document["buffers"] = [{"byteLength": len(file.binary), "uri": said}]
    if picture:
        file.document |= {"images": [{"uri": picture}], "textures": [{"source": 0}]}
    path = glb.with_suffix(".gltf")
    path.write_text(json.dumps(file.document))
    return path


def in_uri(data: bytes) -> str:
    return "data:application/octet-stream;base64," + base64.b64encode(data).decode()


@pytest.mark.parametrize("uri", [None, in_uri], ids=["beside", "in it"])
def test_a_text_with_its_numbers_beside_it_is_the_same_motion(
    uri: Callable[[bytes], str] | None, couple: Scene, body: Body, tmp_path: Path
) -> None:
    path = as_text(save_glb(couple, tmp_path / "a.glb", body), uri)
    got = read(path)
    assert off(got.scene, couple, body) < 1e-5 and "the body's own skeleton" in got.notes[0]


def sparse(glb: Path, component: int, path: Path, base: bool) -> Path:
    """The same with keyframes that name the numbers that differ from a first array, or from zero."""
    file = glb_strangers.opened(glb)
    kind, accessors = {5121: "u1", 5123: "<u2", 5125: "<u4"}[component], file.document["accessors"]
    for index in {sampler["output"] for clip in file.document["animations"] for sampler in clip["samplers"]}:
        values, width = GltfFile(glb).numbers(index).astype("<f4"), {"VEC3": 3, "VEC4": 4}[accessors[index]["type"]]
        plain = np.tile(values[:1], (len(values), 1)) if base else np.zeros_like(values)
        rows = np.flatnonzero((values != plain).any(axis=1))
        if not len(rows):
            continue

        def view(data: bytes) -> int:
            begin = len(file.binary)
            file.binary += data + bytes(-len(data) % 4)
            return file.add("bufferViews", {"buffer": 0, "byteOffset": begin, "byteLength": len(data)})

        said = {"componentType": 5126, "count": len(values), "type": f"VEC{width}"}
        accessors[index] = said | ({"bufferView": view(plain.tobytes())} if base else {})
        accessors[index]["sparse"] = {
            "count": len(rows),
            "indices": {"bufferView": view(rows.astype(kind).tobytes()), "componentType": component},
            "values": {"bufferView": view(values[rows].tobytes())},
        }
    return file.save(path)


@pytest.mark.parametrize("base", [True, False])
@pytest.mark.parametrize("component", [5121, 5123, 5125])
def test_keyframes_may_be_sparse(component: int, base: bool, couple: Scene, body: Body, tmp_path: Path) -> None:
    """They were refused, although the specification has them."""
    whole = stranger(couple, body, tmp_path / "a.glb")
    path = sparse(whole, component, tmp_path / "b.glb", base)
    assert "sparse" in glb_strangers.opened(path).document["accessors"][1]
    one, other = read(whole).scene, read(path).scene
    assert torch.equal(one.body_rot, other.body_rot) and torch.equal(one.T_world_root, other.T_world_root)


@pytest.mark.parametrize(
    "said", ["../secret.bin", "/etc/hostname", "gone.bin", "http://example.org/a.bin", "a" * 5000, "a%00.bin"]
)
def test_what_does_not_lie_beside_a_text_is_not_read(said: str, couple: Scene, body: Body, tmp_path: Path) -> None:
    folder = tmp_path / "own"
    folder.mkdir()
    (tmp_path / "secret.bin").write_bytes(bytes(10**6))
    path = as_text(save_glb(couple, folder / "a.glb", body), lambda data: said)
    with pytest.raises(ValueError, match=r"a\.gltf: its numbers are in another file \(.+\), which is not beside it"):
        read(path)


def test_numbers_in_a_uri_that_is_not_base64_are_one_short_line(couple: Scene, body: Body, tmp_path: Path) -> None:
    path = as_text(save_glb(couple, tmp_path / "a.glb", body), lambda data: "data:application/x," + "a" * 5000)
    with pytest.raises(ValueError, match=r"its numbers are in a URI \(data:.{35}\) that is not in base64"):
        read(path)


@pytest.mark.parametrize(
    "text",
    [
        "{}",
        '{"asset": {"version": "1.0"}}',
        "{",
        '{"asset": 1}',
        '{"asset": {"version": "2.0"}, "extensionsRequired": 5}',
    ],
)
def test_a_text_that_is_no_gltf_is_one_line(text: str, tmp_path: Path) -> None:
    path = tmp_path / "a.gltf"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"a\.gltf: not a whole \.gltf file \(.+\): export it again"):
        read(path)


def test_a_character_in_several_files_becomes_one(couple: Scene, body: Body, tmp_path: Path) -> None:
    (tmp_path / "skin.png").write_bytes(PICTURE)
    rig = as_text(save_glb(someone(couple), tmp_path / "rig.glb", body), picture="skin.png")
    paths = save_onto(couple, tmp_path / "out" / "dance.glb", body, [rig])
    assert off(read(paths, options=Reading(keep_floor=True)).scene, couple, body) < 1e-5
    for path in paths:
        file = GltfFile(path)
        (image,) = file.document["images"]
        view = file.document["bufferViews"][image["bufferView"]]
        assert file.binary[view["byteOffset"] :][: view["byteLength"]] == PICTURE and image["mimeType"] == "image/png"
        assert len(file.document["buffers"]) == 1 and "uri" not in file.document["buffers"][0]


def test_a_picture_that_is_missing_is_said(couple: Scene, body: Body, tmp_path: Path) -> None:
    rig = as_text(save_glb(someone(couple), tmp_path / "rig.glb", body), picture="skin.png")
    with pytest.raises(ValueError, match=r"rig\.gltf: its pictures are in another file \(skin\.png\), which is not"):
        save_onto(couple, tmp_path / "dance.glb", body, [rig])
    assert not list(tmp_path.glob("dance*"))


def avatar(scene: Scene, body: Body, path: Path, version: int) -> Path:
    """A VRM avatar whose bones have names that say nothing, and rest along axes of their own."""
    stranger(someone(scene), body, path)
    file = glb_strangers.opened(path)
    bones: dict[str, Any] = {}
    for name, role in zip(JOINT_NAMES, bone_names("vrm"), strict=True):
        node = next(k for k, each in enumerate(file.document["nodes"]) if each["name"] == name)
        file.document["nodes"][node]["name"] = f"B{node:02}_x"
        bones[role] = {"node": node}
    listed = [{"bone": role, **bone} for role, bone in bones.items()]
    said = {"VRM": listed} if version == 0 else {"VRMC_vrm": bones}
    file.document["extensions"] = {name: {"humanoid": {"humanBones": held}} for name, held in said.items()}
    return file.save(path)


@pytest.mark.parametrize("version", [0, 1])
def test_an_avatar_says_what_its_bones_are(version: int, couple: Scene, body: Body, tmp_path: Path) -> None:
    rig = avatar(couple, body, tmp_path / "hero.vrm", version)
    paths = save_onto(couple, tmp_path / "dance.glb", body, [rig])
    got = read(paths, options=Reading(keep_floor=True))
    assert off(got.scene, couple, body) < 0.015 and "22 joints mapped" in got.notes[0]  # other names are fitted
    assert GltfFile(paths[0]).document["extensions"] == GltfFile(rig).document["extensions"]
    plain = glb_strangers.opened(rig)
    del plain.document["extensions"]
    with pytest.raises(ValueError, match="left_hip"):
        save_onto(couple, tmp_path / "other.glb", body, [plain.save(tmp_path / "plain.glb")])


def test_a_vrm_animation_holds_what_its_specification_asks_for(couple: Scene, body: Body, tmp_path: Path) -> None:
    paths = formats.write(couple, tmp_path / "dance.vrma", body)
    assert [path.name for path in paths] == ["dance_person0.vrma", "dance_person1.vrma"]
    assert paths == formats.files_of(tmp_path / "dance.vrma", [[0, 1]])
    for p, path in enumerate(paths):
        file = GltfFile(path)
        said = file.document["extensions"]["VRMC_vrm_animation"]
        assert said["specVersion"] == "1.0" and file.document["extensionsUsed"] == ["VRMC_vrm_animation"]
        roles = {role: bone["node"] for role, bone in said["humanoid"]["humanBones"].items()}
        needed = {f"{side}{limb}" for side in ("left", "right") for limb in ("UpperLeg", "Foot", "LowerArm", "Hand")}
        assert needed | {"hips", "spine", "head"} <= set(roles)
        (clip,) = file.document["animations"]
        moved = {(each["target"]["node"], each["target"]["path"]): each["sampler"] for each in clip["channels"]}
        assert [node for node, what in moved if what == "translation"] == [roles["hips"]]
        hips = file.numbers(clip["samplers"][moved[roles["hips"], "translation"]]["output"])
        assert np.allclose(hips, couple.T_world_root[0, :, p, :3, 3], atol=1e-5)
        for role, joint in (("hips", 0), ("leftLowerArm", JOINT_NAMES.index("left_elbow"))):
            turn = file.numbers(clip["samplers"][moved[roles[role], "rotation"]]["output"])
            rots = torch.cat([couple.T_world_root[0, :, p, None, :3, :3], couple.body_rot[0, :, p]], dim=1)
            assert np.allclose(from_quat(torch.from_numpy(turn)), rots[:, joint], atol=1e-5)
        assert "meshes" not in file.document and "skins" not in file.document
        rest = np.stack([file.at_rest(roles[role])[:3, 3] for role in ("leftHand", "rightHand", "head", "leftToes")])
        assert rest[0, 0] > 0.4 and rest[1, 0] < -0.4 and rest[2, 1] > 1.2 and rest[3, 2] > 0.05  # T, facing +z


def test_vrm_animations_are_read_as_people_of_one_world(couple: Scene, body: Body, tmp_path: Path) -> None:
    got = read(formats.write(couple, tmp_path / "dance.vrma", body), options=Reading(keep_floor=True))
    assert got.scene.agents == 2 and off(got.scene, couple, body) < 0.015


def test_vrm_animations_of_any_shape_come_back_exactly(body: Body, tmp_path: Path) -> None:
    """Also where people stand over the floor, as whoever is fitted would not."""
    couple = random_scene(1, 12, 2, torch.Generator().manual_seed(4))
    got = read(formats.write(couple, tmp_path / "dance.vrma", body))
    assert got.scene.agents == 2 and off(got.scene, couple, body) < 1e-5
    assert [note for note in got.notes if "the body's own skeleton" not in note] == []
    assert torch.allclose(got.scene.betas, couple.betas, atol=1e-3)


def test_an_animation_is_no_character(couple: Scene, body: Body, tmp_path: Path) -> None:
    (rig,) = formats.write(couple.people().select([0]), tmp_path / "rig.vrma", body)
    with pytest.raises(ValueError, match=r"got rig\.vrma for dance\.glb; .+ \.vrm to \.glb"):
        save_onto(couple, tmp_path / "dance.glb", body, [rig])
    save_glb(someone(couple), tmp_path / "rig.glb", body, BoneOptions())
    with pytest.raises(ValueError, match=r"a character is written as it was read"):
        save_onto(couple, tmp_path / "dance.vrm", body, [tmp_path / "rig.glb"])
