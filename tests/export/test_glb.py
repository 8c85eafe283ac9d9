"""GLB, opened by an independent reader: joints where the body's are, skin where its vertices are."""

from __future__ import annotations

import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from magnet.body import Body
from magnet.body.joints import JOINT_NAMES
from magnet.export import save_glb
from magnet.export.bones import BoneOptions, bone_names
from magnet.export.drawing import AGENTS
from magnet.export.glb import Gltf, frame_times, influences, linear, unbroken, vertex_normals
from magnet.export.naming import recognised
from magnet.motion.scene import Scene
from magnet.testing import random_scene

Floats = NDArray[np.float64]
WIDTH = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}
KIND = {5126: "<f4", 5121: "u1", 5123: "<u2", 5125: "<u4"}


@pytest.fixture
def trio() -> Scene:
    return random_scene(1, 24, 3, torch.Generator().manual_seed(2))


class Opened:
    """A GLB as pygltflib reads it, posed by the glTF specification's rules alone."""

    def __init__(self, path: Path) -> None:
        pygltflib = pytest.importorskip("pygltflib", reason="pygltflib is not installed")
        self.gltf = pygltflib.GLTF2().load(str(path))
        self.blob = self.gltf.binary_blob()

    def numbers(self, accessor: int) -> NDArray[Any]:
        a = self.gltf.accessors[accessor]
        view = self.gltf.bufferViews[a.bufferView]
        start = (view.byteOffset or 0) + (a.byteOffset or 0)
        flat = np.frombuffer(self.blob, KIND[a.componentType], a.count * WIDTH[a.type], start)
        array = flat.reshape(a.count, WIDTH[a.type]).astype(np.float64)
        return array / np.iinfo(flat.dtype).max if a.normalized else array

    def world(self, seconds: float) -> list[Floats]:
        """World matrix of every node at a time."""
        moved: dict[tuple[int, str], Floats] = {}
        for animation, channel in [(each, channel) for each in self.gltf.animations for channel in each.channels]:
            sampler = animation.samplers[channel.sampler]
            times, values = self.numbers(sampler.input)[:, 0], self.numbers(sampler.output)
            at = np.clip(seconds, times[0], times[-1])
            if channel.target.path == "rotation":
                value = Slerp(times, Rotation.from_quat(values))(at).as_matrix()
            else:
                value = np.array([np.interp(at, times, column) for column in values.T])
            moved[channel.target.node, channel.target.path] = value
        matrices: list[Floats] = [np.eye(4)] * len(self.gltf.nodes)

        def place(number: int, above: Floats) -> None:
            node = self.gltf.nodes[number]
            local = np.eye(4)
            local[:3, 3] = moved.get((number, "translation"), node.translation or np.zeros(3))
            resting = Rotation.from_quat(node.rotation or [0, 0, 0, 1]).as_matrix()
            local[:3, :3] = moved.get((number, "rotation"), resting)
            matrices[number] = above @ local
            for child in node.children or []:
                place(child, matrices[number])

        for number in self.gltf.scenes[self.gltf.scene].nodes:
            place(number, np.eye(4))
        return matrices

    def people(self) -> list[Any]:
        """Nodes with a skinned mesh, by name."""
        return sorted((node for node in self.gltf.nodes if node.skin is not None), key=lambda node: node.name)

    def skinned(self, node: Any, matrices: list[Floats]) -> Floats:
        skin = self.gltf.skins[node.skin]
        (primitive,) = self.gltf.meshes[node.mesh].primitives
        rest = self.numbers(primitive.attributes.POSITION)
        joints = self.numbers(primitive.attributes.JOINTS_0).astype(int)
        weights = self.numbers(primitive.attributes.WEIGHTS_0)
        bind = self.numbers(skin.inverseBindMatrices).reshape(-1, 4, 4).transpose(0, 2, 1)
        moving = np.stack([matrices[j] for j in skin.joints]) @ bind
        blended = (weights[..., None, None] * moving[joints]).sum(axis=1)
        return (blended @ np.concatenate([rest, np.ones((len(rest), 1))], axis=1)[..., None])[:, :3, 0]


