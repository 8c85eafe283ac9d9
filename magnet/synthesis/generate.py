"""`synthesize`: scenes of people who are coupled in a known way."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from magnet.body import Body
from magnet.motion.frames import from_planar
from magnet.motion.scene import FPS, Scene
from magnet.synthesis.couplings import COUPLINGS
from magnet.synthesis.people import gather, uniform
from magnet.synthesis.planning import PAD, Truth
from magnet.synthesis.pose import embody
from magnet.threads import one_thread

FEWEST_FRAMES = 120
"""Shorter scenes have no room for an approach, a handshake and a parting."""


@dataclass(frozen=True)
class CoupledScene:
    """A scene and the closed form of its coupling; each builder says what its `truth` holds."""

    scene: Scene
    coupling: str
    truth: Truth


def synthesize(coupling: str, people: int, frames: int, generator: torch.Generator, body: Body) -> CoupledScene:
    """One scene (B = 1) of people coupled in a known way, at 30 fps; the same generator state, the same scene.

    Args:
        coupling: a name in `COUPLINGS`.
        people: P.
        frames: T, at least 120.
        generator: on the CPU; all that varies comes from it: bodies, manners, paths, rhythms, noise.
        body: whose shape numbers and joints at rest are used.

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
