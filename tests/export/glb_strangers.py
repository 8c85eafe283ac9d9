"""GLB files of other programs' kind: bones with rest rotations of their own, scaled and turned armatures, any keys."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]


class Written:
    """A glTF document that grows, and its bytes."""

    def __init__(self) -> None:
        self.document: dict[str, Any] = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": []}]}
        self.binary = b""

    def add(self, kind: str, item: dict[str, Any]) -> int:
        self.document.setdefault(kind, []).append(item)
        return len(self.document[kind]) - 1

    def numbers(self, array: Floats, kind: str, component: int = 5126) -> int:
        """An accessor; of 5122 (short whole numbers) one that stands for fractions."""
        data = (np.round(array * 32767) if component == 5122 else array).astype({5126: "<f4", 5122: "<i2"}[component])
        view = self.add("bufferViews", {"buffer": 0, "byteOffset": len(self.binary), "byteLength": data.nbytes})
        self.binary += data.tobytes() + bytes(-data.nbytes % 4)
        item = {"bufferView": view, "componentType": component, "count": len(array), "type": kind}
        return self.add("accessors", item | ({"normalized": True} if component == 5122 else {}))

    def save(self, path: Path) -> Path:
        self.document["buffers"] = [{"byteLength": len(self.binary)}]
        text = json.dumps(self.document).encode()
        text += b" " * (-len(text) % 4)
        total = 28 + len(text) + len(self.binary)
        head = struct.pack("<4sII", b"glTF", 2, total) + struct.pack("<I4s", len(text), b"JSON")
        path.write_bytes(head + text + struct.pack("<I4s", len(self.binary), b"BIN\0") + self.binary)
        return path


def opened(path: Path) -> Written:
    """A file to go on with."""
    data = path.read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    glb = Written()
    glb.document, glb.binary = json.loads(data[20 : 20 + size]), data[28 + size :]
    return glb


def frozen(path: Path) -> Path:
    """The same file with nodes that rest as they are in the first key of its animations."""
    glb = opened(path)
    for clip in glb.document["animations"]:
        for channel in clip["channels"]:
            accessor = glb.document["accessors"][clip["samplers"][channel["sampler"]]["output"]]
            begin = glb.document["bufferViews"][accessor["bufferView"]]["byteOffset"]
            width = {"VEC3": 3, "VEC4": 4}[accessor["type"]]
            node = glb.document["nodes"][channel["target"]["node"]]
            node.pop("matrix", None)
            node[channel["target"]["path"]] = np.frombuffer(glb.binary, "<f4", width, begin).tolist()
    return glb.save(path)


def parts(matrix: Floats) -> tuple[Floats, Floats, Floats]:
    """Translation, quaternion and scale of a transform (..., 4, 4)."""
    scale = np.linalg.norm(matrix[..., :3, :3], axis=-2)
    turn = matrix[..., :3, :3] / scale[..., None, :]
    return (
        matrix[..., :3, 3],
        Rotation.from_matrix(turn.reshape(-1, 3, 3)).as_quat().reshape(*turn.shape[:-2], 4),
        scale,
    )


def person(
    glb: Written,
    names: Sequence[str],
    parents: Sequence[int],
    turned: Floats,
    at: Floats,
    rest: Floats,
    keys: Floats,
    armature: Floats | None = None,
    seed: int = 0,
    how: str = "LINEAR",
    component: int = 5126,
    skinned: bool = True,
    label: str = "Armature",
) -> dict[int, int]:
    """Write one person in motion, and return the nodes of joints.

    Args:
        turned: (T, K, 3, 3) world rotations from the rest pose.
        at: (T, K, 3) joints.
        rest: (K, 3) joints in the rest pose.
        keys: (T,) seconds.
        armature: (4, 4) of the node that the skeleton hangs on.
        how: `LINEAR`, `STEP` or `CUBICSPLINE`, whose slopes are those of straight lines.
        component: of quaternions.
    """
    armature = np.eye(4) if armature is None else armature
    own = Rotation.random(len(names), random_state=seed).as_matrix()  # bones rest along axes of their own
    bound = np.tile(np.eye(4), (len(names), 1, 1))
    bound[:, :3, :3], bound[:, :3, 3] = own, rest
    bound = np.linalg.inv(armature) @ bound
    world = np.tile(np.eye(4), (*turned.shape[:2], 1, 1))
    world[..., :3, :3], world[..., :3, 3] = turned @ own, at
    world = np.linalg.inv(armature) @ world
    place, quat, scale = (x.tolist() for x in parts(armature))
    top = glb.add("nodes", {"name": label, "translation": place, "rotation": quat, "scale": scale, "children": []})
    glb.document["scenes"][0]["nodes"].append(top)
    time, nodes = glb.numbers(keys[:, None], "SCALAR"), {}
    clip: dict[str, Any] = {"name": f"{label} moves", "channels": [], "samplers": []}
    for k, name in enumerate(names):
        up = parents[k]
        rests = bound[k] if up < 0 else np.linalg.inv(bound[up]) @ bound[k]
        nodes[k] = glb.add("nodes", {"name": name, "matrix": rests.T.ravel().tolist(), "children": []})
        glb.document["nodes"][top if up < 0 else nodes[up]]["children"].append(nodes[k])
        moved = world[:, k] if up < 0 else np.linalg.inv(world[:, up]) @ world[:, k]
        for path, values in zip(("translation", "rotation", "scale"), parts(moved), strict=True):
            if path == "rotation":
                flip = np.sign((values[1:] * values[:-1]).sum(-1)).cumprod()
                values = values * np.concatenate([[1.0], flip])[:, None]
            if how == "CUBICSPLINE":
                slope = np.diff(values, axis=0) / np.diff(keys)[:, None]
                after, before = np.concatenate([slope, slope[-1:]]), np.concatenate([slope[:1], slope])
                values = np.stack([before, values, after], axis=1).reshape(-1, values.shape[1])
            kind, whole = ("VEC4", component) if path == "rotation" else ("VEC3", 5126)
            clip["channels"].append({"sampler": len(clip["samplers"]), "target": {"node": nodes[k], "path": path}})
            output = glb.numbers(values, kind, whole)
            clip["samplers"].append({"input": time, "output": output, "interpolation": how})
    glb.add("animations", clip)
    if skinned:
        back = np.linalg.inv(bound).swapaxes(-1, -2).reshape(-1, 16)
        joints = list(nodes.values())
        glb.add("skins", {"joints": joints, "inverseBindMatrices": glb.numbers(back, "MAT4")})
    return nodes
