"""Whether submitted joints can be people in metres, y up, where the inputs have them and in their order.

A score of joints in another unit, axis or order looks like a bad method's, so it is said before anything is measured.
"""

from __future__ import annotations

import torch
from torch import Tensor

from magnet.body.joints import ANKLES, HIPS, KNEES, NECK, PELVIS
from magnet.evaluation.scoring import Sight
from magnet.export.misread import ALONG, FAST

UNITS = {"mm": 0.001, "cm": 0.01, "inch": 0.0254, "foot": 0.3048}
"""Metres of each."""
LEG = (0.6, 1.15)
"""Metres from hip over knee to ankle; no two units make such a leg of one length."""
SHORT, LONG = 0.3, 1.3
"""The same of a child and of a giant."""
INSIDE = 0.1
"""Metres that pelvises of two people are not apart for most of a dance."""
FAR = 1.0
"""Metres that nobody begins from where one was, not even in a recording put there for another one."""
OFF = 0.4
"""Metres over or under the floor that the lowest joints of people are not, most of the time."""


def require_people(path: str, joints: Tensor, scored: Tensor) -> None:
    """Refuse joints whose unit is not the metre, or whose people do not stand along y.

    Args:
        path: what is told in the message.
        joints: (B, S, T, P, 22, 3) metres.
        scored: (T, P) bool, who counts in which frame.

    Raises:
        ValueError: says what the joints look like, and what to do.
    """
    people = joints[:, :, scored]  # (B, S, N, 22, 3)
    leg = float(_legs(people).median())
    unit = next((name for name, metres in UNITS.items() if LEG[0] < leg * metres < LEG[1]), None)
    if unit is not None:
        raise ValueError(
            f"{path}: joints: legs are {leg:.3g} m long, as if in {unit}: bring them to metres (times {UNITS[unit]:g})"
        )
    torso = people[..., NECK, :] - people[..., PELVIS, :]
    along = torch.nn.functional.normalize(torso, dim=-1).flatten(0, -2).mean(dim=0)
    axis = int(along.abs().argmax())
    if along[axis].abs() > ALONG and not (axis == 1 and along[axis] > 0):
        name = ("-" if along[axis] < 0 else "") + "xyz"[axis]
        raise ValueError(
            f"{path}: joints: people stand along {name} and not along y, which points up in the inputs: turn them back"
        )


def doubts(joints: Tensor, recorded: Tensor, context: int, sight: Sight, fps: float) -> list[str]:
    """What is unlikely of submitted joints beside the recorded scenes, a line each.

    Args:
        joints: (B, S, T, P, 22, 3) metres, of the frames after the context.
        recorded: (B, context + T, P, 22, 3) metres.
        context: frames before the predicted ones.
        sight: what the task gives and asks for.
        fps: frames a second.
    """
    scored, pelvis = sight.generated, joints[..., PELVIS, :]
    people = joints[:, :, scored]
    said = []
    if not SHORT < (leg := float(_legs(people).median())) < LONG:
        said.append(f"legs are {leg:.2g} m long; expected joints in metres")
    if abs(low := float(people[..., 1].amin(dim=-1).median())) > OFF:
        said.append(f"the lowest joints are at {low:.1f} m; expected the floor at 0, in the world of the inputs")
    whom = scored[0].nonzero()[:, 0].tolist()
    if not sight.past_is_given:  # of whom nothing is given, only being inside of who is given is impossible
        places = {q: recorded[:, None, context:, q, PELVIS] for q in range(scored.shape[1]) if q not in whom}
        apart = [(pelvis[:, :, :, p] - place).norm(dim=-1) for p in whom for place in places.values()]
        if apart and float(torch.stack(apart).median()) < INSIDE:
            said.append("who is predicted stands where the given one does: are people in the inputs' order?")
        return said
    last = recorded[:, None, context - 1, :, PELVIS]  # (B, 1, P, 3)
    own = (pelvis[:, :, 0] - last).norm(dim=-1)[..., whom].median()
    other = (pelvis[:, :, 0] - last.flip(-2)).norm(dim=-1)[..., whom].median()
    begin = f"people begin {float(own):.2f} m from where they were a frame before"
    if scored.shape[1] == 2 and own > FAST / fps and other < min(own / 2, FAST / fps):
        said.append(f"{begin}, where the other one was: are people in the inputs' order?")
    elif own > FAR:
        said.append(f"{begin}; expected the frames after the context, in the world of the inputs")
    return said


def _legs(joints: Tensor) -> Tensor:
    """From hips over knees to ankles. (..., 22, 3) -> (..., 2)"""
    hips, knees, ankles = (joints[..., list(each), :] for each in (HIPS, KNEES, ANKLES))
    return (hips - knees).norm(dim=-1) + (knees - ankles).norm(dim=-1)