@pytest.mark.parametrize(
    "bones",
    [BoneOptions(), BoneOptions("vrm", root="none"), BoneOptions("mixamo", clips="person")],
    ids=lambda bones: f"{bones.names}-{bones.root}-{bones.clips}",
)
def test_joints_and_skin_are_the_bodys_within_a_tenth_of_a_millimetre(
    trio: Scene, body: Body, tmp_path: Path, bones: BoneOptions
):
    opened = Opened(save_glb(trio, tmp_path / "trio.glb", body, bones))
    assert [clip.name for clip in opened.gltf.animations] == (
        ["motion"] if bones.clips == "scene" else ["person_0", "person_1", "person_2"]
    )
    joints, vertices = body.joints(trio)[0].numpy(), body.vertices(trio)[0]
    assert [node.name for node in opened.people()] == [f"person_{p}_body" for p in range(3)]
    for frame in (0, 11, 23):
        matrices = opened.world(frame / 30)
        for person, node in enumerate(opened.people()):
            skin = opened.gltf.skins[node.skin]
            names = [opened.gltf.nodes[j].name for j in skin.joints]
            assert names == [*bone_names(bones.names), *(["root"] if bones.root == "floor" else [])]
            found = np.stack([matrices[j][:3, 3] for j in skin.joints[:22]])
            assert np.abs(found - joints[frame, person]).max() < 1e-4
            assert np.abs(opened.skinned(node, matrices) - vertices[frame, person].numpy()).max() < 1e-4


def test_the_root_bone_walks_on_the_floor_and_faces_where_the_pelvis_does(trio: Scene, body: Body, tmp_path: Path):
    opened = Opened(save_glb(trio, tmp_path / "trio.glb", body))
    roots = [number for number, node in enumerate(opened.gltf.nodes) if node.name == "root"]
    assert len(roots) == 3
    for frame in (0, 23):
        matrices = opened.world(frame / 30)
        for person, number in enumerate(roots):
            T_world_pelvis = trio.T_world_root[0, frame, person].numpy()
            assert np.abs(matrices[number][[0, 2], 3] - T_world_pelvis[[0, 2], 3]).max() < 1e-5
            assert np.abs(matrices[number][1, :3] - [0, 1, 0]).max() < 1e-6 and abs(matrices[number][1, 3]) < 1e-6
            left = T_world_pelvis[[0, 2], 0] / np.linalg.norm(T_world_pelvis[[0, 2], 0])
            assert np.abs(matrices[number][[0, 2], 0] - left).max() < 1e-4


@pytest.mark.parametrize("names", ["smplx", "vrm", "mixamo"])
def test_names_of_bones_are_understood_by_the_reader_of_other_programs_files(names: Any):
    found = bone_names(names)
    assert len(set(found)) == 22
    recognised_as = recognised(list(found)).joints
    needed = {j for j, name in enumerate(JOINT_NAMES) if name.split("_")[-1] in ("hip", "knee", "ankle", "elbow")}
    assert needed and all(recognised_as[j] == j for j in needed)


def test_there_is_a_keyframe_for_every_frame(trio: Scene, body: Body, tmp_path: Path):
    opened = Opened(save_glb(trio, tmp_path / "trio.glb", body))
    (animation,) = opened.gltf.animations
    times = opened.numbers(animation.samplers[0].input)[:, 0]
    assert np.abs(times - np.arange(24) / 30).max() < 1e-6
    assert len(animation.channels) == 3 * (2 + 23)  # of the bone on the floor: where it is and where it faces
    assert all(opened.gltf.accessors[sampler.output].count == 24 for sampler in animation.samplers)


def test_the_file_is_whole_and_aligned(trio: Scene, body: Body, tmp_path: Path):
    data = save_glb(trio, tmp_path / "trio", body).read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    (text, kind) = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON" and text % 4 == 0
    (binary, kind) = struct.unpack_from("<I4s", data, 20 + text)
    assert kind == b"BIN\0" and 28 + text + binary == len(data)


def test_numbers_of_any_size_are_aligned_and_the_buffer_is_whole():
    gltf = Gltf()
    for count in (1, 2, 3, 5):
        gltf.accessor(np.arange(count), 5121, "SCALAR")
        gltf.accessor(np.ones(1), 5126, "SCALAR")
    gltf.accessor(np.arange(3), 5121, "SCALAR")
    assert all(view["byteOffset"] % 4 == 0 for view in gltf.document["bufferViews"])
    data = gltf.packed()
    text = struct.unpack_from("<I", data, 12)[0]
    binary = struct.unpack_from("<I", data, 20 + text)[0]
    assert binary % 4 == 0 and len(data) == 28 + text + binary


