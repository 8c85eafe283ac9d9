"""Scenes as BVH files, one per person, for Blender, MotionBuilder and other tools that read skeletons."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from magnet.body import Body
from magnet.body.joints import HEAD, L_FOOT, L_WRIST, PARENTS, R_FOOT, R_WRIST
from magnet.export.bones import Names, bone_names
from magnet.files import suffixed, write_text
from magnet.motion.required import require_body, require_one
from magnet.motion.scene import Scene

Unit = Literal["m", "cm"]
PER_METRE: dict[str, float] = {"m": 1.0, "cm": 100.0}
ROTATIONS = "ZXY"
"""Channels of every joint: degrees, R = Rz Rx Ry, the order most tools write."""

TIPS: dict[int, tuple[float, float, float]] = {
    L_FOOT: (0.0, 0.0, 0.07), R_FOOT: (0.0, 0.0, 0.07), HEAD: (0.0, 0.18, 0.02),
    L_WRIST: (0.17, 0.0, 0.0), R_WRIST: (-0.17, 0.0, 0.0),
}  # fmt: skip
"""Metres from a leaf joint to its End Site, which only sets the drawn length of the last bone."""


def save_bvh(scene: Scene, path: str | Path, body: Body, *, unit: Unit = "m", names: Names = "smplx") -> list[Path]:
    """Write one scene (B = 1), a file a person: out_person0.bvh, out_person1.bvh ... by slot; the path itself for one.

    All people keep their places in the scene's world, y up. The root's position is the pelvis joint in the world, its
    OFFSET is zero; rotations are Zrotation Xrotation Yrotation in degrees.

    Args:
        unit: unit of lengths, which the format does not state. Blender expects metres, MotionBuilder centimetres.
        names: of joints: SMPL-X's, those of VRM's humanoid, or Mixamo's.

    Returns:
        The paths written, in the order of the slots.

    Raises:
        ValueError: more than one scene, nobody present, another body's, or no such unit or names.

    >>> import tempfile
    >>> from magnet.body import load_body
    >>> from magnet.motion.scene import empty_scene
    >>> scene = empty_scene(1, 30, 2, like=torch.zeros(()))
    >>> scene = scene.replace(present=~scene.present)  # two people, in the rest pose
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     [path.name for path in save_bvh(scene, Path(folder) / "rest.bvh", load_body())]
    ['rest_person0.bvh', 'rest_person1.bvh']
    """
    require_one(scene)
    require_body(scene, body.id)
    if unit not in PER_METRE:
        raise ValueError(f"unit {unit!r}: expected one of {', '.join(PER_METRE)}")
    people = scene.people()
    if not people.scenes:
        raise ValueError("nobody is present in the scene, so there is no skeleton to write")
    written = []
    paths = paths_of(suffixed(path, ".bvh"), scene.present[0].nonzero()[:, 0].tolist())
    for p, each in enumerate(paths):
        offsets = offsets_of(body.rest_joints(people.betas[p, 0].detach().cpu().double())).numpy() * PER_METRE[unit]
        root = people.T_world_root[p, :, 0].detach().cpu().double()
        local = torch.cat([root[:, None, :3, :3], people.body_rot[p, :, 0].detach().cpu().double()], dim=1)
        position = root[:, :3, 3].numpy() * PER_METRE[unit]
        degrees = euler_zxy(local.numpy())[:, depth_first(PARENTS)]
        rows = [
            f"{_numbers(place)} {' '.join(f'{angle:.6f}' for angle in angles.ravel())}"
            for place, angles in zip(position, degrees, strict=True)
        ]
        tips = {joint: PER_METRE[unit] * np.array(tip) for joint, tip in TIPS.items()}
        text = bvh_text(bone_names(names), PARENTS, offsets, tips, ROTATIONS, rows, scene.fps)
        written.append(write_text(each, text))
    return written


def paths_of(path: Path, slots: Sequence[int]) -> list[Path]:
    """The files of people in these slots: out_person0.bvh, out_person1.bvh ..., or the path itself for one person."""
    return [path] if len(slots) == 1 else [person_file(path, slot) for slot in slots]


def person_file(path: Path, slot: int) -> Path:
    """The file of one of several people. By such names they are read as one scene's, by numbers alone not.

    >>> person_file(Path("out.npz"), 2).name
    'out_person2.npz'
    """
    return path.with_name(f"{path.stem}_person{slot}{path.suffix}")


def offsets_of(rest: Tensor) -> Tensor:
    """Joints relative to their parents at rest, the pelvis's zero. (..., 22, 3) -> same"""
    return rest - rest[..., [0, *PARENTS[1:]], :]


def bvh_text(
    names: Sequence[str],
    parents: Sequence[int],
    offsets: NDArray[np.float64],
    tips: Mapping[int, NDArray[np.float64]],
    rotations: str,
    rows: Sequence[str],
    fps: float,
) -> str:
    """A BVH file.

    Args:
        names: of K joints.
        parents: of each joint; the root comes first, and has -1.
        offsets: (K, 3) in the file's unit.
        tips: (3,) offsets of End Sites, by joint.
        rotations: axes that every joint turns about, such as ZXY.
        rows: the numbers of each frame, the root's place and then angles of joints in the order of `depth_first`.
        fps: frames a second.
    """
    channels = " ".join(f"{axis}rotation" for axis in rotations)

    def joint(j: int, depth: int) -> Iterator[str]:
        pad = "\t" * depth
        yield f"{pad}{'JOINT' if depth else 'ROOT'} {names[j]}"
        yield pad + "{"
        yield f"{pad}\tOFFSET {_numbers(offsets[j])}"
        yield f"{pad}\tCHANNELS {f'3 {channels}' if depth else f'6 Xposition Yposition Zposition {channels}'}"
        for child in (c for c, parent in enumerate(parents) if parent == j):
            yield from joint(child, depth + 1)
        if j in tips:
            yield from (f"{pad}\tEnd Site", pad + "\t{", f"{pad}\t\tOFFSET {_numbers(tips[j])}", pad + "\t}")
        yield pad + "}"

    motion = ["MOTION", f"Frames: {len(rows)}", f"Frame Time: {1 / fps:.10f}", *rows]
    return "\n".join(["HIERARCHY", *joint(0, 0), *motion]) + "\n"


def depth_first(parents: Sequence[int]) -> list[int]:
    """Joints in the order of a file."""

    def below(j: int) -> Iterator[int]:
        yield j
        for child in (c for c, parent in enumerate(parents) if parent == j):
            yield from below(child)

    return list(below(0))


def euler_zxy(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Degrees about z, x and y with R = Rz Rx Ry, free of jumps over time. (T, ..., 3, 3) -> (T, ..., 3)"""
    x = np.arcsin(np.clip(rotation[..., 2, 1], -1.0, 1.0))
    z = np.arctan2(-rotation[..., 0, 1], rotation[..., 1, 1])
    y = np.arctan2(-rotation[..., 2, 0], rotation[..., 2, 2])
    # Where x is a quarter turn only the sum or difference of the others is known: z is left at zero.
    locked = np.hypot(rotation[..., 0, 1], rotation[..., 1, 1]) < 1e-9
    z = np.where(locked, 0.0, z)
    y = np.where(locked, np.arctan2(rotation[..., 0, 2], rotation[..., 0, 0]), y)
    return np.degrees(np.unwrap(np.stack([z, x, y], axis=-1), axis=0))


def _numbers(vector: NDArray[np.float64]) -> str:
    return " ".join(f"{value:.7f}" for value in vector)
