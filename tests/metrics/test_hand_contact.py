"""Contact of hands against a plain loop; how long they hold; what given frames mean for a hold."""

import itertools
import math

import numpy as np
import pytest
import torch
from torch import Tensor

from magnet.metrics import HandContact, hand_distance, hand_points

from .batches import WHO, Batch, Choose, draw_batch, pair_places, result

WITHIN = 0.35
"""Metres: the made-up joints of the loop below touch often enough, and not always."""


def touching(one: np.ndarray, other: np.ndarray) -> bool:
    hands = []
    for body in (one, other):
        for elbow, wrist in ((18, 20), (19, 21)):
            along = body[wrist] - body[elbow]
            hands.append(body[wrist] + 0.08 * along / math.sqrt(float(along @ along)))
    return min(math.dist(a, b) for a, b in itertools.product(hands[:2], hands[2:])) < WITHIN


def expected(batch: Batch, choose: Choose) -> dict[str, float]:
    generated, truth = batch[0].double().numpy(), batch[1].double().numpy()
    S, _, T = generated.shape[:3]
    places = pair_places(batch, choose)
    made, real, both, lengths, long = 0, 0, 0, [], 0
    for s, (b, p, q) in itertools.product(range(S), sorted({(b, p, q) for b, _, p, q in places})):
        contact = [touching(generated[s, b, t, p], generated[s, b, t, q]) for t in range(T)]
        scored = [t for c, t, i, j in places if (c, i, j) == (b, p, q)]
        recorded = [t for t in scored if touching(truth[b, t, p], truth[b, t, q])]
        made += sum(contact[t] for t in scored)
        real += len(recorded)
        both += sum(contact[t] for t in recorded)
        for start in range(T):
            if not contact[start] or (start and contact[start - 1]):
                continue
            end = start
            while end < T and contact[end]:
                end += 1
            inside = [t for t in scored if start <= t < end]
            lengths += [(end - start) / 8] if inside else []
            long += len(inside) if end - start > 8 else 0
    return {
        "hand_contact": made / (len(places) * S),
        "hand_contact_precision": both / made,
        "hand_contact_recall": both / real,
        "hand_hold": float(np.mean(lengths)),
        "hand_hold_long": long / made,
    }


@WHO
def test_hand_contact_equals_a_plain_loop(choose: Choose) -> None:
    batch = draw_batch(scenes=4, frames=32)
    wanted = expected(batch, choose)
    assert all(0 < wanted[name] < 1 for name in wanted if name != "hand_hold"), wanted
    got = result(HandContact(fps=8.0, within=WITHIN), *batch, agents=choose(batch))
    assert got == pytest.approx(wanted, abs=1e-12)


def reaching(apart: list[float]) -> Tensor:
    """Two people, forearms along x, whose nearest hands' middles are so far apart in each frame. -> (1, T, 2, 22, 3)"""
    joints = torch.zeros(1, len(apart), 2, 22, 3, dtype=torch.float64)
    joints[..., 1] = 10.0 * torch.arange(22)  # every joint far from every other
    for wrist, elbow in ((20, 18), (21, 19)):
        joints[..., elbow, :] = joints[..., wrist, :] - torch.tensor([0.25, 0.0, 0.0])
    joints[:, :, 1, :, 2] = torch.tensor(apart, dtype=torch.float64)[:, None]
    return joints


BOTH = torch.ones(1, 2, dtype=torch.bool)


def test_a_hand_lies_beyond_the_wrist_along_the_forearm() -> None:
    body = reaching([0.5])[0, 0, 0]
    torch.testing.assert_close(hand_points(body)[0] - body[20], torch.tensor([0.08, 0.0, 0.0]).double())
    assert float(hand_distance(body, reaching([0.5])[0, 0, 1])) == pytest.approx(0.5)


def test_holds_are_as_long_as_they_last_and_one_second_is_not_over_one_second() -> None:
    near, far = [0.1], [0.3]
    joints = reaching(near * 30 + far + near * 31 + far * 2 + near * 5 + far)
    got = result(HandContact(), joints[None], joints, BOTH)
    assert got["hand_contact"] == pytest.approx(66 / 70)
    assert got["hand_hold"] == pytest.approx((30 + 31 + 5) / 3 / 30)
    assert got["hand_hold_long"] == pytest.approx(31 / 66)
    assert got["hand_contact_precision"] == got["hand_contact_recall"] == 1


def test_each_sample_is_compared_with_the_recording_frame_by_frame() -> None:
    truth = reaching([0.1] * 4 + [0.5] * 4)
    generated = torch.stack([reaching([0.1] * 2 + [0.5] * 6), reaching([0.5] * 3 + [0.1] * 3 + [0.5] * 2)])
    got = result(HandContact(), generated, truth, BOTH)
    assert got["hand_contact"] == pytest.approx(5 / 16)
    assert got["hand_contact_precision"] == pytest.approx(3 / 5)
    assert got["hand_contact_recall"] == pytest.approx(3 / 8)


def test_a_hold_runs_through_given_frames_and_given_holds_do_not_count() -> None:
    """Ten frames generated in the middle of a hold of 40; another hold is given whole."""
    joints = reaching([0.1] * 40 + [0.5] * 5 + [0.1] * 7)
    agents = torch.zeros(52, 2, dtype=torch.bool)
    agents[15:25, 1] = True
    got = result(HandContact(), joints[None], joints, BOTH, agents=agents)
    assert got["hand_hold"] == pytest.approx(40 / 30)
    assert got["hand_hold_long"] == 1 and got["hand_contact"] == 1


def test_two_absent_people_hold_no_hands() -> None:
    """Absent agents are zeros: in one place, and so in contact, if anybody looked."""
    joints = reaching([0.5] * 6)
    wide = torch.cat([joints, torch.full_like(joints, math.nan)], dim=2)
    got = result(HandContact(), wide[None], wide, torch.tensor([[True, True, False, False]]))
    assert got == {"hand_contact": 0.0}


def test_the_recordings_own_row_has_nothing_to_be_right_about() -> None:
    joints = reaching([0.1, 0.5])
    assert set(result(HandContact(of="truth"), joints[None], joints, BOTH)) == {
        "hand_contact",
        "hand_hold",
        "hand_hold_long",
    }
