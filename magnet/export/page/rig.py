"""People as skinned meshes: a mesh at rest, and for each frame the poses of 22 bones that a browser bends it by.

A bone stands at its joint. At rest it is not turned, so a vertex x that follows bone j alone goes to
R_j (x - rest_j) + t_j, and one that follows several to the mean of these places by its weights.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from magnet.body.base import Body
from magnet.body.joints import PARENTS
from magnet.export.drawing import Array, Style
from magnet.export.limbs import (
    CAPSULES,
    CROWN,
    L_HAND,
    L_HEEL,
    L_TOE,
    R_HAND,
    R_HEEL,
    R_TOE,
    STICKS,
    Limb,
    limbs,
    turn_to,
)
from magnet.export.page.light import light
from magnet.motion.rotations import from_quat, to_quat
from magnet.motion.scene import BODY_JOINTS, Scene

Index = NDArray[np.integer]

CROWD = 8
"""People in all above whom light bodies are the first choice."""
INFLUENCES = 4
"""Bones that a vertex can follow in a browser."""

FOLLOWS = {CROWN: 15, L_HAND: 20, R_HAND: 21, L_TOE: 10, R_TOE: 11, L_HEEL: 7, R_HEEL: 8}
"""The bone that each end of the body which is no joint belongs to."""


@dataclass(frozen=True)
class Skin:
    """One person's mesh at rest and which bones its vertices follow."""

    vertices: Array  # (V, 3) metres
    faces: Index  # (F, 3)
    bones: Index  # (V, 4)
    weights: Array  # (V, 4), rows sum to one

    def dense_weights(self) -> Array:
        """(V, 22)"""
        dense = np.zeros((len(self.vertices), BODY_JOINTS), dtype=np.float32)
        np.add.at(dense, (np.arange(len(self.vertices))[:, None], self.bones), self.weights)
        return dense


@dataclass(frozen=True)
class Rig:
    """One person: where the bones rest, and a mesh for each style."""

    rest: Array  # (22, 3) metres
    skin: Skin


def rigs(body: Body, betas: Tensor, style: Style = "body") -> list[Rig]:
    """A rig for each of P people of the shapes betas (P, 10)."""
    betas = betas.float().cpu()
    rest = body.rest_joints(betas).numpy().astype(np.float32)
    if style not in ("body", "light"):
        table = CAPSULES if style == "capsules" else STICKS
        return [Rig(joints, limb_skin(joints, table)) for joints in rest]
    shape = body.v_template[None] + torch.einsum("vck,pk->pvc", body.shapedirs, betas.to(body.shapedirs))
    bones, weights = strongest(body.weights)
    faces = body.faces.cpu().numpy()
    points = shape.cpu().numpy().astype(np.float32)
    if style == "light":
        few = light(body)
        points, bones, weights, faces = points[:, few.keep], bones[few.keep], weights[few.keep], few.faces
    return [
        Rig(joints, Skin(vertices, faces.astype(np.uint32), bones, weights))
        for joints, vertices in zip(rest, points, strict=True)
    ]


def strongest(weights: Tensor) -> tuple[Index, Array]:
    """The four bones that move each vertex most, their weights made to sum to one. (V, 22) -> (V, 4) int, (V, 4)"""
    top = weights.float().cpu().topk(INFLUENCES, dim=1)
    share = top.values / top.values.sum(dim=1, keepdim=True).clamp_min(1e-9)
    return top.indices.numpy().astype(np.uint8), share.numpy()


def first_style(people: int) -> Style:
    """What people are shown as when nobody says: whole bodies, or light ones of a crowd."""
    return "light" if people > CROWD else "body"


# -- poses -------------------------------------------------------------------------------------


def bone_poses(body: Body, scene: Scene) -> tuple[Array, Array]:
    """How the bones stand in the world in every frame of a scene (B = 1).

    -> turns (T, P, 22, 4) as unit quaternions w x y z, places (T, P, 22, 3) metres; float32
    """
    with torch.no_grad():
        places = body.joints(scene)[0]
        rest = body.rest_joints(scene.betas[:, None])
        turns = body.bone_chain(scene.body_rot, scene.T_world_root, rest)[0][0]
        turns = to_quat(turns)[..., [3, 0, 1, 2]]
    return turns.float().cpu().numpy(), places.float().cpu().numpy()


def bend(rig: Rig, turns: Array, places: Array) -> Array:
    """The mesh as a browser draws it. turns (22, 4), places (22, 3) -> (V, 3)"""
    R = from_quat(torch.from_numpy(turns[:, [1, 2, 3, 0]]).double()).numpy()
    shift = places - np.einsum("jab,jb->ja", R, rig.rest)
    bones, weights = rig.skin.bones, rig.skin.weights[..., None]
    return (weights * (np.einsum("vkab,vb->vka", R[bones], rig.skin.vertices) + shift[bones])).sum(axis=1)


# -- light meshes ------------------------------------------------------------------------------


def limb_skin(rest: Array, table: tuple[Limb, ...]) -> Skin:
    """A mannequin of tapered capsules in the rest pose, bent like a body. rest (22, 3)"""
    start, end, radii = (x[0] for x in limbs(rest[None], table))
    pieces, bones, faces, count = [], [], [], 0
    for limb, a, b, r in zip(table, start, end, radii, strict=True):
        points, quads, far = capsule(float(np.linalg.norm(b - a)), float(r[0]), float(r[1]))
        pieces.append(points @ turn_to(b - a).T + a)
        # The second end must not turn with what hangs on it.
        end = max(PARENTS[limb[1]], 0) if limb[1] < BODY_JOINTS else 0
        first, last = FOLLOWS.get(limb[0], limb[0]), FOLLOWS.get(limb[1], end)
        bones.append(np.where(far, last, first))
        faces.append(quads + count)
        count += len(points)
    own = np.concatenate(bones)[:, None]
    nobody = np.zeros((count, INFLUENCES - 1))
    return Skin(
        np.concatenate(pieces).astype(np.float32),
        np.concatenate(faces).astype(np.uint32),
        np.concatenate([own, nobody], axis=1).astype(np.uint8),
        np.concatenate([np.ones((count, 1)), nobody], axis=1).astype(np.float32),
    )


def capsule(length: float, near: float, far: float, sectors: int = 14, rings: int = 6) -> tuple[Array, Index, Index]:
    """A tapered capsule along +z from the origin: points (V, 3), faces (F, 3), which points are its far half (V,)"""
    latitude = np.concatenate([np.linspace(-np.pi / 2, 0, rings), np.linspace(0, np.pi / 2, rings)])
    half = np.repeat([False, True], rings)
    radius = np.where(half, far, near)
    longitude = np.arange(sectors) * (2 * np.pi / sectors)
    ring = (radius * np.cos(latitude))[:, None]
    height = np.broadcast_to((radius * np.sin(latitude) + np.where(half, length, 0.0))[:, None], (2 * rings, sectors))
    points = np.stack([ring * np.cos(longitude), ring * np.sin(longitude), height], axis=-1).reshape(-1, 3)
    i, k = (x.ravel() for x in np.meshgrid(np.arange(2 * rings - 1), np.arange(sectors), indexing="ij"))
    here, after, up = i * sectors + k, i * sectors + (k + 1) % sectors, sectors
    quads = [np.stack([here, after, after + up], axis=1), np.stack([here, after + up, here + up], axis=1)]
    return points, np.concatenate(quads), np.repeat(half, sectors)
