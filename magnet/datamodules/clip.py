"""A clip: one recording of people as every data set gives it, and which split it belongs to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from magnet.motion.runs import held
from magnet.motion.scene import Scene, require_rotations

Split = Literal["train", "val", "test"]
SPLITS: tuple[Split, ...] = get_args(Split)
Ints = NDArray[np.int64]
MOST = 1_000_000
"""Frames of a window or windows of a batch, at most: more is a slip."""
RESHAPED = "-reshaped"
"""What stands behind the source of clips whose people have been given other bodies."""


@dataclass(frozen=True)
class Clip:
    """One recording of people who share a world: 30 fps, y up, floor at height 0.

    Args:
        scene: one scene (B = 1) of T frames whose agents are all present. Frames that are not `valid` may be anything:
            they come to hold the pose before.
        name: what reports call it, such as "60_05+61_05".
        source: the data set or part of it, which mixture weights refer to.
        split: train, val or test.

    Raises:
        ValueError: several scenes, an absent agent, a NaN, a matrix that does not rotate, no frames or no such split;
            the message names the clip.
    """

    scene: Scene
    name: str
    source: str
    split: Split

    def __post_init__(self) -> None:
        if self.split not in SPLITS:
            raise ValueError(f"clip {self.name}: got split {self.split!r}, expected one of {SPLITS}")
        if self.scene.scenes != 1 or not self.scene.frames or not self.scene.agents:
            shape = tuple(self.scene.T_world_root.shape[:3])
            raise ValueError(f"clip {self.name}: got (B, T, P) = {shape}, expected one scene with frames and agents")
        if not bool(self.scene.present.all()):
            there = self.scene.present[0].nonzero()[:, 0].tolist()
            keep = f"scene.permute_agents(torch.tensor({there})) keeps them" if there else "there is nobody"
            raise ValueError(f"clip {self.name}: has an absent agent; a clip holds only who is there: {keep}")
        if self.scene.valid is not None:  # what is masked may be anything
            object.__setattr__(self, "scene", held(self.scene, self.scene.valid))
        for field in ("body_rot", "T_world_root", "betas"):
            if not bool(getattr(self.scene, field).isfinite().all()):
                raise ValueError(f"clip {self.name}: {field} holds NaN or infinity; mask such frames with `valid`")
        require_rotations(self.scene, f"clip {self.name}")

    @property
    def frames(self) -> int:
        return self.scene.frames

    @property
    def agents(self) -> int:
        return self.scene.agents

    def good(self) -> NDArray[np.bool_]:
        """Which frames are valid. (T,) bool"""
        if self.scene.valid is None:
            return np.ones(self.frames, dtype=bool)
        return self.scene.valid[0].cpu().numpy()


def at_most(most: int, **numbers: int) -> None:
    """No number is larger."""
    for name, number in numbers.items():
        if number > most:
            raise ValueError(f"{name}: got {number}, expected at most {most:,}")


def at_least(least: int, **numbers: int | None) -> None:
    """Every number that is given is so large."""
    for name, number in numbers.items():
        if number is not None and number < least:
            raise ValueError(f"{name}: got {number}, expected at least {least}")