def test_nothing_is_written_as_an_empty_list_which_gltf_has_not():
    text = Gltf().packed()[20:].split(b"BIN\0")[0]
    assert b"[]" not in text.replace(b'"nodes":[]', b"")


@pytest.mark.parametrize("root", ["floor", "none"])
def test_frames_are_joined_by_lines_and_a_skin_names_its_topmost_bone(root: Any, trio: Scene, body: Body, tmp_path):
    opened = Opened(save_glb(trio, tmp_path / "a.glb", body, BoneOptions(root=root)))
    (animation,) = opened.gltf.animations
    assert {sampler.interpolation for sampler in animation.samplers} == {"LINEAR"}
    tops = [opened.gltf.nodes[skin.skeleton].name for skin in opened.gltf.skins]
    assert tops == ["root" if root == "floor" else "pelvis"] * 3


@pytest.mark.parametrize(("last", "component"), [(65534, 5123), (65535, 5125)])
def test_vertices_are_numbered_by_two_bytes_while_none_is_the_number_that_restarts(last: int, component: int):
    """65535 ends a strip in glTF."""
    faces, weights = torch.tensor([[0, 1, last]]), torch.eye(22)
    gltf = Gltf()
    indices = gltf.skin_of(cast(Body, SimpleNamespace(faces=faces, weights=weights)))["indices"]
    assert gltf.document["accessors"][indices]["componentType"] == component


def test_turns_are_written_without_changes_of_sign(trio: Scene, body: Body, tmp_path: Path):
    root = trio.T_world_root.clone()
    turns = torch.from_numpy(Rotation.from_euler("Y", 40.0 * np.arange(24)[:, None], degrees=True).as_matrix()).float()
    root[0, :, :, :3, :3] = turns[:, None]
    opened = Opened(save_glb(trio.replace(T_world_root=root), tmp_path / "a.glb", body))
    (animation,) = opened.gltf.animations
    for channel in animation.channels:
        if channel.target.path == "rotation":
            values = opened.numbers(animation.samplers[channel.sampler].output)
            assert (values[1:] * values[:-1]).sum(axis=1).min() > 0


def test_people_wear_the_colours_of_pictures_by_slot(trio: Scene, body: Body, tmp_path: Path):
    gone = trio.replace(present=torch.tensor([[True, False, True]]))
    opened = Opened(save_glb(gone, tmp_path / "duo.glb", body))
    colours = [material.pbrMetallicRoughness.baseColorFactor for material in opened.gltf.materials]
    for got, slot in zip(colours, (0, 2), strict=True):
        assert got[:3] == pytest.approx(linear(AGENTS[slot]))
    assert linear((10, 11, 0)) == pytest.approx([10 / 255 / 12.92, ((11 / 255 + 0.055) / 1.055) ** 2.4, 0])
    assert linear((255, 0, 188))[:2] == [1.0, 0.0] and linear((0, 0, 188))[2] == pytest.approx(0.5029, abs=1e-3)


def test_people_of_one_shape_share_their_mesh(trio: Scene, body: Body, tmp_path: Path):
    apart = save_glb(trio, tmp_path / "a.glb", body)
    alike = save_glb(trio.replace(betas=torch.zeros_like(trio.betas)), tmp_path / "b.glb", body)
    mesh = 2 * 12 * len(body.v_template)
    assert apart.stat().st_size - alike.stat().st_size == pytest.approx(2 * mesh, rel=0.02)
    opened = Opened(alike)
    positions = {mesh.primitives[0].attributes.POSITION for mesh in opened.gltf.meshes}
    assert len(positions) == 1


def test_trimesh_opens_it_and_finds_everybody_at_rest(trio: Scene, body: Body, tmp_path: Path):
    trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed")
    opened = trimesh.load(save_glb(trio, tmp_path / "trio.glb", body))
    assert sorted(opened.geometry) == [f"person_{p}_body" for p in range(3)]
    resting = body.v_template + torch.einsum("vck,pk->pvc", body.shapedirs, trio.betas[0])
    lowest = resting[..., 1].amin(dim=1)
    resting[..., 1] -= lowest[:, None]  # everybody stands on the floor at rest
    for person in range(3):
        mesh = opened.geometry[f"person_{person}_body"]
        assert mesh.faces.shape == tuple(body.faces.shape) and mesh.is_watertight
        assert np.abs(mesh.vertices - resting[person].numpy()).max() < 1e-5
    # trimesh reads no animations: nodes are as they rest, and people after the first have theirs numbered.
    nodes = {name: opened.graph.get(name)[0][:3, 3] for name in opened.graph.nodes}
    for person, rest in enumerate(body.rest_joints(trio.betas[0]).numpy()):
        there = np.stack([nodes[f"{name}_{person}" if person else name] for name in JOINT_NAMES])
        assert np.abs(there - rest - [0, -float(lowest[person]), 0]).max() < 1e-5


