"""A BVH file's joints, unit, up axis and rest pose, stated or found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magnet.body.joints import HIPS, L_ANKLE, L_ELBOW, L_FOOT, L_HIP, L_KNEE, L_SHOULDER, L_WRIST, SHOULDERS
from magnet.export.bvh_read import Bvh
from magnet.export.naming import Naming, recognised

Floats = NDArray[np.float64]

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "foot": 0.3048, "CMU's (1/0.45 inch)": 0.0254 / 0.45}
SHORTEST_LEG, LONGEST_LEG = 0.6, 1.15
"""Metres from hip to ankle within which a unit is believed; no two units above fit one number."""
UP: dict[str, Floats] = {
    "y": np.eye(3),
    "z": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "x": np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]),
    "-y": np.diag([1.0, -1, -1]),
    "-z": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "-x": np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
}
"""Up axis of a file: the rotation that takes its world to ours."""

LIMBS = ((L_HIP, L_KNEE), (L_KNEE, L_ANKLE), (L_ANKLE, L_FOOT), (L_SHOULDER, L_ELBOW), (L_ELBOW, L_WRIST))
"""Left joint and the child that says where its bone points in the rest pose."""


@dataclass(frozen=True)
class Skeleton:
    """A file with its world turned to y up and its lengths in metres."""

    file: Bvh
    naming: Naming
    unit: str
    up: str
    metres: float  # a unit of length
    R_rest_ours: Floats  # (3, 3) from our rest frame (left +x, up +y) to the file's
    turned: Floats  # (T, K, 3, 3) world rotations from the file's rest pose, y up
    at: Floats  # (T, K, 3) world positions, metres, y up
    chain: tuple[int, ...]  # numbers of the pelvis, the spine and the chest, upwards


def understood(file: Bvh, unit: str | None, up: str | None, given: Mapping[str, str] | None) -> Skeleton:
    """A file's skeleton in metres, y up, with our joints; options that are None are found from the file.

    Args:
        given: our joint's name to theirs, for names that no scheme knows.

    Raises:
        ValueError: unknown names, a length of legs that fits no unit, or a rest pose without a front.
    """
    naming = recognised(file.names, given)
    if naming.missing:
        raise ValueError(
            f"{file.path}: cannot tell which joint is {', '.join(naming.missing)}; it has {', '.join(file.names)}. "
            f"Name them: --joint {naming.missing[0]}=ITS_NAME (joints={{...}}; of magnet data: --reader.joints FILE)"
        )
    ours = naming.joints
    rest = file.rest()
    leg = np.mean([sum(np.linalg.norm(rest[ours[a + s]] - rest[ours[b + s]]) for a, b in LIMBS[:2]) for s in (0, 1)])
    if unit is None:
        fitting = [name for name, metres in UNITS.items() if SHORTEST_LEG <= leg * metres <= LONGEST_LEG]
        if not fitting:
            raise ValueError(
                f"{file.path}: legs are {leg:.3g} long, which fits no unit of length; say --in_unit m or cm (unit=...; "
                "of magnet data: --reader.unit)"
            )
        unit = fitting[0]
    turned, at = file.world()
    torso = _middle(at, ours, 16, 17) - _middle(at, ours, 1, 2)
    up = up or _up_axis(torso, rest, ours)
    M = UP[up]
    pelvis = _ancestor(file.parents, [ours[1], ours[2]])
    chest = _ancestor(file.parents, [ours[16], ours[17]])
    chain = [chest]
    while chain[-1] != pelvis and file.parents[chain[-1]] >= 0:
        chain.append(file.parents[chain[-1]])
    return Skeleton(
        file=file,
        naming=naming,
        unit=unit,
        up=up,
        metres=UNITS[unit],
        R_rest_ours=_rest_frame(rest, ours, file.path),
        turned=M @ turned,
        at=UNITS[unit] * (at @ M.T),
        chain=tuple(reversed(chain)) if chain[-1] == pelvis else (pelvis,),
    )


def _middle(at: Floats, ours: Mapping[int, int], a: int, b: int) -> Floats:
    return (at[..., ours[a], :] + at[..., ours[b], :]) / 2


def _up_axis(torso: Floats, rest: Floats, ours: Mapping[int, int]) -> str:
    """Where torsos point on average, or in the rest pose if people lie down. torso (T, 3)"""
    mean = (torso / np.linalg.norm(torso, axis=-1, keepdims=True)).mean(axis=0)
    if np.abs(mean).max() < 0.7:
        mean = _middle(rest, ours, *SHOULDERS) - _middle(rest, ours, *HIPS)
    axis = int(np.abs(mean).argmax())
    return ("-" if mean[axis] < 0 else "") + "xyz"[axis]


def _rest_frame(rest: Floats, ours: Mapping[int, int], path: Path) -> Floats:
    hips, shoulders = (rest[ours[left]] - rest[ours[right]] for left, right in (HIPS, SHOULDERS))
    left = hips / 2 + shoulders / 2
    above = _middle(rest, ours, *SHOULDERS) - _middle(rest, ours, *HIPS)
    ahead = np.cross(left, above)
    if np.linalg.norm(ahead) < 1e-6 * max(float(np.abs(rest).max()), 1e-9) ** 2:
        raise ValueError(f"{path}: hips and shoulders of the rest pose lie on one line, so it has no front")
    x = left / np.linalg.norm(left)
    z = ahead / np.linalg.norm(ahead)
    frame = np.stack([x, np.cross(z, x), z], axis=1)
    whole = np.round(frame)
    return whole if np.abs(frame - whole).max() < 0.05 else frame


def _ancestor(parents: Sequence[int], joints: Sequence[int]) -> int:
    """Lowest joint that all of them hang on."""

    def line(k: int) -> list[int]:
        up = [k]
        while parents[up[-1]] >= 0:
            up.append(parents[up[-1]])
        return up

    common = set(line(joints[0])).intersection(*(line(k) for k in joints[1:]))
    return next(k for k in line(joints[0])[1:] if k in common)
