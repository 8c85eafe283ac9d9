"""Made-up BVH files of somebody's own: another naming, centimetres, z up, 120 fps; NAME_A.bvh and NAME_B.bvh."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import roma
import torch

from magnet.body.joints import JOINT_NAMES, PARENTS
from magnet.datamodules.fakes.body import write_body
from magnet.datamodules.fakes.motion import (
    UP,
    FakeMotion,
    local_rotations,
    people,
    rest_joints,
    turned,
    world_rotations,
)
from magnet.datamodules.reading.recording import Axis
from magnet.export.bvh import bvh_text, depth_first
from magnet.motion.scene import FPS

RATE = 120.0
AXIS: Axis = "+z"
CENTIMETRES = 100.0
BONES = {
    "hip": "thigh", "knee": "calf", "ankle": "foot", "foot": "ball", "collar": "clavicle", "shoulder": "upperarm",
    "elbow": "lowerarm", "wrist": "hand",
}  # fmt: skip
SPINE = {"spine1": "spine_01", "spine2": "spine_02", "spine3": "spine_03", "neck": "neck_01"}


def named(joint: str) -> str:
    """Their name of one of our joints: left_hip is thigh_l."""
    side, _, bone = joint.partition("_")
    return f"{BONES[bone]}_{side[0]}" if bone else SPINE.get(joint, joint)


def scenes(takes: int, frames: int, seed: int) -> dict[str, FakeMotion]:
    """What is written, by take."""
    long = round(frames * RATE / FPS)
    return {f"walk{number + 1}": turned(people(long, 2, RATE, seed + number), AXIS) for number in range(takes)}


def write_scenes(out: Path, scenes: Mapping[str, FakeMotion]) -> None:
    """Any motions by take, and body.npz, which nobody needs."""
    write_body(out / "body.npz")
    for name, shown in scenes.items():
        for person in range(shown.poses.shape[1]):
            (out / f"{name}_{chr(ord('A') + person)}.bvh").write_text(_file(shown, person), encoding="utf-8")


def _file(shown: FakeMotion, person: int) -> str:
    N = UP[shown.up]  # rest poses stand in the file's world, too
    rest = CENTIMETRES * rest_joints(shown.betas, shown.kind)[person] @ N.T
    world = world_rotations(shown.poses[:, person]) @ N.T
    turns = torch.from_numpy(local_rotations(world, PARENTS)[:, depth_first(PARENTS)])
    degrees = roma.rotmat_to_euler("ZYX", turns, degrees=True).numpy().reshape(shown.frames, -1)
    numbers = np.concatenate([CENTIMETRES * shown.positions[:, person, 0], degrees], axis=1)
    rows = [" ".join(f"{x:.6f}" for x in row) for row in numbers.tolist()]
    tips = {joint: np.array([0.0, 0.0, 5.0]) for joint in range(len(rest)) if joint not in PARENTS}
    names = [named(joint) for joint in JOINT_NAMES]
    return bvh_text(names, PARENTS, rest - rest[[0, *PARENTS[1:]]], tips, "ZYX", rows, shown.fps)
