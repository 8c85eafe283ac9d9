"""Scenes as one animated GLB: everybody skinned in one world, for Blender, Unity, Unreal and the browser."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from magnet.body import Body
from magnet.body.joints import PARENTS
from magnet.export.bones import BoneOptions, Names, bone_names
from magnet.export.drawing import AGENTS
from magnet.files import suffixed, whole
from magnet.motion.frames import canonical_frame, inverse
from magnet.motion.required import require_body, require_one
from magnet.motion.rotations import to_quat
from magnet.motion.scene import BODY_JOINTS, Scene
from magnet.version import __version__

FLOAT, BYTE, SHORT, INT = 5126, 5121, 5123, 5125
VERTEX_DATA, INDICES = 34962, 34963
INFLUENCES = 4
"""Joints that move one vertex at most, as engines expect."""


def save_glb(scene: Scene, path: str | Path, body: Body, bones: BoneOptions = BoneOptions()) -> Path:
    """Write one scene (B = 1) as binary glTF 2.0: metres, y up, a keyframe for every frame of the scene.

    Each person present is a node `person_0`, `person_1` ..., numbered by slot, with a bone on the floor, the 22 joints
    below it, and a mesh skinned to them in the slot's colour. At rest everybody stands on the floor in the T pose.
    People of one shape share a mesh. Pose correctives of a SMPL-X file cannot be expressed and are left out.
    Returns the path written.

    Args:
        bones: names and hierarchy of bones, and the number of animations.

    Raises:
        ValueError: more than one scene, nobody present, no frames, or another body's.
    """
    slots = slots_to_write(scene, body)
    gltf = Gltf()
    skin = gltf.skin_of(body)
    times = gltf.accessor(frame_times(scene.frames, scene.fps), FLOAT, "SCALAR", bounds=True)
    shaped: dict[bytes, dict[str, int]] = {}
    scene_clip = animation("motion")
    for slot in slots:
        betas = scene.betas[0, slot].detach().cpu().float()
        shape = shaped.setdefault(betas.numpy().tobytes(), {})
        if not shape:
            shape |= gltf.shape_of(body, betas)
        pelvis, floor = gltf.person(slot, standing(body, betas), {**skin, **shape}, bones)
        clip = scene_clip if bones.clips == "scene" else animation(f"person_{slot}")
        nodes = [*([] if floor is None else [floor]), *range(pelvis, pelvis + BODY_JOINTS)]
        gltf.animate(clip, times, nodes, *moved(scene, slot, bones.root == "floor"))
        if bones.clips == "person":
            gltf.document["animations"].append(clip)
    if bones.clips == "scene":
        gltf.document["animations"].append(scene_clip)
    path = suffixed(path, ".glb")
    with whole(path) as part:
        part.write_bytes(gltf.packed())
    return path


def slots_to_write(scene: Scene, body: Body) -> list[int]:
    """Slots of the people in a scene.

    Raises:
        ValueError: more than one scene, nobody present, no frames, or another body's.
    """
    require_one(scene)
    require_body(scene, body.id)
    slots = scene.present[0].nonzero()[:, 0].tolist()
    if not slots or not scene.frames:
        raise ValueError(f"{len(slots)} people and {scene.frames} frames: there is nothing to write")
    return slots


def frame_times(frames: int, fps: float) -> NDArray[np.float32]:
    """Seconds of frames, none rounded down: Blender's exporter would leave the last frame out. -> (T,)"""
    number = np.arange(frames, dtype=np.float64)
    times = (number / fps).astype(np.float32)
    short = times.astype(np.float64) * fps < number
    return np.where(short, np.nextafter(times, np.float32(np.inf)), times)


def animation(name: str) -> dict[str, Any]:
    """An animation of nothing yet."""
    return {"name": name, "samplers": [], "channels": []}


def standing(body: Body, betas: Tensor) -> Tensor:
    """Joints of a body at rest that stands on the floor. betas (10,) -> (22, 3) float64"""
    return body.rest_joints(betas).detach().cpu().double() + _raised(_resting(body, betas))


def standing_vertices(body: Body, betas: Tensor) -> NDArray[np.float64]:
    """Vertices of a body at rest that stands on the floor. betas (10,) -> (V, 3)"""
    vertices = _resting(body, betas)
    return (vertices + _raised(vertices)).numpy()


def _resting(body: Body, betas: Tensor) -> Tensor:
    """Vertices of a body in its own frame. -> (V, 3) float64"""
    return body.v_template.detach().cpu().double() + body.shapedirs.detach().cpu().double() @ betas.double()


def _raised(vertices: Tensor) -> Tensor:
    """By how much a resting body must be raised to stand on y = 0. (V, 3) -> (3,)"""
    return torch.tensor([0.0, -float(vertices[:, 1].min()), 0.0], dtype=torch.float64)


