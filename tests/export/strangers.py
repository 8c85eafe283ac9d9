"""BVH files of skeletons that are not ours: other names, rest poses, proportions, axes and units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]

SIDES = ("left", "right")
BONES = ("hip", "knee", "ankle", "foot", "collar", "shoulder", "elbow", "wrist")


def _named(pelvis: str, spine: Sequence[str], neck: str, head: str, limb: str, words: Sequence[str]) -> dict[str, str]:
    """Our name: theirs. `limb` is a pattern of {side} and {word}; sides as the pattern spells them."""
    left, right = ("Left", "Right") if "{Side}" in limb else ("L", "R") if "{S}" in limb else ("l", "r")
    pattern = limb.replace("{Side}", "{side}").replace("{S}", "{side}").replace("{s}", "{side}")
    names = {"pelvis": pelvis, "spine1": spine[0], "spine2": spine[1], "spine3": spine[2], "neck": neck, "head": head}
    for ours, side in zip(SIDES, (left, right), strict=True):
        names |= {f"{ours}_{b}": pattern.format(side=side, word=w) for b, w in zip(BONES, words, strict=True)}
    return names


NAMINGS: dict[str, dict[str, str]] = {
    "mixamo": _named("mixamorig:Hips", ["mixamorig:Spine", "mixamorig:Spine1", "mixamorig:Spine2"], "mixamorig:Neck",
                     "mixamorig:Head", "mixamorig:{Side}{word}",
                     ["UpLeg", "Leg", "Foot", "ToeBase", "Shoulder", "Arm", "ForeArm", "Hand"]),
    "cmu": _named("Hips", ["LowerBack", "Spine", "Spine1"], "Neck", "Head", "{Side}{word}",
                  ["UpLeg", "Leg", "Foot", "ToeBase", "Shoulder", "Arm", "ForeArm", "Hand"]),
    "biped": _named("Bip01 Pelvis", ["Bip01 Spine", "Bip01 Spine1", "Bip01 Spine2"], "Bip01 Neck", "Bip01 Head",
                    "Bip01 {S} {word}",
                    ["Thigh", "Calf", "Foot", "Toe0", "Clavicle", "UpperArm", "Forearm", "Hand"]),
    "unreal": _named("pelvis", ["spine_01", "spine_02", "spine_03"], "neck_01", "head", "{word}_{s}",
                     ["thigh", "calf", "foot", "ball", "clavicle", "upperarm", "lowerarm", "hand"]),
    "biovision": _named("Hips", ["Chest", "Chest2", "Chest3"], "Neck", "Head", "{Side}{word}",
                        ["Hip", "Knee", "Ankle", "Toe", "Collar", "Shoulder", "Elbow", "Wrist"]),
    "motive": _named("Hip", ["Ab", "Ab2", "Chest"], "Neck", "Head", "{S}{word}",
                     ["Thigh", "Shin", "Foot", "Toe", "Shoulder", "UArm", "FArm", "Hand"]),
    "smpl": _named("Pelvis", ["Spine1", "Spine2", "Spine3"], "Neck", "Head", "{S}_{word}",
                   ["Hip", "Knee", "Ankle", "Foot", "Collar", "Shoulder", "Elbow", "Wrist"]),
    "rigify": _named("DEF-spine", ["DEF-spine.001", "DEF-spine.002", "DEF-spine.003"], "DEF-spine.004",
                     "DEF-spine.006", "DEF-{word}.{S}",
                     ["thigh", "shin", "foot", "toe", "shoulder", "upper_arm", "forearm", "hand"]),
}  # fmt: skip


def write(
    path: Path,
    names: Sequence[str],
    parents: Sequence[int],
    offsets: Floats,
    root: Floats,
    local: Floats,
    fps: float,
    order: str = "ZYX",
    positions_everywhere: bool = False,
) -> Path:
    """A BVH file by scipy's Euler angles, in depth-first order. offsets (K, 3), root (T, 3), local (T, K, 3, 3)"""
    lines, depth_first = ["HIERARCHY"], []
    axes = " ".join(f"{letter}rotation" for letter in order)
    place = "Xposition Yposition Zposition"

    def joint(k: int, pad: str) -> None:
        depth_first.append(k)
        with_place = positions_everywhere or parents[k] < 0
        lines.extend([f"{pad}{'ROOT' if parents[k] < 0 else 'JOINT'} {names[k]}", pad + "{"])
        lines.append(f"{pad}  OFFSET {' '.join(f'{v:.6f}' for v in offsets[k])}")
        lines.append(f"{pad}  CHANNELS {f'6 {place} {axes}' if with_place else f'3 {axes}'}")
        children = [c for c, parent in enumerate(parents) if parent == k]
        for child in children:
            joint(child, pad + "  ")
        if not children:
            lines.extend([f"{pad}  End Site", pad + "  {", f"{pad}    OFFSET 0.0 1.0 0.0", pad + "  }"])
        lines.append(pad + "}")

    joint(list(parents).index(-1), "")
    T, K = local.shape[:2]
    angles = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_euler(order, degrees=True).reshape(T, K, 3)
    lines.extend(["MOTION", f"Frames: {T}", f"Frame Time: {1 / fps:.6f}"])
    for t in range(T):
        row: list[float] = []
        for k in depth_first:
            if parents[k] < 0:
                row.extend(root[t])
            elif positions_everywhere:
                row.extend(offsets[k])
            row.extend(angles[t, k])
        lines.append(" ".join(f"{v:.5f}" for v in row))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def rerigged(
    path: Path,
    naming: Mapping[str, str],
    joint_names: Sequence[str],
    parents: Sequence[int],
    world: Floats,
    rest_world: Floats,
    rest_at: Floats,
    root: Floats,
    fps: float,
    metres: float = 1.0,
    up: Floats | None = None,
    drop: Sequence[str] = (),
    **style: object,
) -> Path:
    """Known motion on a skeleton whose zero pose is another pose of the same person.

    Args:
        world: (T, 22, 3, 3) world rotations of the motion, from our rest pose.
        rest_world: (22, 3, 3) world rotations of the file's zero pose.
        rest_at: (22, 3) its joints, which also say how long bones are.
        root: (T, 3) pelvis.
        metres: a unit of the file.
        up: (3, 3) rotation from our world to the file's.
        drop: our names of joints that the file lacks; must be leaves.
    """
    N = np.eye(3) if up is None else up
    turned = N @ (world @ np.swapaxes(rest_world, -1, -2)) @ N.T
    keep = [j for j, name in enumerate(joint_names) if name not in drop]
    local = turned.copy()
    for j in range(1, len(parents)):
        local[:, j] = np.swapaxes(turned[:, parents[j]], -1, -2) @ turned[:, j]
    offsets = np.array([rest_at[j] - rest_at[parents[j]] if j else np.zeros(3) for j in range(len(parents))])
    return write(
        path,
        [naming[joint_names[j]] for j in keep],
        [keep.index(parents[j]) if parents[j] >= 0 else -1 for j in keep],
        (offsets @ N.T / metres)[keep],
        root @ N.T / metres,
        local[:, keep],
        fps,
        **style,  # type: ignore[arg-type]
    )
