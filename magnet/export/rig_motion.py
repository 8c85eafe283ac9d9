"""A recorded skeleton in motion, of any program, before it is put on a body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

RATES = (23.976, 24.0, 25.0, 29.97, 30.0, 48.0, 50.0, 59.94, 60.0, 90.0, 100.0, 119.88, 120.0, 240.0)
"""Rates that a rounded Frame Time such as 0.033333 stands for."""

LONGEST = 216_000
"""Frames that a file is read as at most, two hours at 30 a second; more would fill the memory."""
MOST_AWAY = 1e7
"""Largest coordinate in any unit, ten kilometres in millimetres; what is farther is no motion, but damage."""


@dataclass(frozen=True)
class RigMotion:
    """One skeleton of K joints, parents first, and T frames; lengths in the file's unknown unit."""

    names: tuple[str, ...]
    parents: tuple[int, ...]  # the root's is -1
    offsets: Floats  # (K, 3) from the parent, in the rest pose
    place: Floats  # (T, K, 3) from the parent in each frame; differs from `offsets` only where a joint slides
    local: Floats  # (T, K, 3, 3) rotation relative to the parent; all are the identity in the rest pose
    fps: float
    path: Path
    tracked: Bools | None = None  # (T,) frames that hold no NaN; the others are as the one before
    up: str | None = None  # the axis that the format has up; None: any
    unit: str | None = None  # the format's, which programs do not all keep; None: any
    person: str = ""  # who it is, in a file of several people
    notes: tuple[str, ...] = ()  # on how it was read
    posed: bool = False  # its rest pose is a pose of the motion, so that it tells nothing of how people rest

    @property
    def label(self) -> str:
        """The file's name, and who of it."""
        return f"{self.path.name} {self.person}".rstrip()

    @property
    def frames(self) -> int:
        return len(self.local)

    def require_near(self) -> None:
        """Refuse places that no motion has, and numbers that are none."""
        if self.place.size and not (far := float(np.abs(self.place).max())) < MOST_AWAY:
            raise ValueError(f"{self.path}: a joint is {far:.2g} away from the one above: it is damaged")

    def rest(self) -> Floats:
        """Joints in the rest pose, the root at the origin. (K, 3)"""
        return rest_of(self.offsets, self.parents)

    def world(self) -> tuple[Floats, Floats]:
        """Rotations from the rest pose (T, K, 3, 3) and positions (T, K, 3) in the file's world."""
        turned, at = np.empty_like(self.local), np.empty_like(self.place)
        for k, parent in enumerate(self.parents):
            if parent < 0:
                turned[:, k], at[:, k] = self.local[:, k], self.place[:, k]
            else:
                turned[:, k] = turned[:, parent] @ self.local[:, k]
                at[:, k] = at[:, parent] + (turned[:, parent] @ self.place[:, k, :, None])[..., 0]
        return turned, at


def rest_of(offsets: Floats, parents: Sequence[int]) -> Floats:
    """Joints in the rest pose, the root at the origin. offsets (K, 3) -> same"""
    rest = np.zeros_like(offsets)
    for k, parent in enumerate(parents):
        rest[k] = 0.0 if parent < 0 else rest[parent] + offsets[k]
    return rest


def usual_rate(fps: float) -> float:
    """The usual frame rate that a measured one stands for, or a whole number; itself where neither is near."""
    nearest = min(RATES, key=lambda rate: abs(rate - fps))
    if abs(nearest - fps) < 5e-4 * fps:
        return nearest
    return float(round(fps)) if abs(round(fps) - fps) < 1e-3 * fps else fps
