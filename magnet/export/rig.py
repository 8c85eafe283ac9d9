"""A BVH file's joints, unit, up axis and rest pose, stated or found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magnet.body.joints import (  # isort: skip
    ANKLES, ELBOWS, HIPS, KNEES, L_ANKLE, L_ELBOW, L_FOOT, L_HIP, L_KNEE, L_SHOULDER, L_WRIST, SHOULDERS, WRISTS,
)  # fmt: skip
from magnet.export.naming import Naming, recognised
from magnet.export.rig_motion import RigMotion
from magnet.export.upright import WARNING, Stance, agreed, said, stance, told_against

Floats = NDArray[np.float64]

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "foot": 0.3048, "CMU's (1/0.45 inch)": 0.0254 / 0.45}
SHORTEST_LEG, LONGEST_LEG = 0.6, 1.15
"""Metres from hip to ankle within which a unit is believed; no two units above fit one number."""
CHILDS_LEG, GIANTS_LEG = 0.3, 1.3
"""The same for people whose unit somebody else's file tells."""
UP: dict[str, Floats] = {
    "y": np.eye(3),
    "z": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "x": np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]),
    "-y": np.diag([1.0, -1, -1]),
    "-z": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "-x": np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
}
"""Up axis of a file: the rotation that takes its world to ours."""

ENDS = dict(zip((*HIPS, *KNEES, *SHOULDERS, *ELBOWS), (*KNEES, *ANKLES, *ELBOWS, *WRISTS), strict=True))
"""Joints at which limbs begin and end that may turn in several parts."""
LIMBS = ((L_HIP, L_KNEE), (L_KNEE, L_ANKLE), (L_ANKLE, L_FOOT), (L_SHOULDER, L_ELBOW), (L_ELBOW, L_WRIST))
"""Left joint and the child that says where its bone points in the rest pose."""


@dataclass(frozen=True)
class Skeleton:
    """A file with its world turned to y up and its lengths in metres."""

    file: RigMotion
    naming: Naming
    unit: str
    up: str
    metres: float  # a unit of length
    R_rest_ours: Floats  # (3, 3) from our rest frame (left +x, up +y) to the file's
    turned: Floats  # (T, K, 3, 3) world rotations from the file's rest pose, y up
    at: Floats  # (T, K, 3) world positions, metres, y up
    chain: tuple[int, ...]  # numbers of the pelvis, the spine and the chest, upwards
    notes: tuple[str, ...] = ()  # doubts about unit and axis, and how they were decided

    def carrier(self, joint: int) -> int:
        """Which of its joints turns a limb of ours whole: the last of those that share its turns.

        Daz's shoulder bends, a twist on it rolls the arm, and the elbow hangs on that; MakeHuman's limbs are two parts.
        """
        first, end = self.naming.joints[joint], self.naming.joints.get(ENDS.get(joint, -1))
        return first if end is None or first not in _line(self.file.parents, end)[1:] else self.file.parents[end]


def require_unit(unit: str | None) -> None:
    """Refuse a unit of length that is none of `UNITS`; None: it is to be found."""
    if unit is not None and unit not in UNITS:
        raise ValueError(f"unit {unit!r}: expected one of {', '.join(name for name in UNITS if ' ' not in name)}")


def require_up(up: str | None) -> None:
    """Refuse an axis that is none of `UP`; None: it is to be found."""
    if up is not None and up not in UP:
        raise ValueError(f"up axis {up!r}: expected one of {', '.join(UP)}")


def understood_together(
    files: Sequence[RigMotion], unit: str | None, up: str | None, given: Mapping[str, str] | None
) -> list[Skeleton]:
    """Skeletons of one scene in metres, y up, with our joints; options that are None are found from the files.

    given: our joint's name to theirs, for names that no scheme knows.

    Raises:
        ValueError: unknown names, a length of legs that fits no unit, or a rest pose without a front.
    """
    namings = [_named(file, given) for file in files]
    legs = [_leg(file.rest(), naming.joints) for file, naming in zip(files, namings, strict=True)]
    units = _units(files, legs) if unit is None else [unit] * len(files)
    moved = [file.world() for file in files]
    stances = [_stance(*each) for each in zip(files, namings, legs, [at for _, at in moved], strict=True)]
    ups = agreed(stances) if up is None else [up] * len(files)
    found = []
    for k, (file, naming) in enumerate(zip(files, namings, strict=True)):
        notes = [] if unit else _of_unit(legs, units, k)
        notes += [] if up else said(stances, ups, k)
        if k == 0:  # of all files together, once
            notes += _against_unit(legs, unit) if unit else []
            notes += told_against(up, agreed(stances)) if up else []
        found.append(_skeleton(file, naming, units[k], ups[k], *moved[k], tuple(notes)))
    return found


def people_of(rigs: list[RigMotion], given: Mapping[str, str] | None) -> list[RigMotion]:
    """The people among the skeletons of one file: without animals and things, of which a note tells.

    All of them where nobody's joints are known, so that reading them says what is missing.
    """
    known = [not recognised(rig.names, given).missing for rig in rigs]
    left = [rig.person for rig, is_known in zip(rigs, known, strict=True) if not is_known]
    people = [rig for rig, is_known in zip(rigs, known, strict=True) if is_known]
    if not left or not people:
        return rigs
    note = f"left out, as their joints are not named like a person's: {', '.join(left)}"
    return [replace(people[0], notes=(*people[0].notes, note)), *people[1:]]


