"""CMU's files read in a slow second way."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation


def slow_ends(asf: Path, amc: Path, frame: int) -> dict[str, NDArray[np.float64]]:
    """Bone ends of one frame in metres, by matrices and scipy, from the files' text alone."""
    skeleton = asf.read_text(encoding="utf-8").replace("\r", "")
    bone_text = {
        block.split("name ")[1].split()[0]: block
        for block in skeleton.split(":bonedata")[1].split(":hierarchy")[0].split("begin")[1:]
    }
    tree = {}
    for line in skeleton.split(":hierarchy")[1].splitlines():
        words = line.split()
        tree.update({child: words[0] for child in words[1:]} if words and words[0] not in ("begin", "end") else {})
    wanted = amc.read_text(encoding="utf-8").replace("\r", "").split(f"\n{frame + 1}\n")[1].splitlines()
    angles = {}
    for line in wanted:
        if line.strip().isdigit():
            break
        if line.strip():
            angles[line.split()[0]] = list(map(float, line.split()[1:]))
    scale = 0.0254 / 0.45
    T = {"root": np.eye(4)}
    T["root"][:3, :3] = Rotation.from_euler("xyz", angles["root"][3:], degrees=True).as_matrix()
    T["root"][:3, 3] = np.multiply(angles["root"][:3], scale)

    def transform(name: str) -> NDArray[np.float64]:
        """World frame of a bone, at its end."""
        if name not in T:
            text = bone_text[name].splitlines()
            field = {line.split()[0]: line.split()[1:] for line in text if line.split()}
            C = Rotation.from_euler("xyz", [float(v) for v in field["axis"][:3]], degrees=True)
            turn = dict(zip(field.get("dof", []), angles.get(name, []), strict=True))
            E = Rotation.from_euler("xyz", [turn.get(k, 0.0) for k in ("rx", "ry", "rz")], degrees=True)
            local, along = np.eye(4), np.eye(4)
            local[:3, :3] = (C * E * C.inv()).as_matrix()
            along[:3, 3] = np.array([float(v) for v in field["direction"]]) * float(field["length"][0]) * scale
            T[name] = transform(tree[name]) @ local @ along
        return T[name]

    return {name: transform(name)[:3, 3] for name in tree}