def test_weights_sum_to_one_exactly(body: Body):
    joints, shares = influences(body.weights.double().numpy())
    assert (shares.sum(axis=1) == 65535).all() and (shares >= 0).all()
    assert (joints[shares == 0] == 0).all()
    back = np.zeros(tuple(body.weights.shape))
    np.add.at(back, (np.arange(len(back))[:, None], joints), shares / 65535)
    assert np.abs(back - body.weights.numpy()).max() < 1e-4


def test_of_five_joints_the_four_strongest_share_what_the_fifth_had():
    weights = np.zeros((1, 22))
    weights[0, [2, 5, 7, 11, 13]] = 0.3, 0.1, 0.25, 0.2, 0.15
    joints, shares = influences(weights)
    assert joints.tolist() == [[2, 7, 11, 13]]
    assert shares[0] / 65535 == pytest.approx(np.array([0.3, 0.25, 0.2, 0.15]) / 0.9, abs=2e-5)


def test_quaternions_take_the_short_way_round():
    turning = Rotation.from_euler("Y", np.arange(0, 1000, 10)[:, None], degrees=True).as_quat(canonical=True)
    way = unbroken(torch.from_numpy(turning))
    assert (way[1:] * way[:-1]).sum(-1).min() > 0
    assert np.abs(Rotation.from_quat(way.numpy()).as_matrix() - Rotation.from_quat(turning).as_matrix()).max() < 1e-9


def test_normals_of_a_cube_point_outwards():
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
    hull = pytest.importorskip("scipy.spatial").ConvexHull(corners)
    faces = hull.simplices.copy()
    for face, plane in zip(faces, hull.equations, strict=True):
        a, b, c = corners[face]
        if np.cross(b - a, c - a) @ plane[:3] < 0:
            face[1], face[2] = face[2], face[1]
    normals = vertex_normals(corners, faces)
    assert ((normals * corners).sum(axis=1) > 1.5).all()
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1.0)


def test_scenes_that_cannot_be_written_are_named(trio: Scene, body: Body, tmp_path: Path):
    with pytest.raises(ValueError, match="got 2 scenes"):
        save_glb(trio.repeat(2), tmp_path / "a.glb", body)
    with pytest.raises(ValueError, match="0 people and 24 frames"):
        save_glb(trio.replace(present=torch.zeros(1, 3, dtype=torch.bool)), tmp_path / "a.glb", body)
    with pytest.raises(ValueError, match="3 people and 0 frames"):
        save_glb(trio.slice(0, 0), tmp_path / "a.glb", body)
    with pytest.raises(ValueError, match="belongs to body 'other'"):
        save_glb(trio.replace(body="other"), tmp_path / "a.glb", body)


def test_people_who_are_written_alone_keep_their_numbers(trio: Scene, body: Body, tmp_path: Path) -> None:
    """Or a file a person, as engines want them, would hold clips of one name."""
    for present, numbers in (([False, True, False], [1]), ([True, False, True], [0, 2])):
        some = trio.replace(present=torch.tensor([present]))
        opened = Opened(save_glb(some, tmp_path / "some.glb", body, BoneOptions(clips="person")))
        assert [clip.name for clip in opened.gltf.animations] == [f"person_{p}" for p in numbers]
        assert [node.name for node in opened.people()] == [f"person_{p}_body" for p in numbers]
        assert [skin.name for skin in opened.gltf.skins] == [f"person_{p}" for p in numbers]


def test_no_time_of_a_frame_is_before_it(body: Body, tmp_path: Path) -> None:
    """Blender takes whole frames from them and would leave out the last: 2.1 s is frame 62.999997 at 30 a second."""
    for fps in (24.0, 29.97, 30.0, 60.0, 120.0):
        times = frame_times(5000, fps)
        frames = times.astype(np.float64) * fps
        assert times.dtype == np.float32 and (frames >= np.arange(5000)).all()
        assert np.abs(frames - np.arange(5000)).max() < 1e-3 and (np.diff(times) > 0).all()
