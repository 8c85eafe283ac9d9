"""What a viewer marks: feet that stand or slide, hands that touch, bodies that run through each other."""

from __future__ import annotations

import itertools

import numpy as np
import torch
from numpy.typing import NDArray

from magnet.body.capsules import capsule_segments, nearest_points
from magnet.body.joints import WRISTS
from magnet.export.page.palette import COLLIDES, SLIDES
from magnet.metrics.body_depth import DEEP
from magnet.metrics.penetration import TOUCH, penetration_depth
from magnet.metrics.skating import PRESETS, toe_steps

Array = NDArray[np.floating]
Mask = NDArray[np.bool_]

HANDS_TOUCH = 0.2
"""Metres between two people's wrists under which their hands are taken to touch."""


def standing(before: Array, now: Array, fps: float) -> tuple[Mask, Mask]:
    """Which toes stand, and which of these slide, by the rules of the metric FS. (P, 22, 3) x 2 -> (P, 2) bool x 2"""
    height, fast = PRESETS["default"]
    speed, low = toe_steps(torch.from_numpy(np.stack([before, now])), fps, height)
    return low[0].numpy(), (low & (speed > fast))[0].numpy()


def touching(joints: Array) -> Array:
    """Places between hands of different people that touch. (P, 22, 3) -> (M, 3)"""
    wrists = joints[:, WRISTS]  # (P, 2, 3)
    apart = np.linalg.norm(wrists[:, :, None, None] - wrists[None, None], axis=-1)  # (P, 2, P, 2)
    p, hand, q, other = np.nonzero(apart < HANDS_TOUCH)
    once = p < q
    return (wrists[p[once], hand[once]] + wrists[q[once], other[once]]) / 2


def penetrations(joints: Array) -> tuple[Array, Array, Array]:
    """Where capsules of different people run through each other, by the rules of the metric IP.

    (P, 22, 3) -> places (M, 3), radii of the thicker capsule (M,), depths (M,), metres
    """
    pairs = list(itertools.combinations(range(len(joints)), 2))
    if not pairs:
        return np.zeros((0, 3)), np.zeros(0), np.zeros(0)
    people = torch.from_numpy(np.ascontiguousarray(joints)).float()
    one, other = people[[p for p, _ in pairs]], people[[q for _, q in pairs]]
    depth = penetration_depth(one, other)
    n, i, j = depth.nonzero(as_tuple=True)
    a, b, radius = capsule_segments(one)
    c, d, _ = capsule_segments(other)
    first, second = nearest_points(a[n, i], b[n, i], c[n, j], d[n, j])
    return ((first + second) / 2).numpy(), torch.maximum(radius[i], radius[j]).numpy(), depth[n, i, j].numpy()


def depth_colours(depths: Array) -> Array:
    """Amber where bodies just count as in each other, at 5 cm, and red from 10 cm on. (M,) metres -> (M, 3)"""
    share = np.clip((depths - TOUCH) / (DEEP - TOUCH), 0.0, 1.0)[:, None]
    return (1 - share) * np.array(SLIDES, dtype=float) + share * np.array(COLLIDES, dtype=float)
