"""Scenes at another frame rate, and people of several files in one scene."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from magnet.motion.frames import rigid
from magnet.motion.resample import slerp
from magnet.motion.scene import Scene


def resampled(scene: Scene, fps: float) -> Scene:
    """The same motion at exact times t = i / fps: slerp between rotations, straight lines between positions.

    A frame between two of which one is not valid is not valid; one between two of which one was not given to a model
    was not given either.

    Raises:
        ValueError: the rate is not positive.

    >>> from magnet.motion.scene import empty_scene
    >>> resampled(empty_scene(1, 61, 2, like=torch.zeros(())), 15.0).frames
    31
    """
    if not 0 < fps < math.inf:
        raise ValueError(f"fps: got {fps:g}, expected more than 0")
    if abs(fps - scene.fps) < 1e-6 * fps:
        return scene
    if not scene.frames:
        return scene.replace(fps=float(fps))
    frames = math.floor((scene.frames - 1) / scene.fps * fps + 1e-6) + 1
    at = torch.arange(frames, dtype=torch.float64) * (scene.fps / fps)
    low = (at + 1e-9).floor().long().clamp(max=scene.frames - 1)
    high = (low + 1).clamp(max=scene.frames - 1)
    share = (at - low).clamp(0.0, 1.0).to(scene.T_world_root)
    share = torch.where(share < 1e-6, torch.zeros_like(share), share)  # a frame that is there comes back as it is
    low, high = low.to(scene.device), high.to(scene.device)
    place = scene.T_world_root[..., :3, 3]
    moved = torch.lerp(place[:, low], place[:, high], share[:, None, None])
    turned = _slerp(scene.T_world_root[..., :3, :3], low, high, share)
    exact = share == 0
    valid = None if scene.valid is None else scene.valid[:, low] & (scene.valid[:, high] | exact)
    given = None if scene.given is None else scene.given[:, low] & (scene.given[:, high] | exact[:, None])
    body_rot = _slerp(scene.body_rot, low, high, share)
    return scene.replace(body_rot=body_rot, T_world_root=rigid(turned, moved), valid=valid, given=given, fps=float(fps))


def _slerp(rotation: Tensor, low: Tensor, high: Tensor, share: Tensor) -> Tensor:
    """(B, T, ..., 3, 3) at fractional frames -> (B, frames, ..., 3, 3)"""
    start = rotation[:, low]
    between = share > 0
    if not bool(between.any()):
        return start
    first = start[:, between]
    part = share[between].reshape(1, -1, *[1] * (first.dim() - 4))
    start[:, between] = slerp(first, rotation[:, high[between]], part)
    return start


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
    return people[0].replace(
        body_rot=torch.cat([person.body_rot for person in people], dim=2),
        T_world_root=torch.cat([person.T_world_root for person in people], dim=2),
        betas=torch.cat([person.betas for person in people], dim=1),
        present=torch.cat([person.present for person in people], dim=1),
        valid=valid,
        given=None if given is None else torch.cat(given, dim=2),
        names=people[0].names,
    )


def _each(labels: Sequence[str], what: Sequence[str]) -> str:
    return ", ".join(f"{label} {value}" for label, value in zip(labels, what, strict=True))
