"""A crowd's partners are near, stay while they are near, and make views that everybody is read from."""

from __future__ import annotations

import pytest
import torch

from magnet.motion.frames import partners
from magnet.motion.neighbours import ENTER, LEAVE, CrowdLayout, CrowdViews, nearest_partners
from magnet.motion.tokens import TokenLayout


def crowd(people: int, spread: float, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """ground, present, before, bonds of people who have had no partners"""
    ground = spread * torch.rand(people, 2, generator=torch.Generator().manual_seed(seed))
    nobody = torch.arange(people)[:, None].repeat(1, 3)
    return ground, torch.ones(people, dtype=torch.bool), nobody, torch.zeros(people, people, dtype=torch.bool)


def test_partners_are_the_nearest_within_reach() -> None:
    ground, present, before, bonds = crowd(40, 12.0)
    present[7] = False
    table = nearest_partners(ground, present, before, bonds)
    for p in range(40):
        away = [(float((ground[p] - ground[q]).norm()), q) for q in range(40) if q not in (p, 7)]
        near = [q for metres, q in sorted(away)[:3] if metres <= ENTER] if p != 7 else []
        assert sorted(q for q in table[p].tolist() if q != p) == sorted(near)


@pytest.mark.parametrize("people", [1, 2, 3])
def test_slots_beyond_all_others_point_at_nobody(people: int) -> None:
    table = nearest_partners(*crowd(people, 0.5))
    assert table.shape == (people, 3)
    for p, row in enumerate(table.tolist()):
        assert sorted(row) == sorted([q for q in range(people) if q != p] + [p] * (4 - people))


@pytest.mark.parametrize(("metres", "stays"), [(ENTER + 0.1, True), (LEAVE - 0.1, True), (LEAVE + 0.1, False)])
def test_a_partner_stays_until_further_away_than_one_enters(metres: float, stays: bool) -> None:
    ground, present, before, bonds = crowd(5, 0.0)
    ground[:, 0] = torch.tensor([0.0, 1.0, metres, 100.0, 200.0])
    strangers = nearest_partners(ground, present, before, bonds)
    assert 2 not in strangers[0]
    before[0] = torch.tensor([2, 1, 0])
    table = nearest_partners(ground, present, before, bonds)
    assert (2 in table[0]) == stays
    assert table[0, 1] == 1, "who stays keeps the slot"


def test_a_bond_holds_however_far_away() -> None:
    ground, present, before, bonds = crowd(30, 3.0)
    ground[29] = torch.tensor([500.0, 0.0])
    bonds[0, 29] = bonds[29, 0] = True
    table = nearest_partners(ground, present, before, bonds)
    assert 29 in table[0] and 0 in table[29]


@pytest.mark.parametrize("place", [1e8, float("inf"), float("nan")])
def test_wherever_somebody_absent_lies_nobody_else_has_other_partners(place: float) -> None:
    ground, present, before, bonds = crowd(12, 3.0)
    present[7] = False
    bonds[0, 5] = bonds[5, 0] = True
    table = nearest_partners(ground, present, before, bonds)
    ground[7] = place
    assert torch.equal(nearest_partners(ground, present, before, bonds), table)


@pytest.mark.parametrize("absent", [0, 1])
@pytest.mark.parametrize("people", [5, 17, 60])
def test_everybody_is_read_from_a_view_with_the_own_partners(people: int, absent: int) -> None:
    ground, present, before, bonds = crowd(people, people**0.5, seed=people)
    present[absent] = False
    table = nearest_partners(ground, present, before, bonds)
    views = CrowdViews.of(table, present, 4)
    assert len(views.people) <= int(present.sum()), "no more views than people"
    for p in present.nonzero()[:, 0].tolist():
        v, a = int(views.view[p]), int(views.slot[p])
        assert views.people[v, a] == p and views.present[v, a]
        assert set(views.people[v][views.present[v]].tolist()) == {p, *table[p].tolist()}
        for s, q in enumerate(table[p].tolist()):
            b = int(views.partner_slot[p, s])
            assert (b >= 0) == (q != p)
            if q != p:
                assert views.people[v, partners(4)[a, b]] == q and views.pair[v, a, b] == s
    for who, there, ego in zip(views.people, views.present, views.ego.tolist(), strict=True):
        assert ego in who[there], "a view's ego is one of those in it"


def test_a_small_group_is_one_view_as_it_is() -> None:
    views = CrowdViews.of(partners(4), torch.tensor([True, True, False, False]), 4)
    assert views.people.tolist() == [[0, 1, 2, 3]] and views.present.tolist() == [[True, True, False, False]]
    assert torch.equal(views.pair[0], torch.arange(3).expand(4, 3)) and torch.equal(views.partner_slot, views.pair[0])


def test_a_crowds_tokens_are_those_of_a_small_group_whose_slots_point_at_everybody() -> None:
    layout = TokenLayout(8, 4)
    crowded = CrowdLayout.of(layout, partners(4))
    levels, present = torch.tensor([0, 10, 500, 1000]), torch.tensor([[True, True, False, True]])
    assert crowded.width == layout.width and crowded.slots == 3
    assert torch.equal(crowded.group_levels(levels), layout.group_levels(levels))
    assert torch.equal(crowded.group_present(present), layout.group_present(present))