def _named(file: RigMotion, given: Mapping[str, str] | None) -> Naming:
    naming = recognised(file.names, given)
    if naming.missing:
        raise ValueError(
            f"{file.path}: cannot tell which joint is {', '.join(naming.missing)}; it has {', '.join(file.names)}. "
            f"Name them: --joint {naming.missing[0]}=ITS_NAME (joints={{...}}; of magnet data: --reader.joints FILE)"
        )
    return naming


def _leg(rest: Floats, ours: Mapping[int, int]) -> float:
    """Length of a leg in the file's unit."""
    bones = [rest[ours[a + s]] - rest[ours[b + s]] for a, b in LIMBS[:2] for s in (0, 1)]
    return float(np.linalg.norm(bones, axis=-1).sum()) / 2


def _units(files: Sequence[RigMotion], legs: Sequence[float]) -> list[str]:
    """One unit for all, which fits most legs and makes the others a child's or a giant's; else each file's own, which
    its format says where nothing fits."""

    def fits(leg: float, unit: str, low: float = SHORTEST_LEG, high: float = LONGEST_LEG) -> bool:
        return low <= leg * UNITS[unit] <= high

    shared = [unit for unit in UNITS if all(fits(leg, unit, CHILDS_LEG, GIANTS_LEG) for leg in legs)]
    unit = max(shared, key=lambda unit: sum(fits(leg, unit) for leg in legs), default=None)
    if unit is not None and any(fits(leg, unit) for leg in legs):
        return [unit] * len(files)
    own = [
        next((unit for unit in UNITS if fits(leg, unit)), file.unit or "")
        for file, leg in zip(files, legs, strict=True)
    ]
    if "" in own:
        k = own.index("")
        raise ValueError(
            f"{files[k].path}: legs are {legs[k]:.3g} long, which fits no unit of length; say --in_unit m or cm "
            "(unit=...; of magnet data: --reader.unit)"
        )
    return own


def _of_unit(legs: Sequence[float], units: Sequence[str], k: int) -> list[str]:
    leg = legs[k] * UNITS[units[k]]
    if len(set(units)) > 1:
        return [f"files have different units, this one {units[k]}"]
    if not SHORTEST_LEG <= leg <= LONGEST_LEG:
        return [f"legs are {100 * leg:.0f} cm long if its unit is that of the others, which is taken to be so"]
    return []


def _against_unit(legs: Sequence[float], unit: str) -> list[str]:
    """A warning where the unit that was said leaves nobody with legs of a person's length."""
    if any(CHILDS_LEG <= leg * UNITS[unit] <= GIANTS_LEG for leg in legs):
        return []
    fit = next((name for name in UNITS if all(SHORTEST_LEG <= leg * UNITS[name] <= LONGEST_LEG for leg in legs)), None)
    looks = (
        f"; the files look like {fit}: --in_unit {fit} (unit={fit!r})" if fit in UNITS and " " not in str(fit) else ""
    )
    return [f"{WARNING}unit {unit}, as said, makes legs {legs[0] * UNITS[unit]:.2g} m long{looks}"]


def _stance(file: RigMotion, naming: Naming, leg: float, at: Floats) -> Stance:
    ours, rest = naming.joints, file.rest()
    ankles = (rest[ours[L_ANKLE]] + rest[ours[L_ANKLE + 1]]) / 2
    known = at[:, sorted(ours.values())] / max(leg, 1e-9)
    return stance(
        _middle(at, ours, *SHOULDERS) - _middle(at, ours, *HIPS),
        known,
        _middle(at, ours, *HIPS) / max(leg, 1e-9),
        _middle(rest, ours, *SHOULDERS) - _middle(rest, ours, *HIPS),
        (ankles - _middle(rest, ours, *HIPS)) / max(leg, 1e-9),
    )


def _skeleton(
    file: RigMotion, naming: Naming, unit: str, up: str, turned: Floats, at: Floats, notes: tuple[str, ...]
) -> Skeleton:
    ours, M = naming.joints, UP[up]
    pelvis = _ancestor(file.parents, [ours[1], ours[2]])
    chest = _ancestor(file.parents, [ours[16], ours[17]])
    if pelvis not in _line(file.parents, chest):  # legs and spine hang beside each other, as Daz's do
        pelvis = _ancestor(file.parents, [pelvis, chest])
    chain = [chest]
    while chain[-1] != pelvis and file.parents[chain[-1]] >= 0:
        chain.append(file.parents[chain[-1]])
    return Skeleton(
        file=file,
        naming=naming,
        unit=unit,
        up=up,
        metres=UNITS[unit],
        R_rest_ours=rest_frame(file.rest(), ours, file.path),
        turned=M @ turned,
        at=UNITS[unit] * (at @ M.T),
        chain=tuple(reversed(chain)) if chain[-1] == pelvis else (pelvis,),
        notes=notes,
    )


def _middle(at: Floats, ours: Mapping[int, int], a: int, b: int) -> Floats:
    return (at[..., ours[a], :] + at[..., ours[b], :]) / 2


def rest_frame(rest: Floats, ours: Mapping[int, int], path: Path) -> Floats:
    """Rotation from our rest frame (left +x, up +y) to that of a rest pose. rest (K, 3) -> (3, 3)"""
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
    common = set(_line(parents, joints[0])).intersection(*(_line(parents, k) for k in joints[1:]))
    return next(k for k in _line(parents, joints[0])[1:] if k in common)


def _line(parents: Sequence[int], k: int) -> list[int]:
    """A joint and all that it hangs on."""
    up = [k]
    while parents[up[-1]] >= 0:
        up.append(parents[up[-1]])
    return up
