"""Made-up GLB files of somebody's own: two people of Mixamo's names in each, in armatures of centimetres, z up."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import roma
import torch

from magnet.body.joints import PARENTS
from magnet.datamodules.fakes.body import write_body
from magnet.datamodules.fakes.motion import UP, Array, FakeMotion, local_rotations, people, rest_joints, world_rotations
from magnet.export.bones import bone_names
from magnet.export.glb import FLOAT, Gltf, animation, unbroken
from magnet.motion.rotations import to_quat
from magnet.motion.scene import FPS

RATE = 60.0
METRE = 0.01
"""Of an armature's unit of length."""
R_WORLD_ARMATURE = UP["+z"].T
OWN = roma.rotvec_to_rotmat(torch.from_numpy(np.random.default_rng(0).normal(size=(len(PARENTS), 3)))).numpy()
"""(22, 3, 3) Rotations of bones at rest, which are anything: every program has its own."""


def scenes(takes: int, frames: int, seed: int) -> dict[str, FakeMotion]:
    """What is written, by take."""
    long = round(frames * RATE / FPS)
    return {f"walk{number + 1}": people(long, 2, RATE, seed + number) for number in range(takes)}


def write_scenes(out: Path, scenes: Mapping[str, FakeMotion]) -> None:
    """Any motions by take, everybody in one file, and body.npz, which nobody needs."""
    write_body(out / "body.npz")
    for name, shown in scenes.items():
        write_file(out / f"{name}.glb", shown)


def write_file(path: Path, shown: FakeMotion) -> None:
    """The people of a motion, called dancer1, dancer2 ... after their armatures."""
    gltf = Gltf()
    times = gltf.accessor(np.arange(shown.frames) / shown.fps, FLOAT, "SCALAR", bounds=True)
    for person in range(shown.poses.shape[1]):
        _person(gltf, times, shown, person)
    path.write_bytes(gltf.packed())


def _person(gltf: Gltf, times: int, shown: FakeMotion, person: int) -> None:
    """An armature, its bones, their skin and an animation."""
    R_armature_rest = R_WORLD_ARMATURE.T @ UP[shown.up]  # rest poses stand in the file's world, too
    rest = rest_joints(shown.betas, shown.kind)[person] @ R_armature_rest.T / METRE
    place = shown.positions[:, person, 0] @ R_WORLD_ARMATURE / METRE
    bones = R_WORLD_ARMATURE.T @ world_rotations(shown.poses[:, person]) @ R_armature_rest.T @ OWN
    local, resting, away = local_rotations(bones, PARENTS), local_rotations(OWN[None], PARENTS)[0], rest.copy()
    for k, parent in enumerate(PARENTS):
        if parent >= 0:
            away[k] = OWN[parent].T @ (rest[k] - rest[parent])
    label, nodes = f"dancer{person + 1}", gltf.document["nodes"]
    armature = {"name": label, "rotation": _quat(R_WORLD_ARMATURE), "scale": [METRE] * 3}
    first = 1 + gltf.add("nodes", armature | {"children": [len(nodes) + 1]})
    gltf.document["scenes"][0]["nodes"].append(first - 1)
    for k, name in enumerate(bone_names("mixamo")):
        children = [first + child for child, parent in enumerate(PARENTS) if parent == k]
        node = {"name": name, "translation": away[k].tolist(), "rotation": _quat(resting[k])}
        gltf.add("nodes", node | ({"children": children} if children else {}))
    bind = np.tile(np.eye(4), (len(PARENTS), 1, 1))  # column-major: the translation is the last row
    bind[:, :3, :3], bind[:, 3, :3] = OWN, -np.einsum("ki,kij->kj", rest, OWN)
    matrices = gltf.accessor(bind.reshape(-1, 16), FLOAT, "MAT4")
    joints = [first + k for k in range(len(PARENTS))]
    gltf.add("skins", {"name": label, "joints": joints, "inverseBindMatrices": matrices})
    clip = animation(f"{label} walks")
    turns = unbroken(to_quat(torch.from_numpy(local)))
    gltf.animate(clip, times, joints, torch.from_numpy(place)[:, None], turns)
    gltf.add("animations", clip)


def _quat(R: Array) -> list[float]:
    return to_quat(torch.from_numpy(R)).tolist()
