"""People in viser's scene: meshes skinned by the browser, or rigid capsules and sticks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from magnet.body.base import Body
from magnet.export.drawing import Array, Style
from magnet.export.limbs import CAPSULES, STICKS, Limb, limbs, turn_to
from magnet.export.page.palette import Colours, for_batches
from magnet.export.page.rig import Rig, capsule, rigs
from magnet.motion.rotations import to_quat
from magnet.motion.scene import BODY_JOINTS, Scene

MANY = 8
"""Number of people above which a limb has a quarter of the triangles."""
FINE, COARSE = (14, 6), (8, 3)
"""Sectors and rings of a limb."""


Poser = Callable[[Array, Array], None]
"""Takes turns (22, 4) wxyz and places (22, 3) in metres."""


class PeopleView(Protocol):
    """The P people of a take in the browser."""

    def pose(self, turns: Array, places: Array) -> None:
        """Bones of everybody: (P, 22, 4) wxyz, (P, 22, 3) metres."""

    def paint(self, colours: Colours) -> None:
        """(P, 3)"""

    def show(self, on: bool) -> None:
        """Hide or show everybody; hidden people need no poses."""

    def remove(self) -> None:
        """Take everybody out of the scene, or hide them where the browser cannot take them out."""


def add_people(
    server: Any, name: str, body: Body, scene: Scene, style: Style, colours: Colours, opacity: float | None = None
) -> PeopleView:
    """Put the people of a scene (B = 1) into the browser's scene below the node `name`."""
    if style in ("body", "light"):
        return SkinnedPeople(server, name, rigs(body, scene.betas[0], style), colours, opacity)
    rest = body.rest_joints(scene.betas[0].float().cpu()).numpy()
    return LimbPeople(server, name, rest, CAPSULES if style == "capsules" else STICKS, colours, opacity)


class SkinnedPeople:
    """One skinned mesh per person; each frame only sends the poses of the bones."""

    def __init__(self, server: Any, name: str, people: list[Rig], colours: Colours, opacity: float | None) -> None:
        upright = np.tile([1.0, 0.0, 0.0, 0.0], (BODY_JOINTS, 1))
        self.colours = colours.copy()
        self.meshes = [
            server.scene.add_mesh_skinned(
                f"{name}/person_{p}",
                rig.skin.vertices,
                rig.skin.faces,
                bone_wxyzs=upright,
                bone_positions=rig.rest,
                skin_weights=rig.skin.dense_weights(),
                color=tuple(int(c) for c in colours[p]),
                opacity=opacity,
                cast_shadow=opacity is None,
                receive_shadow=False,
            )
            for p, rig in enumerate(people)
        ]

        self.posers = [quick_poser(mesh) or poser(mesh) for mesh in self.meshes]

    def pose(self, turns: Array, places: Array) -> None:
        for pose, own_turns, own_places in zip(self.posers, turns, places, strict=True):
            pose(own_turns, own_places)

    def paint(self, colours: Colours) -> None:
        for p in np.nonzero((colours != self.colours).any(axis=1))[0]:
            self.meshes[p].color = tuple(int(c) for c in colours[p])
        self.colours = colours.copy()

    def show(self, on: bool) -> None:
        for mesh in self.meshes:
            mesh.visible = on

    def remove(self) -> None:
        self.show(False)  # viser 1.1's browser part fails while it takes a skinned mesh apart


def poser(mesh: Any) -> Poser:
    """Poses the bones of a skinned mesh."""

    def pose(turns: Array, places: Array) -> None:
        for bone, turn, place in zip(mesh.bones, turns, places, strict=True):
            bone.wxyz, bone.position = turn, place

    return pose


def quick_poser(mesh: Any) -> Poser | None:
    """The same in an eighth of the time; None if viser is not built like version 1.1.

    Before it sends a bone's pose, viser compares it with the last one by `numpy.allclose`: for 16 people that takes
    20 ms a frame. In motion all bones differ, so here they are sent as they are.
    """
    try:
        from viser._messages import SetBoneOrientationMessage, SetBonePositionMessage

        states = [bone._impl for bone in mesh.bones]
        bones = [(state.name, state.bone_index, state.wxyz, state.position) for state in states]
        queue = mesh._impl.api._queue_scene_message
    except (ImportError, AttributeError):
        return None

    def pose(turns: Array, places: Array) -> None:
        for (name, index, wxyz, position), turn, place in zip(bones, turns.tolist(), places.tolist(), strict=True):
            wxyz[:], position[:] = turn, place
            queue(SetBoneOrientationMessage(name, index, tuple(turn)))
            queue(SetBonePositionMessage(name, index, tuple(place)))

    return pose


class LimbPeople:
    """The same limb of all people as one batch of tapered capsules: two messages for each limb and frame."""

    def __init__(
        self, server: Any, name: str, rest: Array, table: tuple[Limb, ...], colours: Colours, opacity: float | None
    ) -> None:
        self.table = table
        start, end, radii = limbs(rest, table)
        length = np.linalg.norm(end - start, axis=-1)  # (P, M)
        turns, places = stand(start, end)
        self.colours = colours.copy()
        self.root = server.scene.add_frame(name, show_axes=False)
        self.batches = []
        sectors, rings = COARSE if len(rest) > MANY else FINE
        for m in range(len(table)):
            size, thick = length[:, m].mean(), radii[:, m].mean(axis=0)
            vertices, faces, _ = capsule(float(size), float(thick[0]), float(thick[1]), sectors, rings)
            wide = radii[:, m, 0] / thick[0]
            scales = np.stack([wide, wide, length[:, m] / size], axis=1).astype(np.float32)
            self.batches.append(
                server.scene.add_batched_meshes_simple(
                    f"{name}/limb_{m}",
                    vertices,
                    faces,
                    turns[:, m],
                    places[:, m],
                    batched_scales=scales,
                    batched_colors=for_batches(colours),
                    opacity=opacity,
                    lod="off",
                    cast_shadow=opacity is None,
                    receive_shadow=False,
                )
            )

    def pose(self, turns: Array, places: Array) -> None:
        start, end, _ = limbs(places, self.table)
        wxyz, at = stand(start, end)
        for m, batch in enumerate(self.batches):
            batch.batched_wxyzs, batch.batched_positions = wxyz[:, m], at[:, m]

    def paint(self, colours: Colours) -> None:
        if (colours != self.colours).any():
            for batch in self.batches:
                batch.batched_colors = for_batches(colours)
        self.colours = colours.copy()

    def show(self, on: bool) -> None:
        self.root.visible = on

    def remove(self) -> None:
        self.root.remove()  # and the batches below it


def stand(start: Array, end: Array) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Turn and place that take a capsule along +z to each limb. (P, M, 3) x 2 -> (P, M, 4) wxyz, (P, M, 3)"""
    R = torch.from_numpy(turn_to(np.asarray(end - start, dtype=np.float64)))
    turns = to_quat(R)[..., [3, 0, 1, 2]].float().numpy()
    return np.ascontiguousarray(turns), np.ascontiguousarray(start, dtype=np.float32)
