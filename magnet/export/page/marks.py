"""Marks on people: where bodies are in each other, where hands touch, which feet stand and slide."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from magnet.body.base import Body
from magnet.body.capsules import capsule_segments, nearest_points
from magnet.body.contact import DEEP, STANDING, TOUCH, WITHIN, penetration_depth, toe_steps
from magnet.body.energy import hand_points
from magnet.body.joints import TOES
from magnet.export.drawing import Array
from magnet.export.page.palette import COLLIDES, SLIDES
from magnet.export.page.rig import CROWD, Index
from magnet.motion.scene import Scene

Mask = NDArray[np.bool_]

HAND, DISC = 0.085, 0.11
"""Metres of radius of the ball between touching hands, and of the disc under a foot."""
BALL = 0.03
"""Metres by which the ball of a collision is thicker than the thicker limb, so that it comes out of the skin."""
MOST = 24
"""Collisions that are marked in a frame, the deepest."""
AT_ONCE = 512
"""Frames in which collisions are looked for at a time, for memory's sake."""
DEPTH, TOUCHING, SLIDING = range(3)
"""Kinds of marks."""


def standing(joints: Array, fps: float) -> tuple[Mask, Mask]:
    """Which toes stand, and which of these slide, as the metric FS counts them.

    (T, P, 22, 3) -> (T - 1, P, 2) bool x 2, of frames 1 to T - 1
    """
    height, fast = STANDING
    speed, low = toe_steps(torch.from_numpy(joints), fps, height)
    return low.numpy(), (low & (speed > fast)).numpy()


def touching(joints: Array) -> tuple[Index, Array]:
    """Places between hands of different people in contact, as the metric `hand_contact` counts it.

    (T, P, 22, 3) -> frames (M,), (M, 3)
    """
    hands = hand_points(torch.from_numpy(joints)).numpy()  # (T, P, 2, 3)
    apart = np.linalg.norm(hands[:, :, :, None, None] - hands[:, None, None], axis=-1)  # (T, P, 2, P, 2)
    t, p, hand, q, other = np.nonzero(apart < WITHIN)
    once = p < q
    return t[once], ((hands[t, p, hand] + hands[t, q, other]) / 2)[once]


def penetrations(joints: Array) -> tuple[Index, Array, Array, Array]:
    """Where capsules of different people overlap, as the metric IP counts them.

    (T, P, 22, 3) -> frames (M,), places (M, 3), radii of the thicker capsule (M,), depths (M,), metres
    """
    pairs = list(itertools.combinations(range(joints.shape[1]), 2))
    if not pairs:
        return np.zeros(0, dtype=int), np.zeros((0, 3)), np.zeros(0), np.zeros(0)
    if len(joints) > AT_ONCE:
        begins = range(0, len(joints), AT_ONCE)
        found = [penetrations(joints[begin : begin + AT_ONCE]) for begin in begins]
        frames = np.concatenate([begin + part[0] for begin, part in zip(begins, found, strict=True)])
        places, radii, depths = (np.concatenate(each) for each in list(zip(*found, strict=True))[1:])
        return frames, places, radii, depths
    people = torch.from_numpy(np.ascontiguousarray(joints)).float()
    one, other = (people[:, list(side)].flatten(0, 1) for side in zip(*pairs, strict=True))  # (T * pairs, 22, 3)
    depth = penetration_depth(one, other)
    n, i, j = depth.nonzero(as_tuple=True)
    a, b, radius = capsule_segments(one)
    c, d, _ = capsule_segments(other)
    first, second = nearest_points(a[n, i], b[n, i], c[n, j], d[n, j])
    thicker = torch.maximum(radius[i], radius[j])
    return (n // len(pairs)).numpy(), ((first + second) / 2).numpy(), thicker.numpy(), depth[n, i, j].numpy()


def depth_colours(depths: Array) -> Array:
    """Amber at 5 cm, where bodies begin to count as overlapping, to red from 10 cm on. (M,) metres -> (M, 3)"""
    share = np.clip((depths - TOUCH) / (DEEP - TOUCH), 0.0, 1.0)[:, None]
    return (1 - share) * np.array(SLIDES, dtype=float) + share * np.array(COLLIDES, dtype=float)


def marked(body: Body, scenes: Sequence[Scene], offsets: Sequence[Array]) -> dict[str, NDArray]:
    """Marks of takes that stand at `offsets`, sorted by frame, as a page keeps them; none of a crowd.

    Returns:
        mark_frames (M,), mark_places (M, 3) metres, and mark_facts (M, 4): take, kind, radius and depth in millimetres.
        Feet are marked where they slide.
    """
    found: list[tuple[Index, Array, Index]] = []
    shown = scenes if sum(scene.agents for scene in scenes) <= CROWD else []
    for take, (scene, offset) in enumerate(zip(shown, offsets, strict=False)):
        joints = body.joints(scene.to("cpu"))[0].float().numpy()
        deep, places, radii, depths = penetrations(joints)
        order = np.lexsort((-depths, deep))
        rank = np.arange(len(order)) - np.searchsorted(deep[order], deep[order])  # within a frame
        order = order[rank < MOST]
        hands, between = touching(joints)
        t, p, toe = np.nonzero(standing(joints, scene.fps)[1])
        feet = joints[t + 1, p][np.arange(len(t)), np.array(TOES)[toe]] * np.array([1.0, 0.0, 1.0])
        for kind, frames, at, radius, depth in (
            (DEPTH, deep[order], places[order], radii[order] + BALL, depths[order]),
            (TOUCHING, hands, between, np.full(len(hands), HAND), np.zeros(len(hands))),
            (SLIDING, t + 1, feet, np.full(len(t), DISC), np.zeros(len(t))),
        ):
            size = [np.clip((1000 * each).round(), 0, 255).astype(int) for each in (radius, depth)]
            facts = np.stack([np.full(len(frames), take), np.full(len(frames), kind), *size], axis=1)
            found.append((frames, at + offset, facts))
    found.append((np.zeros(0, dtype=int), np.zeros((0, 3)), np.zeros((0, 4), dtype=int)))
    frames, at, facts = (np.concatenate(each) for each in zip(*found, strict=True))
    order = np.argsort(frames, kind="stable")
    return {
        "mark_frames": frames[order].astype(np.uint32),
        "mark_places": at[order].astype(np.float32),
        "mark_facts": facts[order].astype(np.uint8),
    }
