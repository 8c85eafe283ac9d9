"""A crowd's poses are corrected: pairs by themselves, then the moments in which two are still in each other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from magnet.body.apart import APART, ARM_REACH, excess_depth, near_pairs
from magnet.body.repair import repaired
from magnet.body.settle import LEAD
from magnet.generation.separation import open_body_on
from magnet.generation.settling import FINISHED, Corrected, settled_chunk
from magnet.motion.runs import true_runs
from magnet.motion.scene import Scene, concatenate

ROUNDS = 3
"""How often all moments are settled: whoever makes way for one may step into another."""

AROUND = 20
"""Frames before and after a moment in which people make way; two moments less than that apart are one."""

BESIDE = 6
"""Others who stand by at most, as they are, so that nobody makes way into them."""


SettledGroups = dict[int, Corrected]
"""How the last chunk of groups was corrected, by how many people they are of."""


class Encounter(NamedTuple):
    """Two people who are in each other in the frames [start, stop), or nearly all of them."""

    one: int
    other: int
    start: int
    stop: int


def bonded_groups(bonds: Tensor, present: Tensor, most: int) -> list[tuple[int, ...]]:
    """Who belongs together: those whom bonds join; each alone where they are more than `most`.

    bonds (P, P) bool, present (P,) bool -> everybody who is there, in one group each

    >>> bonds = torch.zeros(4, 4, dtype=torch.bool)
    >>> bonds[0, 2] = bonds[2, 0] = True
    >>> bonded_groups(bonds, torch.tensor([True, True, True, False]), 4)
    [(0, 2), (1,)]
    """
    groups: list[tuple[int, ...]] = []
    left = present.nonzero()[:, 0].tolist()
    while left:
        group, new = {left[0]}, {left[0]}
        while new:
            new = {q for p in new for q in bonds[p].nonzero()[:, 0].tolist() if q in left} - group
            group |= new
        left = [p for p in left if p not in group]
        groups += [tuple(sorted(group))] if len(group) <= most else [(p,) for p in sorted(group)]
    return groups


def settled_groups(
    scene: Scene, groups: Sequence[tuple[int, ...]], how: str, past: SettledGroups
) -> tuple[Scene, SettledGroups]:
    """A chunk of a crowd whose groups are corrected as scenes of their own are: feet, floor, hands and each other.

    Args:
        scene: (1, T, P), with what is `given`, which stays.
        groups: the same for all chunks.
        how: `light`, `firm` or `hold`.
        past: what the last call returned; empty: the chunk is the first.

    Returns:
        The scene, and how its last frames were corrected.
    """
    given = torch.zeros_like(scene.T_world_root[..., 0, 0], dtype=torch.bool) if scene.given is None else scene.given
    body_rot, root, now = scene.body_rot.clone(), scene.T_world_root.clone(), SettledGroups()
    for size in sorted({len(group) for group in groups}):
        who = torch.tensor([group for group in groups if len(group) == size], device=scene.device)  # (G, size)
        parts = [scene.permute_agents(each).replace(given=None, valid=None, names=()) for each in who]
        fixed = torch.stack([given[0][:, each] for each in who])
        made, now[size] = settled_chunk(concatenate(parts), fixed, how, past.get(size))
        body_rot[0, :, who.flatten()] = made.body_rot.transpose(0, 1).flatten(1, 2)
        root[0, :, who.flatten()] = made.T_world_root.transpose(0, 1).flatten(1, 2)
    return scene.replace(body_rot=body_rot, T_world_root=root), now


@torch.no_grad()
def settled_moments(scene: Scene) -> Scene:
    """A crowd out of each other's bodies: `apart` moves whole people over longer stretches and sees no quick passes.

    scene (1, T, P), with what is `given`, which stays; None: nothing
    """
    body, moved = open_body_on(scene.device), False
    for _ in range(ROUNDS):
        joints = body.joints(scene.replace(body=body.id, valid=None, given=None))[0]
        moments = deep_moments(joints, scene.present[0])
        if not moments:
            break
        if not moved:
            scene = scene.replace(body_rot=scene.body_rot.clone(), T_world_root=scene.T_world_root.clone())
        moved = True
        for moment in moments:
            _settle(scene, moment, joints[:, :, 0, [0, 2]])
    return scene


def deep_moments(joints: Tensor, present: Tensor) -> list[Encounter]:
    """When who is deeper in whom than `light` allows. joints (T, P, 22, 3), present (P,) bool"""
    people, found = joints.transpose(0, 1), []
    for one, other in zip(*(each.tolist() for each in near_pairs(people, present)), strict=True):
        ground = (people[one, :, 0] - people[other, :, 0])[:, [0, 2]]
        near = (ground.norm(dim=-1) < ARM_REACH / 2).nonzero()[:, 0]
        deep = near[excess_depth(people[one, near], people[other, near], APART["light"]) > 0]
        inside = torch.zeros(len(joints), dtype=torch.bool)
        for frame in deep.tolist():
            inside[max(frame - AROUND // 2, 0) : frame + AROUND // 2 + 1] = True
        found += [Encounter(one, other, *run) for run in true_runs(inside.tolist())]
    return found


def _settle(scene: Scene, moment: Encounter, ground: Tensor) -> None:
    """Settle one moment of a scene in place. ground (T, P, 2): where people are"""
    body = open_body_on(scene.device)
    start, stop = max(moment.start - AROUND // 2, 0), min(moment.stop + AROUND // 2, scene.frames)
    two = torch.tensor([moment.one, moment.other], device=scene.device)
    away = torch.cdist(ground[start:stop, two], ground[start:stop]).amin(dim=(0, 1))
    away = torch.where(scene.present[0], away, torch.inf)
    away[two] = torch.inf
    beside = away.argsort()[:BESIDE]
    part = scene.slice(start, stop).permute_agents(torch.cat([two, beside[away[beside] < ARM_REACH]]))
    fixed = torch.zeros_like(part.T_world_root[0, ..., 0, 0], dtype=torch.bool) if part.given is None else part.given[0]
    fixed = fixed.clone()
    fixed[:, 2:] = True
    fixed[: LEAD * (start > 0)] = True
    fixed[len(fixed) - LEAD * (stop < scene.frames) :] = True
    part = part.replace(body=body.id, valid=None, given=None, names=())
    made = repaired(part, body, "firm", fixed, FINISHED, drifting=False)
    scene.body_rot[:, start:stop, two], scene.T_world_root[:, start:stop, two] = (
        made.body_rot[:, :, :2],
        made.T_world_root[:, :, :2],
    )
