"""Where palms look in the rest pose of a skeleton, as its fingers tell, and how elbows bend against it."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Sequence

import torch
from torch import Tensor

from magnet.body.joints import ELBOWS, SHOULDERS, WRISTS
from magnet.export.rig import Skeleton

FINGERS = {
    "thumb": re.compile("thumb|親指|daumen"),
    "index": re.compile("index|fore|人指|人差指|zeige"),
    "pinky": re.compile("pinky|pinkie|little|小指|klein"),
    "ring": re.compile("ring|third|薬指"),
}
NUMBERED = re.compile(r"(?:finger|digit)[ _.\-]*(\d)")
"""Fingers by number: the thumb has the lowest; bones of one finger begin with the same digit."""
FLAT = math.radians(20.0)
"""Roll of palms that hands of other shapes also have, and that is none."""
THUMBS_LEAN = math.radians(45.0)
"""The same where only the thumb tells, which leans towards the palm."""


def palms_rolled(skeleton: Skeleton, s: int, ahead: Tensor) -> float | None:
    """Radians by which a palm rests rolled about its forearm from a palm that looks down; None: no finger tells.

    s: 0 left, 1 right; ahead (3,): where the thumb's side of a palm that looks down lies in the file's rest pose.
    """
    ours, file = skeleton.naming.joints, skeleton.file
    elbow, wrist = ours[ELBOWS[s]], ours[WRISTS[s]]
    rest = torch.from_numpy(file.rest())
    found = fingers(file.names, file.parents, wrist)
    last = found.get("pinky") or found.get("ring")
    if "index" in found and last:
        side, least = rest[found["index"]].mean(dim=0) - rest[last].mean(dim=0), FLAT
    elif "thumb" in found:
        side, least = rest[found["thumb"]].mean(dim=0) - rest[wrist], THUMBS_LEAN
    else:
        return None
    roll = about(rest[wrist] - rest[elbow], ahead, side)
    return roll if abs(roll) > least else 0.0


def fingers(names: Sequence[str], parents: Sequence[int], wrist: int) -> dict[str, list[int]]:
    """Joints of the thumb, the index, the ring finger and the pinky below a wrist, by their names or numbers."""
    below = {wrist}
    for k, parent in enumerate(parents):  # parents come first
        if parent in below:
            below.add(k)
    words = {k: unicodedata.normalize("NFKC", names[k]).lower() for k in sorted(below - {wrist})}
    found = {finger: [k for k, word in words.items() if known.search(word)] for finger, known in FINGERS.items()}
    if not any(found.values()):
        numbers = {k: told[1] for k, word in words.items() if (told := NUMBERED.search(word))}
        order = sorted(set(numbers.values()))
        if len(order) >= 4:
            place = {"thumb": order[0], "index": order[1], "pinky": order[-1]}
            found = {finger: [k for k, n in numbers.items() if n == number] for finger, number in place.items()}
    return {finger: joints for finger, joints in found.items() if joints}


def about(axis: Tensor, first: Tensor, second: Tensor) -> float:
    """Radians about an axis from one direction to another, as seen along it. (3,) x 3"""
    axis = torch.nn.functional.normalize(axis, dim=0)
    across = torch.linalg.cross(axis, first)
    return float(torch.atan2(across @ second, first @ second - (first @ axis) * (second @ axis)))


def elbow_roll(skeleton: Skeleton, s: int, ahead: Tensor, least: float = 0.2) -> float:
    """Radians about the upper arm from `ahead` (3,) to where the forearm goes as the elbow bends, 0: it hardly does.

    least: mean share of the forearm that is aside of the upper arm.
    """
    upper, bends = bent_aside(skeleton, SHOULDERS[s], ELBOWS[s], WRISTS[s])
    return about(upper, ahead, bends) if float(bends.norm()) >= least else 0.0


def bent_aside(skeleton: Skeleton, upper: int, hinge: int, end: int) -> tuple[Tensor, Tensor]:
    """Where the upper bone of a limb rests, of unit length, and where the lower one goes aside of it. -> (3,) x 2

    The second is the mean of unit directions over all frames, as the upper bone rests; upper, hinge and end are joints
    of ours.
    """
    ours, rest = skeleton.naming.joints, torch.from_numpy(skeleton.file.rest())
    bone = torch.nn.functional.normalize(rest[ours[hinge]] - rest[ours[upper]], dim=0)
    lower = torch.from_numpy(skeleton.at[:, ours[end]] - skeleton.at[:, ours[hinge]])
    turned = torch.from_numpy(skeleton.turned[:, skeleton.carrier(upper)])
    lower = torch.nn.functional.normalize((turned.mT @ lower[..., None])[..., 0], dim=-1)
    return bone, (lower - (lower @ bone)[..., None] * bone).mean(dim=0)
