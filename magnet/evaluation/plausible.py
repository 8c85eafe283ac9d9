"""Whether submitted joints can be people in metres, y up, where the inputs have them and in their order.

A score of joints in another unit, axis or order looks like a bad method's, so it is said before anything is measured.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from magnet.body.joints import ANKLES, HIPS, KNEES, NECK, PARENTS, PELVIS
from magnet.evaluation.scoring import Sight
from magnet.evaluation.seam import seam_doubts
from magnet.export.misread import ALONG

UNITS = {"mm": 0.001, "cm": 0.01, "inch": 0.0254, "foot": 0.3048}
"""Metres of each."""
LEG = (0.6, 1.15)
"""Metres from hip over knee to ankle; no two units make such a leg of one length."""
SHORT, LONG = 0.3, 1.3
"""The same of a child and of a giant."""
INSIDE = 0.1
"""Metres that pelvises of two people are not apart for most of a dance."""
OFF = 0.4
"""Metres over or under the floor that the lowest joints of people are not, most of the time."""
LONGER, ODD_BONES = 1.5, 4
"""Beside the others so many times as long as recorded: so many bones of other joints are, and none of a mean, which
shrinks."""
POINT = 0.01
"""Metres that all joints of a person do not lie within."""


def require_people(path: str, joints: Tensor, scored: Tensor) -> None:
    """Refuse joints that nobody filled in, whose unit is not the metre, or whose people do not stand along y.

    Args:
        path: what is told in the message.
        joints: (B, S, T, P, 22, 3) metres.
        scored: (T, P) bool, who counts in which frame.

    Raises:
        ValueError: says what the joints look like, and what to do.
    """
    people = joints[:, :, scored]  # (B, S, N, 22, 3)
    wide = joints.amax(dim=-2) - joints.amin(dim=-2)
    empty = (wide.amax(dim=-1) < POINT) & scored  # (B, S, T, P)
    if bool(empty.any()):
        scene, sample, frame, person = empty.nonzero()[0].tolist()
        raise ValueError(
            f"{path}: joints: all are in one place in scene {scene}, sample {sample}, frame {frame}, person {person}, "
            f"who is scored; {int(empty.sum())} such places: fill them in"
        )
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


def doubts(joints: Tensor, recorded: Tensor, names: Sequence[str], sight: Sight, fps: float) -> list[str]:
    """What is unlikely of submitted joints beside the recorded scenes, a line each.

    Args:
        joints: (B, S, T, P, 22, 3) metres, of the frames after the context.
        recorded: (B, context + T, P, 22, 3) metres.
        names: of the scenes.
        sight: what the task gives and asks for.
        fps: frames a second.
    """
    scored, pelvis = sight.generated, joints[..., PELVIS, :]
    context = recorded.shape[1] - joints.shape[2]
    people = joints[:, :, scored].flatten(1, 2)  # (B, S N, 22, 3)
    said = []
    leg = _legs(people).flatten(1).median(dim=1).values
    if _another_order(people, recorded[:, context:][:, scored]):
        said.append("bones have other lengths than in the inputs: are joints SMPL's 22, in its order?")
    elif odd := _where((leg < SHORT) | (leg > LONG), names):
        said.append(f"legs are {float(leg[odd[0]]):.2g} m long{odd[1]}; expected joints in metres")
    low = people[..., 1].amin(dim=-1).median(dim=1).values
    if odd := _where(low.abs() > OFF, names):
        where = f"the lowest joints are at {float(low[odd[0]]):.1f} m{odd[1]}"
        said.append(f"{where}; expected the floor at 0, in the world of the inputs")
    if not sight.past_is_given:  # of whom nothing is given, only being inside of who is given is impossible
        whom = scored[0].nonzero()[:, 0].tolist()
        places = {q: recorded[:, None, context:, q, PELVIS] for q in range(scored.shape[1]) if q not in whom}
        apart = [(pelvis[:, :, :, p] - place).norm(dim=-1) for p in whom for place in places.values()]
        if apart and float(torch.stack(apart).median()) < INSIDE:
            said.append("who is predicted stands where the given one does: are people in the inputs' order?")
    return [*said, *seam_doubts(joints, recorded, names, sight, fps)]


def _where(odd: Tensor, names: Sequence[str]) -> tuple[int, str] | None:
    """The first scene with something odd, and in words which have it, unless most do. (B,) bool"""
    found = odd.nonzero()[:, 0].tolist()
    if not found:
        return None
    more = f" and {len(found) - 1} more" if len(found) > 1 else ""
    return found[0], "" if 2 * len(found) > len(odd) else f" in {names[found[0]]}{more}"


def _another_order(people: Tensor, recorded: Tensor) -> bool:
    """Whether bones are too long to be those that their joints' order says. (B, N, 22, 3), (B, N', 22, 3)"""
    made, real = (_bones(each).flatten(0, 1).median(dim=0).values for each in (people, recorded))  # (21,)
    ratio = made / real
    return int((ratio > LONGER * ratio.median()).sum()) >= ODD_BONES


def _bones(joints: Tensor) -> Tensor:
    """Length from each joint but the first to its parent. (..., 22, 3) -> (..., 21)"""
    return (joints[..., 1:, :] - joints[..., PARENTS[1:], :]).norm(dim=-1)


def _legs(joints: Tensor) -> Tensor:
    """From hips over knees to ankles. (..., 22, 3) -> (..., 2)"""
    hips, knees, ankles = (joints[..., list(each), :] for each in (HIPS, KNEES, ANKLES))
    return (hips - knees).norm(dim=-1) + (knees - ankles).norm(dim=-1)
