"""The parts of a glTF 2.0 file that say how nodes move: numbers, the tree of nodes, their places in time."""

from __future__ import annotations

import base64
import copy
import json
import mimetypes
import struct
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import torch
from numpy.typing import NDArray

from magnet.export.rig_motion import Floats
from magnet.files import regular
from magnet.motion.resample import slerp_quat
from magnet.motion.rotations import from_quat, to_quat

GLTF = (".glb", ".gltf", ".vrm", ".vrma")
"""Suffixes of glTF: one file; a text with files beside it; VRM's avatars and motions, which say what each bone is."""
KINDS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
PLACES = {kind: KINDS[kind] for kind in (5121, 5123, 5125)}
"""Kinds of numbers that count places, of sparse accessors."""
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
PACKED = ("EXT_meshopt_compression", "KHR_meshopt_compression")
"""Extensions in which keyframes themselves are compressed."""
MOST_ZEROS = 10**6
"""Numbers that a file may say are all zero, without holding them."""
DEFAULTS = {"translation": (0.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0, 1.0), "scale": (1.0, 1.0, 1.0)}

STEEPEST = 4.0
"""Length of a quaternion's slope over the time to the next key from which it is no turn that anybody keyed."""


class GltfFile:
    """A glTF file that is read, binary or a text: its document, and what is computed from it.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: no glTF, cut short, or of an extension that is not read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        data = regular(path).read_bytes()
        self._buffers: dict[int, bytes] = {}
        try:
            self.document, self.binary = _opened(data)
            self.nodes: list[dict[str, Any]] = self.document.get("nodes", [])
            packed = set(self.document.get("extensionsRequired", [])) & set(PACKED)
        except (ValueError, struct.error, AttributeError, KeyError, TypeError, RecursionError) as error:
            raise ValueError(f"{path}: not a whole {path.suffix.lower()} file ({error}): export it again") from error
        if packed:
            raise ValueError(f"{path}: its motion is compressed ({min(packed)}): export it without compression")

    def numbers(self, index: int) -> Floats:
        """An accessor's numbers, whole ones that stand for fractions as such. -> (N, C)"""
        accessor = self.document["accessors"][index]
        kind, width, count = np.dtype(KINDS[accessor["componentType"]]), WIDTHS[accessor["type"]], accessor["count"]
        if "bufferView" in accessor:
            held = self._held(index, accessor, kind, count, width)
        elif 0 <= count <= MOST_ZEROS:
            held = np.zeros((count, width), kind)
        else:
            raise IndexError(f"numbers {index} are {count} that it does not hold")
        if few := accessor.get("sparse"):  # what differs from the others, and where
            where = self._held(
                index, few["indices"], np.dtype(PLACES[few["indices"]["componentType"]]), few["count"], 1
            )
            held = held.copy()
            held[where[:, 0]] = self._held(index, few["values"], kind, few["count"], width)
        with np.errstate(invalid="ignore"):  # NaN of another kind: it is refused below
            values = held.astype(np.float64)
        if accessor.get("normalized"):
            values = np.maximum(values / np.iinfo(kind).max, -1.0)
        if not np.isfinite(values).all():
            raise ValueError("it holds NaN or infinity")
        return values

    def _held(self, index: int, said: dict[str, Any], kind: np.dtype[Any], count: int, width: int) -> NDArray[Any]:
        """Numbers (count, width) of a buffer, of which an accessor, or a part of a sparse one, says the place."""
        view = self.document["bufferViews"][said["bufferView"]]
        begin = view.get("byteOffset", 0) + said.get("byteOffset", 0)
        stride = view.get("byteStride") or width * kind.itemsize
        data = self._buffer(view["buffer"])
        try:
            return np.ndarray((count, width), kind, data, begin, (stride, kind.itemsize))
        except (ValueError, TypeError, OverflowError) as error:
            raise IndexError(f"numbers {index} lie outside the file") from error

    def _buffer(self, index: int) -> bytes:
        if index not in self._buffers:
            said = self.document["buffers"][index].get("uri")
            self._buffers[index] = self.binary if said is None else self._linked(said, "numbers are")
        return self._buffers[index]

    def _linked(self, said: str, what: str) -> bytes:
        """What a URI stands for: bytes in itself, or a file in the folder of this one."""
        head, _, content = said.partition(",")
        if head.startswith("data:"):
            if not head.endswith(";base64"):
                raise ValueError(f"its {what} in a URI ({said:.40}) that is not in base64: export it again")
            return base64.b64decode(content, validate=True)  # a ValueError where it is none
        place = self.path.parent / unquote(said)
        try:  # what lies elsewhere would be put into files that are passed on
            beside = place.resolve().is_relative_to(self.path.parent.resolve()) and place.is_file()
        except (OSError, ValueError):  # no name that a file can have
            beside = False
        if not beside:
            raise ValueError(f"its {what} in another file ({said:.40}), which is not beside it: keep both together")
        return regular(place).read_bytes()

    def in_one(self) -> tuple[dict[str, Any], bytearray]:
        """A copy of the document, and its one buffer, which holds what was in several and in files of pictures."""
        document, binary = copy.deepcopy(self.document), bytearray()

        def add(data: bytes) -> int:
            binary.extend(bytes(-len(binary) % 4))
            binary.extend(data)
            return len(binary) - len(data)

        begins = [add(self._buffer(k)) for k in range(len(document.get("buffers", [])))]
        views = document.setdefault("bufferViews", [])
        for view in views:
            for part in (view, *view.get("extensions", {}).values()):
                part["byteOffset"] = part.get("byteOffset", 0) + begins[part["buffer"]]
                part["buffer"] = 0
        for image in document.get("images", []):
            if (said := image.pop("uri", None)) is not None:
                data = self._linked(said, "pictures are")
                image.setdefault("mimeType", mimetypes.guess_type(said)[0] or "image/png")
                image["bufferView"] = len(views)
                views.append({"buffer": 0, "byteOffset": add(data), "byteLength": len(data)})
        return document, binary

    @cached_property
    def roles(self) -> dict[int, str]:
        """What VRM says that bones are, such as leftUpperLeg, by their nodes; empty in other files."""
        said = self.document.get("extensions", {})
        each = [_bones(said, name) for name in ("VRM", "VRMC_vrm", "VRMC_vrm_animation")]
        return {bone["node"]: name for bones in each for name, bone in bones.items()}

    @cached_property
    def parents(self) -> dict[int, int]:
        """Each node's parent, of those that have one."""
        parents = {child: k for k, node in enumerate(self.nodes) for child in node.get("children", [])}
        if any(not 0 <= child < len(self.nodes) for child in parents):
            raise ValueError("a node has a child that is not there")
        return parents

    def above(self, node: int) -> list[int]:
        """A node's ancestors, the nearest first."""
        line: list[int] = []
        while (parent := self.parents.get(line[-1] if line else node)) is not None:
            if parent in line or parent == node:
                raise ValueError("its nodes hang in a circle")
            line.append(parent)
        return line

    def below(self, node: int) -> list[int]:
        """A node and all that hang on it, each behind its parent."""
        found = [node]
        for each in found:
            found += self.nodes[each].get("children", [])
            if len(found) > len(self.nodes):
                raise ValueError("its nodes hang in a circle")
        return found

    def name(self, node: int) -> str:
        return str(self.roles.get(node) or self.nodes[node].get("name") or f"node{node}")

    def resting(self, node: int) -> dict[str, Floats]:
        """A node's own translation (3,), rotation (4,) as x y z w, and scale (3,), where nothing moves it."""
        said = self.nodes[node]
        if "matrix" in said:
            matrix = np.array(said["matrix"], dtype=np.float64).reshape(4, 4).T
            scale = np.linalg.norm(matrix[:3, :3], axis=0)
            if np.linalg.det(matrix[:3, :3]) < 0:  # it mirrors: what is left is a rotation
                scale = -scale
            quat = to_quat(torch.from_numpy(matrix[:3, :3] / np.where(scale, scale, 1e-12))).numpy()
            return {"translation": matrix[:3, 3], "rotation": quat, "scale": scale}
        return {what: np.array(said.get(what, usual), dtype=np.float64) for what, usual in DEFAULTS.items()}

    def at_rest(self, node: int) -> Floats:
        """Where a node is in the world when nothing moves. -> (4, 4)"""
        whole = np.eye(4)
        for each in (node, *self.above(node)):
            said = self.resting(each)
            whole = matrices(*(said[what][None] for what in DEFAULTS))[0] @ whole
        return whole


