"""Made-up BVH files of somebody's own: another naming, centimetres, z up, 120 fps; NAME_A.bvh and NAME_B.bvh."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import roma
import torch

from magnet.body.joints import JOINT_NAMES, PARENTS
from magnet.datamodules.fakes.body import write_body
from magnet.datamodules.fakes.duobox import world_rotations
from magnet.datamodules.fakes.motion import UP, FakeMotion, people, rest_joints, turned
from magnet.datamodules.reading.recording import Axis
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
            (out / f"{name}_{chr(ord('A') + person)}.bvh").write_text(_file(shown, person))


def _file(shown: FakeMotion, person: int) -> str:
    N = UP[shown.up]  # rest poses stand in the file's world, too
    rest = CENTIMETRES * rest_joints(shown.betas, shown.kind)[person] @ N.T
    world = world_rotations(shown.poses[:, person]) @ N.T
    local = world.copy()
    local[:, 1:] = np.swapaxes(world[:, list(PARENTS[1:])], -1, -2) @ world[:, 1:]
    order = list(_depth_first(0))
    degrees = roma.rotmat_to_euler("ZYX", torch.from_numpy(local[:, order]), degrees=True).numpy()
    columns = [CENTIMETRES * shown.positions[:, person, 0], degrees.reshape(shown.frames, -1)]
    rows = [" ".join(f"{x:.6f}" for x in row) for row in np.concatenate(columns, axis=1)]
    head = ["HIERARCHY", *_hierarchy(0, rest, 0), "MOTION", f"Frames: {len(rows)}", f"Frame Time: {1 / shown.fps:.7f}"]
    return "\n".join([*head, *rows]) + "\n"


def _children(joint: int) -> Sequence[int]:
    return [child for child, parent in enumerate(PARENTS) if parent == joint]


def _depth_first(joint: int) -> Iterator[int]:
    yield joint
    for child in _children(joint):
        yield from _depth_first(child)


def _hierarchy(joint: int, rest: np.ndarray, depth: int) -> Iterator[str]:
    pad = "  " * depth
    offset = rest[joint] - rest[PARENTS[joint]] if depth else np.zeros(3)
    place = "Xposition Yposition Zposition " if not depth else ""
    yield f"{pad}{'JOINT' if depth else 'ROOT'} {named(JOINT_NAMES[joint])}"
    yield f"{pad}{{"
    yield f"{pad}  OFFSET " + " ".join(f"{x:.6f}" for x in offset)
    yield f"{pad}  CHANNELS {3 if depth else 6} {place}Zrotation Yrotation Xrotation"
    for child in _children(joint):
        yield from _hierarchy(child, rest, depth + 1)
    if not _children(joint):
        yield from (f"{pad}  End Site", f"{pad}  {{", f"{pad}    OFFSET 0.0 0.0 5.0", f"{pad}  }}")
    yield f"{pad}}}"
