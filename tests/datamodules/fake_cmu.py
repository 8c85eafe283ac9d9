"""Writes tiny recordings in CMU's on-disk format, of a made-up person, and reads them in a slow second way."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

# Axes of the left side's bones; {s} and {m} become the signs of the side and of the other.
LEG, FOOT, ARM, HAND, THUMB = "0 0 {s}20", "-90 0 {s}20", "-180 {m}30 {m}90", "0 {s}90 {s}90", "-90 {s}45 0"
SIDE = (
    # name, parent, direction of the left one, length, axis, degrees of freedom
    ("hipjoint", "root", (0.6, -0.75, 0.25), 2.1, "0 0 0", ""),
    ("femur", "hipjoint", (0.342, -0.94, 0.0), 6.8, LEG, "rx ry rz"),
    ("tibia", "femur", (0.342, -0.94, 0.0), 7.2, LEG, "rx"),
    ("foot", "tibia", (0.12, -0.33, 0.93), 2.3, FOOT, "rx rz"),
    ("toes", "foot", (0.0, 0.0, 1.0), 1.0, FOOT, "rx"),
    ("clavicle", "thorax", (0.96, 0.18, 0.2), 3.6, "0 0 0", "ry rz"),
    ("humerus", "clavicle", (1.0, 0.0, 0.0), 4.7, ARM, "rx ry rz"),
    ("radius", "humerus", (1.0, 0.0, 0.0), 3.6, ARM, "rx"),
    ("wrist", "radius", (1.0, 0.0, 0.0), 1.7, HAND, "ry"),
    ("hand", "wrist", (1.0, 0.0, 0.0), 0.7, HAND, "rx rz"),
    ("fingers", "hand", (1.0, 0.0, 0.0), 0.6, HAND, "rx"),
    ("thumb", "wrist", (0.7, 0.0, 0.7), 0.8, THUMB, "rx rz"),
)
MIDDLE = (
    ("lowerback", "root", 2.0),
    ("upperback", "lowerback", 2.0),
    ("thorax", "upperback", 2.0),
    ("lowerneck", "thorax", 1.6),
    ("upperneck", "lowerneck", 1.6),
    ("head", "upperneck", 1.6),
)


def bones() -> list[tuple[str, str, tuple[float, float, float], float, str, str]]:
    """Name, parent, direction, length, axis and degrees of freedom of all bones but the root, parents first."""
    found = [(name, parent, (0.0, 1.0, 0.0), long, "0 0 0", "rx ry rz") for name, parent, long in MIDDLE]
    for letter, sign, (plus, minus) in (("l", 1.0, ("", "-")), ("r", -1.0, ("-", ""))):
        for name, parent, (x, y, z), long, axis, dofs in SIDE:
            up = parent if parent in ("root", "thorax") else letter + parent
            found.append((letter + name, up, (sign * x, y, z), long, axis.format(s=plus, m=minus), dofs))
    return found


def write_asf(path: Path) -> Path:
    """A skeleton file."""
    lines = ["# made up", ":version 1.10", ":units", "  mass 1.0", "  length 0.45", "  angle deg", ":root"]
    lines += ["  order TX TY TZ RX RY RZ", "  axis XYZ", "  position 0 0 0", "  orientation 0 0 0", ":bonedata"]
    for number, (name, _, direction, length, axis, dofs) in enumerate(bones(), start=1):
        lines += ["  begin", f"    id {number}", f"    name {name}", f"    direction {' '.join(map(str, direction))}"]
        lines += [f"    length {length}", f"    axis {axis} XYZ"]
        lines += [f"    dof {dofs}", *["    limits (-90 90)"] * len(dofs.split())] if dofs else []
        lines += ["  end"]
    lines += [":hierarchy", "  begin"]
    parents = dict.fromkeys(parent for _, parent, *_ in bones())
    lines += ["    " + " ".join([up, *(name for name, parent, *_ in bones() if parent == up)]) for up in parents]
    path.write_text("\r\n".join([*lines, "  end", ""]))
    return path


def write_amc(path: Path, frames: int, x: float = 0.0, seed: int = 0, swing: float = 12.0, rate: float = 60.0) -> Path:
    """A motion file of somebody upright who sways; rate only sets how fast."""
    random = np.random.default_rng(seed)
    lines = ["#!OML:ASF made up", ":FULLY-SPECIFIED", ":DEGREES"]
    moving = [("root", 6), *((name, len(dofs.split())) for name, *_, dofs in bones() if dofs)]
    phase = {name: random.uniform(0, 6, count) for name, count in moving}
    for t in range(frames):
        lines.append(str(t + 1))
        for name, _ in moving:
            values = swing * np.sin(2 * np.pi * t / rate + phase[name])
            if name == "root":
                values = np.concatenate([[x / 0.0254 * 0.45, 17.0, 0.0], 0.3 * values[3:]])
            lines.append(" ".join([name, *(f"{value:.6g}" for value in values)]))
    path.write_text("\r\n".join([*lines, ""]))
    return path


def slow_ends(asf: Path, amc: Path, frame: int) -> dict[str, NDArray[np.float64]]:
    """Bone ends of one frame in metres, by matrices and scipy, from the files' text alone."""
    skeleton = asf.read_text().replace("\r", "")
    bone_text = {
        block.split("name ")[1].split()[0]: block
        for block in skeleton.split(":bonedata")[1].split(":hierarchy")[0].split("begin")[1:]
    }
    tree = {}
    for line in skeleton.split(":hierarchy")[1].splitlines():
        words = line.split()
        tree.update({child: words[0] for child in words[1:]} if words and words[0] not in ("begin", "end") else {})
    wanted = amc.read_text().replace("\r", "").split(f"\n{frame + 1}\n")[1].splitlines()
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