def _opened(data: bytes) -> tuple[dict[str, Any], bytes]:
    """The document of a file, and the bytes that a binary one holds behind it."""
    if data.lstrip()[:1] == b"{":
        document = json.loads(data)
        if document["asset"]["version"][:2] != "2.":
            raise ValueError(f"it is glTF {document['asset']['version']}, expected 2.0")
        return document, b""
    if len(data) < 20:
        raise ValueError(f"it has {len(data)} bytes")
    magic, version, length = struct.unpack_from("<4sII", data)
    size, kind = struct.unpack_from("<I4s", data, 12)
    if magic != b"glTF" or version != 2 or kind != b"JSON":
        raise ValueError("it does not begin as glTF 2.0 does")
    if length > len(data):
        raise ValueError(f"it says that it has {length} bytes, and has {len(data)}")
    begin = 20 + size
    document = json.loads(data[20:begin])
    if len(data) <= begin:
        return document, b""
    count, kind = struct.unpack_from("<I4s", data, begin)
    return document, data[begin + 8 : begin + 8 + count] if kind == b"BIN\0" else b""


def _bones(extensions: dict[str, Any], name: str) -> dict[str, Any]:
    """The bones that an extension of VRM names; version 0 lists them."""
    bones = extensions.get(name, {}).get("humanoid", {}).get("humanBones", {})
    return {bone["bone"]: bone for bone in bones} if isinstance(bones, list) else bones


