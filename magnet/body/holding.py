"""Which hands hold each other, frame by frame, and over time."""

from __future__ import annotations

from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from magnet.body.energy import hand_points
from magnet.body.indices import pairs_of
from magnet.motion.resample import smoothstep
from magnet.motion.runs import true_runs

Floats = NDArray[np.floating[Any]]
Bools = NDArray[np.bool_]

HELD = 0.20
"""Metres between the middles of two hands that hold each other, as in the metric."""
PARTED = 0.60
"""Metres between two hands that held each other and do no longer; chosen on CMU's salsa
(docs/experiments_corrections.md)."""
GRIP = 0.10
"""Metres between the middles of hands that hold: half of those held in CMU's salsa are nearer."""
BREAK = 0.27
"""Seconds for which hands may be further apart than `PARTED` and still hold."""
EASE = 0.2
"""Seconds in which hands come together and part."""


def between_hands(joints: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
    """Vectors between the hands of each two people, and whether both are there.

    joints (B, T, P, 22, 3), present (B, P) -> (B, T, Q, 2, 2, 3) metres from the second's hands to the first's, (B, Q)
    bool; the Q pairs are in the order of `combinations`.
    """
    first, second = pairs_of(joints.shape[2], joints.device)
    hands = hand_points(joints)
    return hands[:, :, first, :, None] - hands[:, :, second, None], present[:, first] & present[:, second]


def holds(joints: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
    """Which hands hold in each frame, and vectors between hands. -> (B, T, Q, 2, 2) bool, (B, T, Q, 2, 2, 3)

    Of two people the nearest pair of hands counts, and the pair of the other two hands. Arguments as for
    `between_hands`.
    """
    between, both = between_hands(joints, present)
    apart = between.norm(dim=-1)
    own = apart == apart.amin(dim=-1, keepdim=True)
    held = (apart < HELD) & own & (apart == apart.amin(dim=-2, keepdim=True))
    return held & both[:, None, :, None, None], between


class Hold(NamedTuple):
    """Two hands that hold in the frames [start, stop); `worth` grows with how long and how near they are."""

    worth: float
    start: int
    stop: int
    pair: int
    one: int
    other: int


def lasting_holds(
    joints: Tensor, present: Tensor, fps: float, before: Tensor | None = None, takes: float = HELD
) -> tuple[Tensor, Tensor]:
    """Which hands hold, and the vectors that they shall have between them. -> as for `holds`

    Hands that come within `takes` hold for as long as they are within `PARTED`, short breaks apart, before and after;
    each hand one other. Where they are further apart than `GRIP` they are to come so near, eased at both ends.

    Args:
        joints: (B, T, P, 22, 3).
        present: (B, P) bool.
        fps: frames a second.
        before: (B, Q, 2, 2) bool, hands that held in the frame before the first; None: there is none.
        takes: metres.
    """
    between, both = between_hands(joints, present)
    apart = between.norm(dim=-1)
    near = (apart < PARTED) & both[:, None, :, None, None]
    # Looked at once: hold by hold, tensors of some frames would cost more than all else.
    metres, close = apart.detach().cpu().numpy(), near.cpu().numpy()
    held_on = np.zeros_like(close[:, 0]) if before is None else before.cpu().numpy()
    held, share = np.zeros_like(close), np.zeros_like(metres)
    people = list(combinations(range(joints.shape[2]), 2))
    for b in range(len(metres)):
        busy = np.zeros((joints.shape[2], 2, metres.shape[1]), dtype=bool)
        for hold in sorted(_found(metres[b], close[b], held_on[b], fps, takes), reverse=True):
            frames, (p, q) = slice(hold.start, hold.stop), people[hold.pair]
            free = ~busy[p, hold.one, frames] & ~busy[q, hold.other, frames]
            busy[p, hold.one, frames] |= free
            busy[q, hold.other, frames] |= free
            held[b, frames, hold.pair, hold.one, hold.other] = free
            share[b, frames, hold.pair, hold.one, hold.other] = _eased(hold, metres.shape[1], fps)
    shorter = GRIP / apart.clamp_min(GRIP)  # 1 where they are near enough
    eased = torch.lerp(torch.ones_like(shorter), shorter, torch.from_numpy(share).to(apart))
    return torch.from_numpy(held).to(near.device), between * eased[..., None]


def _found(metres: Floats, close: Bools, held_on: Bools, fps: float, takes: float) -> list[Hold]:
    """The holds of each two hands by themselves. metres, close (T, Q, 2, 2), held_on (Q, 2, 2)"""
    found = []
    for pair, one, other in np.argwhere(close.any(axis=0)).tolist():
        apart = metres[:, pair, one, other]
        for start, stop in _bridged(true_runs(close[:, pair, one, other]), round(BREAK * fps)):
            if (start == 0 and held_on[pair, one, other]) or (apart[start:stop] < takes).any():
                worth = float((PARTED - apart[start:stop]).clip(min=0).sum())
                found.append(Hold(worth, start, stop, pair, one, other))
    return found


def _bridged(runs: list[tuple[int, int]], gap: int) -> list[tuple[int, int]]:
    """Runs with those joined between which at most `gap` frames lie."""
    joined: list[tuple[int, int]] = []
    for start, stop in runs:
        if joined and start - joined[-1][1] <= gap:
            joined[-1] = (joined[-1][0], stop)
        else:
            joined.append((start, stop))
    return joined


def _eased(hold: Hold, frames: int, fps: float) -> Floats:
    """How far hands follow a hold, 0 to 1, in each of its frames; the first and last of a motion need no easing."""
    count, length = hold.stop - hold.start, max(EASE * fps, 1.0)
    into = np.arange(1, count + 1, dtype=np.float32) / length
    rise = np.ones_like(into) if hold.start == 0 else into
    fall = np.ones_like(into) if hold.stop == frames else into[::-1]
    return smoothstep(torch.from_numpy(np.minimum(rise, fall).clip(0, 1))).numpy()
