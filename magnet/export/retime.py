"""People of several files put into one scene, at one frame rate and length."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from magnet.motion.resample import resampled
from magnet.motion.scene import Scene, cat_agents


def together(people: Sequence[Scene], labels: Sequence[str], *, fps: float | None = None, trim: bool = False) -> Scene:
    """Several people, each a scene with B = 1, as one scene in one world.

    Args:
        labels: what to call each in errors, such as its file.
        fps: bring all to this rate; None: they must agree.
        trim: cut all to the shortest; else lengths must agree.

    Raises:
        ValueError: rates, lengths or bodies differ.
    """
    if fps is not None:
        people = [resampled(person, fps) for person in people]
    rates = {person.fps for person in people}
    if len(rates) > 1:
        raise ValueError(
            f"frame rates differ: {_each(labels, [f'{person.fps:g} fps' for person in people])}; "
            f"bring all to one with --fps 30 (fps=30)"
        )
    bodies = {person.body for person in people}
    if len(bodies) > 1:
        raise ValueError(f"bodies differ: {_each(labels, [person.body for person in people])}")
    shortest = min(person.frames for person in people)
    if not trim and any(person.frames != shortest for person in people):
        raise ValueError(
            f"lengths differ: {_each(labels, [f'{person.frames} frames' for person in people])}; people of one scene "
            f"share their frames: cut all to the shortest with --trim (trim=True)"
        )
    people = [person.slice(0, shortest) for person in people]
    valid = None
    if any(person.valid is not None for person in people):
        all_good = torch.ones(1, shortest, dtype=torch.bool)
        valid = torch.stack([all_good if p.valid is None else p.valid for p in people]).all(dim=0)
    given = None
    if any(person.given is not None for person in people):
        given = [
            torch.zeros_like(p.T_world_root[..., 0, 0], dtype=torch.bool) if p.given is None else p.given
            for p in people
        ]
    return cat_agents(people).replace(valid=valid, given=None if given is None else torch.cat(given, dim=2))


def _each(labels: Sequence[str], what: Sequence[str]) -> str:
    return ", ".join(f"{label} {value}" for label, value in zip(labels, what, strict=True))
