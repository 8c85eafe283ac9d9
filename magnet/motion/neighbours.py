"""Each person's nearest partners in a crowd, and the small groups that a model sees."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import torch
from torch import Tensor

from magnet.motion.frames import partners
from magnet.motion.tokens import TokenLayout

ENTER, LEAVE = 1.5, 2.2
"""Metres over the ground: who comes nearer than the first becomes a partner, who goes beyond the second stops being
one. With 2.5 and 3.5 strangers crowd together, because the model learned from couples (docs/crowds.md)."""


@dataclass(frozen=True)
class CrowdLayout(TokenLayout):
    """Tokens of more people than a token has partner slots: each slot points at somebody near.

    Attributes:
        table: (P, K) whom the slots of each person point at; the person's own number where at nobody.
    """

    table: tuple[tuple[int, ...], ...] = ()

    @property
    def slots(self) -> int:
        return len(self.table[0]) if self.pairwise else 0

    def partners(self, device: torch.device | None = None) -> Tensor:
        return _table(self.table, device)

    def group_present(self, present: Tensor) -> Tensor:
        there = super().group_present(present)
        if self.slots:
            partner = self.partners(present.device)
            there[..., 1:] &= partner != torch.arange(self.agents, device=present.device)[:, None]
        return there

    @classmethod
    def of(cls, layout: TokenLayout, table: Tensor) -> CrowdLayout:
        """Tokens of a model's layout with their slots pointed at other people. table (P, layout.slots) int"""
        rows = tuple(tuple(row) for row in table.tolist())
        return cls(layout.latent, len(table), layout.pairwise, layout.pairwise_noise, rows)


@functools.lru_cache(maxsize=8)
def _table(table: tuple[tuple[int, ...], ...], device: torch.device | None) -> Tensor:
    with torch.inference_mode(False):
        return torch.tensor(table, device=device)


def nearest_partners(
    ground: Tensor, present: Tensor, before: Tensor, bonds: Tensor, enter: float = ENTER, leave: float = LEAVE
) -> Tensor:
    """Each person's nearest partners; a partner of before stays one until further away than `leave`.

    Distances to partners of before count as `leave - enter` shorter, so that partners do not change to and fro. Those
    who stay keep their slots; the other slots go to the new ones.

    Args:
        ground: (P, 2) metres, where people are.
        present: (P,) bool.
        before: (P, K) int, the partners until now; one's own number: nobody.
        bonds: (P, P) bool, who belong together: partners however far away.
        enter, leave: metres.

    Returns:
        (P, K) int.

    >>> ground = torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.4, 0.0], [9.0, 0.0]])
    >>> nobody = torch.arange(4)[:, None].repeat(1, 2)
    >>> everybody, strangers = torch.ones(4, dtype=torch.bool), torch.zeros(4, 4, dtype=torch.bool)
    >>> nearest_partners(ground, everybody, nobody, strangers)  # 0 and 2 are 2.4 m apart, and nobody is near 3
    tensor([[1, 0],
            [0, 2],
            [1, 2],
            [3, 3]])
    """
    P, K = before.shape
    person = torch.arange(P, device=ground.device)
    away = (ground[:, None] - ground[None]).norm(dim=-1)
    away = away - (leave - enter) * torch.zeros_like(away).scatter(1, before, 1.0)
    both = present[:, None] & present & (person[:, None] != person)  # who is absent may be anywhere
    farthest = torch.where(both, away, 0.0).amax()
    away = torch.where(bonds, away - 2 * farthest.clamp_min(1.0), away)
    away = torch.where(both, away, torch.inf)
    near, wanted = away.topk(min(K, P), dim=1, largest=False)
    wanted = torch.where(near <= enter, wanted, person[:, None])
    if K > P:
        wanted = torch.cat([wanted, person[:, None].expand(P, K - P)], dim=1)
    chosen = before.clone()
    changed = (wanted.sort(dim=1).values != before.sort(dim=1).values).any(dim=1)
    for p in changed.nonzero()[:, 0].tolist():
        now = [q for q in wanted[p].tolist() if q != p]
        row = [q if q in now else p for q in before[p].tolist()]
        new = iter([q for q in now if q not in row])
        chosen[p] = torch.tensor([next(new, p) if q == p else q for q in row])
    return chosen


@dataclass(frozen=True)
class CrowdViews:
    """The groups that a model looks at: each person with their partners; people of the same group share a view.

    Attributes:
        people: (V, M) int, who is in each slot of each view, in the order of their numbers; 0 where the slot is free.
        present: (V, M) bool.
        pair: (V, M, M - 1) int, which slot of a person's token points at each partner; -1: none does.
        view, slot: (P,) int, where each person is read from.
        partner_slot: (P, K) int, which partner slot of that view each of a person's slots is; -1: nobody's.
        ego: (V,) int, a person of the view whose partners all others of it are.
    """

    people: Tensor
    present: Tensor
    pair: Tensor
    view: Tensor
    slot: Tensor
    partner_slot: Tensor
    ego: Tensor

    @classmethod
    def of(cls, table: Tensor, present: Tensor, slots: int) -> CrowdViews:
        """table (P, slots - 1) int as `nearest_partners` has it, present (P,) bool, slots M of the model."""
        P, device = len(table), table.device
        if slots >= P:  # a small group is one view, with its slots as they are
            egos, view = {tuple(range(P)): 0}, [0] * P
        else:
            sets = [tuple(sorted({p, *row})) for p, row in enumerate(table.tolist())]
            egos = {}  # of each group, the first who is there
            for p in present.nonzero()[:, 0].tolist():
                egos.setdefault(sets[p], p)
            place = {group: number for number, group in enumerate(egos)}
            view = [place.get(group, 0) for group in sets]
        groups = list(egos)
        people = torch.tensor([[*group, *[0] * (slots - len(group))] for group in groups], device=device)
        taken = torch.tensor([[slot < len(group) for slot in range(slots)] for group in groups], device=device)
        in_view = torch.tensor(view, device=device)
        person = torch.arange(P, device=device)
        slot = ((people[in_view] == person[:, None]) & taken[in_view]).int().argmax(dim=1)
        other = partners(slots, device)  # (M, M - 1)
        points = table[people][:, :, None] == people[:, other][..., None]  # (V, M, M - 1, K)
        points &= (taken[:, :, None] & taken[:, other])[..., None]
        pair = torch.where(points.any(dim=-1), points.int().argmax(dim=-1), -1)
        mine = people[in_view][person[:, None], other[slot]]  # (P, M - 1)
        meant = (table[:, :, None] == mine[:, None]) & taken[in_view][person[:, None], other[slot]][:, None]
        meant &= (table != person[:, None])[..., None]
        partner_slot = torch.where(meant.any(dim=-1), meant.int().argmax(dim=-1), -1)
        ego = torch.tensor(list(egos.values()), device=device)
        return cls(people, taken & present[people], pair, in_view, slot, partner_slot, ego)
