"""`synthesize`: scenes of people who are coupled in a known way."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch

from magnet.body import Body
from magnet.motion.frames import from_planar
from magnet.motion.scene import FPS, Scene
from magnet.synthesis.handshake import handshake
from magnet.synthesis.imitation import follow, mirror
from magnet.synthesis.people import People, gather, uniform
from magnet.synthesis.planning import PAD, Truth
from magnet.synthesis.pose import Plan, embody
from magnet.synthesis.ring import circle, patty_cake
from magnet.threads import one_thread


@dataclass(frozen=True)
class Coupling:
    """A builder of scenes and the group sizes that it supports."""

    plan: Callable[[People, int, torch.Generator], tuple[Plan, Truth]]
    fewest: int
    most: int


COUPLINGS = {
    "mirror": Coupling(mirror, fewest=1, most=6),
    "follow": Coupling(follow, fewest=1, most=6),
    "handshake": Coupling(handshake, fewest=2, most=4),
    "circle": Coupling(circle, fewest=2, most=8),
    "patty_cake": Coupling(patty_cake, fewest=2, most=8),
}


FEWEST_FRAMES = 120
"""Shorter scenes have no room for an approach, a handshake and a parting."""


@dataclass(frozen=True)
class CoupledScene:
    """A scene and the closed form of its coupling; each builder documents its `truth`."""

    scene: Scene
    coupling: str
    truth: Truth


def synthesize(coupling: str, people: int, frames: int, generator: torch.Generator, body: Body) -> CoupledScene:
    """One scene (B = 1) of people coupled in a known way, at 30 fps; the same generator state, the same scene.

    Args:
        coupling: a name in `COUPLINGS`.
        people: P.
        frames: T, at least 120.
        generator: CPU generator of all variation: bodies, manners, paths, rhythms, noise.
        body: body of the people.

    Raises:
        ValueError: no such coupling, or a group size or length that it does not support.

    >>> from magnet.body import load_body
    >>> made = synthesize("mirror", 2, 120, torch.Generator().manual_seed(0), load_body())
    >>> made.scene.frames, made.scene.agents
    (120, 2)
    """
    if coupling not in COUPLINGS:
        raise ValueError(f"coupling {coupling!r}: expected one of {', '.join(COUPLINGS)}")
    kind = COUPLINGS[coupling]
    if not kind.fewest <= people <= kind.most:
        raise ValueError(f"coupling {coupling!r}: got {people} people, expected {kind.fewest} to {kind.most}")
    if frames < FEWEST_FRAMES:
        raise ValueError(f"got {frames} frames, expected at least {FEWEST_FRAMES}; make more and cut the scene")
    with one_thread():
        group = gather(people, generator, body)
        plan, truth = kind.plan(group, frames, generator)
        body_rot, T_world_root = embody(plan, group, generator)
    keep = slice(PAD, PAD + frames)
    turn = uniform(generator, -math.pi, math.pi)
    T_world_plan = from_planar(turn, torch.zeros(2, dtype=torch.float64))
    scene = Scene(
        body_rot=body_rot[keep][None].float(),
        T_world_root=(T_world_plan @ T_world_root[keep])[None].float(),
        betas=group.betas[None],
        present=torch.ones(1, people, dtype=torch.bool),
        fps=FPS,
        body=body.id,
        names=(f"{coupling} of {people}",),
    )
    return CoupledScene(scene, coupling, truth)