def moved(scene: Scene, slot: int, floor: bool = False) -> tuple[Tensor, Tensor]:
    """How a person of a scene (B = 1) moves, joint by joint, below a bone on the floor or without one.

    Returns:
        Places of the pelvis, or of the bone on the floor and of it, (T, n, 3); and turns of this bone and all joints
        relative to the one above, (T, n + 21, 4), x y z w. float64
    """
    T_above_pelvis = scene.T_world_root[0, :, slot].detach().cpu().double()
    above = []
    if floor:
        T_world_floor = canonical_frame(T_above_pelvis)
        T_above_pelvis = inverse(T_world_floor) @ T_above_pelvis
        above = [T_world_floor]
    frames = torch.stack([*above, T_above_pelvis], dim=1)
    local = torch.cat([frames[..., :3, :3], scene.body_rot[0, :, slot].detach().cpu().double()], dim=1)
    return frames[..., :3, 3], unbroken(to_quat(local))


class Gltf:
    """A glTF document and its one binary buffer, grown part by part; without arguments a new one."""

    def __init__(self, document: dict[str, Any] | None = None, binary: bytearray | None = None) -> None:
        self.document: dict[str, Any] = document or {
            "asset": {"version": "2.0", "generator": f"magnet {__version__}"},
            "scene": 0,
            "scenes": [{"name": "scene", "nodes": []}],
            "nodes": [],
            "meshes": [],
            "materials": [],
            "skins": [],
            "animations": [],
            "accessors": [],
            "bufferViews": [],
        }
        self.binary = bytearray() if binary is None else binary

    def add(self, kind: str, item: dict[str, Any]) -> int:
        self.document.setdefault(kind, []).append(item)
        return len(self.document[kind]) - 1

    def accessor(
        self,
        array: NDArray[Any],
        component: int,
        kind: str,
        target: int | None = None,
        normalized: bool = False,
        bounds: bool = False,
    ) -> int:
        """Put numbers into the buffer. (N,) or (N, C) -> number of the accessor"""
        array = np.ascontiguousarray(array, dtype={FLOAT: "<f4", BYTE: "u1", SHORT: "<u2", INT: "<u4"}[component])
        self.binary += bytes(-len(self.binary) % 4)
        view = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": array.nbytes}
        self.binary += array.tobytes()
        item: dict[str, Any] = {
            "bufferView": self.add("bufferViews", view | ({"target": target} if target else {})),
            "componentType": component,
            "count": len(array),
            "type": kind,
        }
        if normalized:
            item["normalized"] = True
        if bounds:
            flat = array.reshape(len(array), -1)
            item |= {"min": flat.min(axis=0).tolist(), "max": flat.max(axis=0).tolist()}
        return self.add("accessors", item)

    def skin_of(self, body: Body) -> dict[str, int]:
        """The part of the skin that does not depend on a person's shape: faces, and which joints move which vertex."""
        joints, weights = influences(body.weights.detach().cpu().double().numpy())
        faces = body.faces.detach().cpu().numpy()
        wide = INT if faces.max() > 65534 else SHORT
        return {
            "indices": self.accessor(faces.reshape(-1), wide, "SCALAR", INDICES),
            "JOINTS_0": self.accessor(joints, BYTE, "VEC4", VERTEX_DATA),
            "WEIGHTS_0": self.accessor(weights, SHORT, "VEC4", VERTEX_DATA, normalized=True),
        }

    def shape_of(self, body: Body, betas: Tensor) -> dict[str, int]:
        """The mesh at rest of one shape, standing on the floor."""
        vertices = standing_vertices(body, betas)
        normals = vertex_normals(vertices, body.faces.detach().cpu().numpy())
        return {
            "POSITION": self.accessor(vertices, FLOAT, "VEC3", VERTEX_DATA, bounds=True),
            "NORMAL": self.accessor(normals, FLOAT, "VEC3", VERTEX_DATA),
        }

    def person(self, slot: int, rest: Tensor, mesh: dict[str, int], bones: BoneOptions) -> tuple[int, int | None]:
        """Nodes, colour, mesh and skin of one person at rest. rest (22, 3), standing

        Returns:
            The pelvis's node, after which joints follow in order, and that of the bone on the floor.
        """
        label = f"person_{slot}"
        group = self.add("nodes", {"name": label, "children": []})
        floor = self.add("nodes", {"name": "root", "children": []}) if bones.root == "floor" else None
        pelvis = self.bones(rest, bones.names)
        if floor is not None:
            self.document["nodes"][group]["children"].append(floor)
        self.document["nodes"][group if floor is None else floor]["children"].append(pelvis)
        joints = [*range(pelvis, pelvis + BODY_JOINTS), *([] if floor is None else [floor])]
        bind = np.tile(np.eye(4), (len(joints), 1, 1))
        bind[:BODY_JOINTS, 3, :3] = -rest.numpy()  # column-major: the translation is the last row
        matrices = self.accessor(bind.reshape(len(joints), 16), FLOAT, "MAT4")
        top = pelvis if floor is None else floor
        skin = {"name": label, "joints": joints, "skeleton": top, "inverseBindMatrices": matrices}
        look = {
            "name": label,
            "pbrMetallicRoughness": {
                "baseColorFactor": [*linear(AGENTS[slot % len(AGENTS)]), 1.0],
                "metallicFactor": 0.0,
                "roughnessFactor": 0.7,
            },
        }
        attributes = {key: mesh[key] for key in ("POSITION", "NORMAL", "JOINTS_0", "WEIGHTS_0")}
        primitive = {"attributes": attributes, "indices": mesh["indices"], "material": self.add("materials", look)}
        body = {
            "name": f"{label}_body",
            "mesh": self.add("meshes", {"name": f"{label}_body", "primitives": [primitive]}),
            "skin": self.add("skins", skin),
        }
        # A skinned mesh moves with its joints alone, so that it must not also hang on a node that moves.
        self.document["scenes"][0]["nodes"] += [group, self.add("nodes", body)]
        return pelvis, floor

    def bones(self, rest: Tensor, names: Names) -> int:
        """Nodes of the joints of one person at rest, in order; returns the pelvis's. rest (22, 3), standing"""
        pelvis = len(self.document["nodes"])
        for j, name in enumerate(bone_names(names)):
            away = rest[j] - (rest[PARENTS[j]] if j else 0.0)
            node: dict[str, Any] = {"name": name, "translation": away.tolist()}
            children = [pelvis + c for c in range(BODY_JOINTS) if PARENTS[c] == j]
            self.add("nodes", node | ({"children": children} if children else {}))
        return pelvis

    def animate(self, clip: dict[str, Any], times: int, nodes: Sequence[int], place: Tensor, turns: Tensor) -> None:
        """Keyframes of nodes, of which the first ones move and all turn. place (T, n, 3), turns (T, J, 4) x y z w"""
        for j, node in enumerate(nodes):
            if j < place.shape[1]:
                self.track(clip, times, node, "translation", place[:, j])
            self.track(clip, times, node, "rotation", turns[:, j])

    def track(self, clip: dict[str, Any], times: int, node: int, what: str, values: Tensor) -> None:
        """Keyframes of a node's translation (T, 3) or rotation (T, 4), x y z w."""
        output = self.accessor(values.numpy(), FLOAT, "VEC4" if what == "rotation" else "VEC3")
        clip["channels"].append({"sampler": len(clip["samplers"]), "target": {"node": node, "path": what}})
        clip["samplers"].append({"input": times, "output": output, "interpolation": "LINEAR"})

    def packed(self) -> bytes:
        """The file: header, JSON padded with spaces, buffer padded with zeros."""
        held = {key: value for key, value in self.document.items() if value != []}  # glTF has no empty lists
        data = bytes(self.binary) + bytes(-len(self.binary) % 4)
        text = json.dumps(held | {"buffers": [{"byteLength": len(data)}]}, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        total = 12 + 8 + len(text) + 8 + len(data)
        head = struct.pack("<4sII", b"glTF", 2, total) + struct.pack("<I4s", len(text), b"JSON")
        return head + text + struct.pack("<I4s", len(data), b"BIN\0") + data


def unbroken(quaternions: Tensor) -> Tensor:
    """The same rotations without changes of sign, between which players would take the long way. (T, ..., 4) -> same"""
    turns = (quaternions[1:] * quaternions[:-1]).sum(-1, keepdim=True) < 0
    sign = torch.where(turns, -1.0, 1.0).to(quaternions).cumprod(dim=0)
    return torch.cat([quaternions[:1], quaternions[1:] * sign])


def influences(weights: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Each vertex's four strongest joints, and their weights as whole shares of 65535. (V, 22) -> (V, 4) x 2"""
    joints = np.argsort(-weights, axis=1, kind="stable")[:, :INFLUENCES]
    strongest = np.take_along_axis(weights, joints, axis=1)
    shares = np.round(65535 * strongest / strongest.sum(axis=1, keepdims=True)).astype(np.int64)
    shares[:, 0] += 65535 - shares.sum(axis=1)
    return np.where(shares > 0, joints, 0), shares  # glTF asks unused joints to be 0


def vertex_normals(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Unit normals, each the mean of its faces' by their areas. (V, 3), (F, 3) -> (V, 3)"""
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], across)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(length > 0, normals / np.maximum(length, 1e-12), [0.0, 1.0, 0.0])


def linear(colour: tuple[int, int, int]) -> list[float]:
    """A colour of pictures (sRGB, 0 to 255) as glTF wants it: linear, 0 to 1."""
    share = np.array(colour) / 255
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4).tolist()
