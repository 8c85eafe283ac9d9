"""Which axis points up for all files of a scene, where some of their people may lie throughout."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

CLEAR, LONG = 0.95, 0.7
"""Least share of an axis in a torso that rests along it, and in the mean torso of a take."""
MOST_RISEN = 0.25
"""Leg lengths between the heights of a pelvis in most frames (15 to 85 %) of somebody who lies, at most."""
ON_FLOOR, OFF_FLOOR = 0.1, 0.25
"""Leg lengths from zero within which the lowest joint of somebody on a floor is, and from which on there is none."""


@dataclass(frozen=True)
class Stance:
    """What a person tells of the axis that points up; lengths in legs."""

    torso: str  # axis along which torsos point most
    shown: str | None  # the same, if they do for long
    rest: str | None  # axis along which the rest pose stands, if it clearly does
    moved: Floats  # (3,) how far the pelvis goes along x, y and z in the most frames: a range of percentiles
    low: Floats  # (3, 2) where the lowest joint is if x, y, z or -x, -y, -z points up; median over frames

    def may_lie(self, up: str) -> bool:
        """Whether somebody who does not stand along this axis may lie all the time."""
        return bool(self.moved["xyz".index(up[-1])] <= MOST_RISEN)

    @property
    def turned(self) -> bool:
        """Whether the world was surely turned after the rest pose: who stands moves along what the rest pose calls up,
        or is on the floor along the torso and not along that."""
        if self.shown is None or self.rest in (None, self.shown):
            return False
        on_floor = abs(self.floor(self.shown)) <= ON_FLOOR and abs(self.floor(self.rest or "")) >= OFF_FLOOR
        return on_floor or not self.may_lie(self.rest or "")

    def floor(self, up: str) -> float:
        """Leg lengths of the lowest joint over zero."""
        return float(self.low["xyz".index(up[-1]), int(up.startswith("-"))])


def stance(
    torso: Floats, at: Floats, pelvis: Floats, resting: Floats | None = None, legs: Floats | None = None
) -> Stance:
    """What one person's motion tells, and the rest pose, if there is one.

    Args:
        torso: (T, 3) upwards, of any length.
        at: (T, K, 3) joints, in leg lengths.
        pelvis: (T, 3) the same.
        resting: (3,) the torso of the rest pose, of any length.
        legs: (3,) from hips to ankles there, in leg lengths.
    """
    rest = _standing(resting, legs)
    if len(torso) == 0:
        return Stance(rest or "y", None, rest, np.zeros(3), np.zeros((3, 2)))
    mean = (torso / np.linalg.norm(torso, axis=-1, keepdims=True).clip(1e-9)).mean(axis=0)
    along = axis_of(mean)
    low, high = np.percentile(pelvis, [15, 85], axis=0)
    floors = [np.median(at.min(axis=1), axis=0), np.median((-at).min(axis=1), axis=0)]
    shown = along if np.abs(mean).max() >= LONG else None
    if shown is None and resting is not None:
        along = axis_of(resting)
    return Stance(along, shown, rest, high - low, np.stack(floors, axis=1))


def _standing(torso: Floats | None, legs: Floats | None) -> str | None:
    """The axis along which a rest pose clearly stands: its torso points along it, and its legs the other way."""
    if torso is None or legs is None:
        return None
    up = axis_of(torso)
    axis, sign = "xyz".index(up[-1]), -1 if up.startswith("-") else 1
    stands = sign * torso[axis] >= CLEAR * np.linalg.norm(torso) and -sign * legs[axis] >= LONG
    return up if stands else None


def axis_of(vector: Floats) -> str:
    """The axis that is nearest to a direction, such as `-z`."""
    axis = int(np.abs(vector).argmax())
    return ("-" if vector[axis] < 0 else "") + "xyz"[axis]


def agreed(stances: Sequence[Stance]) -> list[str]:
    """The axis that points up in each file of one scene; files of different programs may have different ones.

    A rest pose counts where the motion contradicts it: somebody may lie. Whoever's rest pose does not tell has the
    axis of the others, unless they move up and down along it as nobody does who lies. A world that was turned after the
    rest pose for one is so for all who stand and rest like them.
    """
    sure = {one.rest for one in stances if one.rest is not None and one.rest == one.shown}
    turned = {(one.rest, one.shown) for one in stances if one.turned}
    found = [_rested(one, sure, turned) for one in stances]
    axes = sorted({axis for axis in found if axis is not None})
    if not axes:
        return _without_rest(stances)
    pairs = list(zip(stances, found, strict=True))
    ground = float(np.median([one.floor(axis) for one, axis in pairs if axis is not None]))
    return [_beside(one, axes, ground) if axis is None else axis for one, axis in pairs]


def _rested(one: Stance, sure: set[str], turned: set[tuple[str | None, str | None]]) -> str | None:
    """By the rest pose, beside files of which the axis is sure; None: it does not tell."""
    if one.rest is None:
        return None
    for axis in (one.rest, one.shown):
        if axis in sure:
            return axis
    return one.shown if (one.rest, one.shown) in turned else one.rest


def _beside(one: Stance, axes: Sequence[str], ground: float) -> str:
    """For somebody whose rest pose does not tell, by the axes of the others and their floor."""
    if one.torso in axes or len(axes) > 1 or (one.shown is not None and not one.may_lie(axes[0])):
        return one.torso
    off, own = (abs(one.floor(up) - ground) for up in (axes[0], one.torso))
    return axes[0] if one.shown is None or off <= own else one.torso


def _without_rest(stances: Sequence[Stance]) -> list[str]:
    """By motion alone: one axis for all if whoever does not stand along it may lie, and floors do not contradict."""
    own = [one.torso for one in stances]
    axes = sorted(set(own), key=lambda axis: (-own.count(axis), axis[-1] != "y", axis))
    if len(axes) == 1:
        return own

    def apart(ups: Sequence[str]) -> float:
        floors = [one.floor(up) for one, up in zip(stances, ups, strict=True)]
        return max(floors) - min(floors)

    may = [axis for axis in axes if all(one.torso == axis or one.may_lie(axis) for one in stances)]
    one_for_all = min(([axis] * len(own) for axis in may), key=apart, default=own)
    return one_for_all if apart(one_for_all) <= apart(own) else own


def said(stances: Sequence[Stance], ups: Sequence[str], k: int) -> list[str]:
    """What was decided for a file against its people's motion, or beside files of other axes."""
    shown = stances[k].shown
    notes = []
    if shown is not None and shown != ups[k]:
        why = "the rest pose" if stances[k].rest == ups[k] else "the other people"
        notes.append(f"torsos point along {shown}, so this person lies, as {ups[k]} points up for {why}; else say --up")
    elif shown is not None and stances[k].rest not in (None, ups[k]):
        notes.append(f"the rest pose stands along {stances[k].rest}, but people stand and walk along {ups[k]}")
    if len(set(ups)) > 1:
        notes.append(f"files have different axes that point up, this one {ups[k]}; if all have the same, say --up")
    return notes


WARNING = "warning: "
"""How a note begins that tells of a likely mistake."""


def told_against(up: str, found: Sequence[str]) -> list[str]:
    """A warning where the axis that was said is nobody's. found: the axis of each file by its motion"""
    if not found or up in found:
        return []
    theirs = max(found, key=found.count)
    return [
        f"{WARNING}up {up}, as said, leaves nobody upright; the files look like {theirs} up: --up={theirs} "
        f"(up={theirs!r}) stands people up, unless all lie"
    ]
