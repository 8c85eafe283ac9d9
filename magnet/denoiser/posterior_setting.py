"""What a posterior of deltas and pairwise transforms takes from everything but tokens."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from magnet.motion.frames import partners
from magnet.motion.pose_graph import PoseGraph
from magnet.motion.tokens import TokenLayout
from magnet.waiting import may_look


@dataclass(frozen=True)
class SlotsInUse:
    """Where a batch's people are: as many slots of each scene as the fullest needs, those with people first.

    Attributes:
        layout: of tokens with so many slots, P below.
        slots: (B, P) int.
        groups: (B, P, P) int, an agent's own group and those of its partners.
        together: (B, P, P - 1) bool, whether an agent and its partner are both present.
    """

    layout: TokenLayout
    slots: Tensor
    groups: Tensor
    together: Tensor

    @classmethod
    def of(cls, present: Tensor, layout: TokenLayout) -> SlotsInUse:
        # On a GPU all slots: counting people would have to wait for it.
        most = max(2, int(present.sum(dim=1).max())) if may_look(present.device) else layout.agents
        slots = (~present).int().argsort(dim=1, stable=True)[:, :most]
        own, other = slots[..., None], slots[:, partners(most, present.device)]
        groups = torch.cat([torch.zeros_like(own), other + (other < own)], dim=-1)
        small = replace(layout, agents=most)
        return cls(small, slots, groups, small.group_present(present.gather(1, slots))[..., 1:])

    def levels(self, levels: Tensor) -> Tensor:
        """(B, N, P of the batch) -> (B, N, P)"""
        return levels.gather(2, self.slots[:, None].expand(-1, levels.shape[1], -1))

    def where(self, scenes: int, steps: int) -> tuple[Tensor | slice, ...]:
        """Index of the transforms of those in use, into (scenes, steps, P of the batch, groups, ...)."""
        if len(self.slots) == 1:
            return slice(None), slice(None), self.slots[0, :, None], self.groups[0]
        scene, step = (torch.arange(count, device=self.slots.device) for count in (scenes, steps))
        return scene[:, None, None, None], step[:, None, None], self.slots[:, None, :, None], self.groups[:, None]


@dataclass(frozen=True)
class Setting:
    """What a posterior takes from levels, from who is present and from how tokens are normalized.

    Attributes:
        people: P of them below. B is 1 where all scenes are alike.
        mean, std: (B, 1, P, P, 4, 9) of deltas and pairwise transforms.
        rescaling: (B, N, P, P, 4, 9) what noisy ones are multiplied by to estimate clean ones, in real units.
        deltas: (B, N, P, P, 1, 1) bool, where deltas are shown clean.
        met: (B, 1, P, P, 1, 1) bool, what changes.
        second: (2, B, T, P) precisions of shown deltas: yaws, ground positions.
        share: (2, B, T, P, P - 1) weight of shown pairwise transforms against predicted ones: yaws, ground positions.
        graph: precisions.
    """

    people: SlotsInUse
    mean: Tensor
    std: Tensor
    rescaling: Tensor
    deltas: Tensor
    met: Tensor
    second: Tensor
    share: Tensor
    graph: PoseGraph