def matrices(translation: Floats, rotation: Floats, scale: Floats) -> Floats:
    """Transforms of nodes. (T or 1, 3), (T or 1, 4), (T or 1, 3) -> (T or 1, 4, 4)"""
    frames = max(len(translation), len(rotation), len(scale))
    length = np.maximum(np.linalg.norm(rotation, axis=-1, keepdims=True), 1e-12)
    whole = np.zeros((frames, 4, 4))
    whole[:, :3, :3] = from_quat(torch.from_numpy(rotation / length)).numpy() * scale[:, None]
    whole[:, :3, 3], whole[:, 3, 3] = translation, 1.0
    return whole


def sampled(keys: Floats, values: Floats, how: str, at: Floats, turns: bool) -> Floats:
    """A track's values at other times, as glTF interpolates.

    Args:
        keys: (N,) seconds, which grow.
        values: (N, C), or (3 N, C) for `CUBICSPLINE`: incoming slope, value and outgoing slope of each key.
        how: `LINEAR`, `STEP` or `CUBICSPLINE`.
        at: (T,) seconds.
        turns: they are quaternions.
    """
    spline = how == "CUBICSPLINE"
    if len(values) != len(keys) * (3 if spline else 1) or not len(keys) or (np.diff(keys) <= 0).any():
        raise ValueError("a track's keys and values do not go together")
    if spline and turns:
        values = _one_way(keys, values)
    own = values[1::3] if spline else values
    if len(keys) == 1:
        return np.repeat(own, len(at), axis=0)
    after = np.searchsorted(keys, at, side="right").clip(1, len(keys) - 1)
    before = after - 1
    span = (keys[after] - keys[before])[:, None]
    share = ((at - keys[before])[:, None] / span).clip(0.0, 1.0)
    if how == "STEP":  # times are rounded: a frame at a key must not miss it
        return np.where(share < 0.99, own[before], own[after])
    if spline:
        s, square, cube = share, share**2, share**3
        return (
            (2 * cube - 3 * square + 1) * own[before]
            + span * (cube - 2 * square + s) * values[2::3][before]
            + (3 * square - 2 * cube) * own[after]
            + span * (cube - square) * values[0::3][after]
        )
    if not turns:
        return own[before] + share * (own[after] - own[before])
    unit = torch.from_numpy(own / np.maximum(np.linalg.norm(own, axis=-1, keepdims=True), 1e-12))
    return slerp_quat(unit[before], unit[after], torch.from_numpy(share[:, 0])).numpy()


def _one_way(keys: Floats, values: Floats) -> Floats:
    """Keys and slopes of a spline of quaternions without changes of sign.

    Blender writes a key with the other sign than the one before, which is the same pose, and slopes across such a
    change: a bone would go round once between them. values (3 N, 4) -> same
    """
    way = values.reshape(-1, 3, 4).copy()
    turned = (way[1:, 1] * way[:-1, 1]).sum(axis=-1) < 0
    way[1:] *= np.where(np.cumsum(turned) % 2, -1.0, 1.0)[:, None, None]
    spans = np.diff(keys)[:, None]
    straight = np.diff(way[:, 1], axis=0) / spans
    for slopes in (way[:-1, 2], way[1:, 0]):  # views: after a key, and before the next
        far = np.linalg.norm(slopes * spans, axis=-1) > STEEPEST
        slopes[far] = straight[far]
    return way.reshape(-1, 4)
