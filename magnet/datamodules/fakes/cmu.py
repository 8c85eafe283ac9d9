"""A tiny CMU: made-up people who sway, in its ASF and AMC files, inches and degrees, 60 and 120 fps."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import count, islice
from pathlib import Path
from typing import Any

import numpy as np

from magnet.motion.scene import FPS

TEST, VAL = 5, 3
"""Takes that `CMU` holds out."""
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


def scenes(takes: int, frames: int, seed: int) -> dict[str, dict[str, Any]]:
    """Files of the couple 60 and 61, the first to test, the second to validate on, and one of somebody alone.

    -> arguments of `write_amc` by file; of the couple 60 frames a second, of the one alone 120.
    """
    numbers = [TEST, VAL, *islice((n for n in count(1) if n not in (TEST, VAL) and n % 5), max(takes - 2, 0))][:takes]
    files = [("salsa", subject, take, x, 60.0) for subject, x in ((60, 0.0), (61, 0.8)) for take in numbers]
    return {
        f"{folder}/{subject:02}_{take:02}": {
            "frames": round(frames * rate / FPS), "x": x, "seed": 1000 * seed + 10 * subject + take, "rate": rate,
        }
        for folder, subject, take, x, rate in [*files, ("singles", 2, 1, 0.0, 120.0)]
    }  # fmt: skip


def write_scenes(out: Path, scenes: Mapping[str, dict[str, Any]]) -> None:
    """Motion files, and the skeleton of each subject."""
    for name, motion in scenes.items():
        path = out / f"{name}.amc"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_asf(path.with_name(f"{path.stem[:2]}.asf"))
        write_amc(path, **motion)


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
    path.write_text("\r\n".join([*lines, "  end", ""]), encoding="utf-8")
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
    path.write_text("\r\n".join([*lines, ""]), encoding="utf-8")
    return path
