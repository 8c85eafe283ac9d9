"""Interpenetration: segment distances right in every degenerate case, depths as a plain loop finds them."""

import itertools

import numpy as np
import pytest
import scipy.optimize
import torch
from torch import Tensor

from magnet.body.capsules import CAPSULES
from magnet.body.contact import FOREARMS
from magnet.metrics import Interpenetration, penetration_depth, segment_distance
from tests.cases import few

from .batches import WHO_SLOWLY, Choose, crowd, gridded, scored


def brute_force(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> float:
    """Distance from a point of a-b to c-d is convex along a-b, so a fine grid and golden section find its least."""
    a, b, c, d = (x.double().numpy() for x in (a, b, c, d))

    def from_point(share: float) -> float:
        point = a + share * (b - a)
        length = float((d - c) @ (d - c))
        along = 0.0 if length == 0 else min(max(float((point - c) @ (d - c)) / length, 0.0), 1.0)
        return float(np.linalg.norm(point - c - along * (d - c)))

    grid = np.linspace(0, 1, 201)
    best = int(np.argmin([from_point(s) for s in grid]))
    low, high = grid[max(best - 1, 0)], grid[min(best + 1, 200)]
    found = scipy.optimize.minimize_scalar(from_point, bounds=(low, high), method="bounded", options={"xatol": 1e-12})
    return min(found.fun, *(from_point(s) for s in grid))


def segments(kind: str, n: int = 60) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    draw = torch.Generator().manual_seed(0)
    a, b, c, d = torch.randn(4, n, 3, generator=draw, dtype=torch.float64)
    share = torch.rand(2, n, 1, generator=draw, dtype=torch.float64)
    if kind == "parallel":
        d = c + (b - a) * (share[0] * 4 - 2)
    elif kind == "nearly parallel":
        d = c + (b - a) * (share[0] * 4 - 2) + 1e-8 * d
    elif kind == "long parallel":
        b, c = a + 100 * (b - a), c + 50 * (b - a)
        d = c + 100 * (b - a)
    elif kind == "collinear":
        c, d = a + (b - a) * (share[0] * 6 - 3), a + (b - a) * (share[1] * 6 - 3)
    elif kind == "first is a point":
        b = a
    elif kind == "second is a point":
        d = c
    elif kind == "both are points":
        b, d = a, c
    elif kind == "the same point":
        b, c, d = a, a, a
    elif kind == "the same segment":
        c, d = b, a
    elif kind == "crossing":
        through = a + share[0] * (b - a)
        d = through + share[1] * (through - c)
    elif kind == "touching at an end":
        c = a + share[0] * (b - a)
    elif kind == "tiny":
        a, b, c, d = a * 1e-9, b * 1e-9, c * 1e-9, d * 1e-9
    elif kind == "tiny beside long":
        b = a + 1e-9 * b
    return a, b, c, d


KINDS = [
    "random", "parallel", "nearly parallel", "long parallel", "collinear", "first is a point", "second is a point",
    "both are points", "the same point", "the same segment", "crossing", "touching at an end", "tiny",
    "tiny beside long",
]  # fmt: skip


@pytest.mark.parametrize("kind", few(KINDS))
def test_segment_distance_equals_brute_force(kind: str) -> None:
    ends = segments(kind)
    got = segment_distance(*ends)
    expected = [brute_force(*(x[i] for x in ends)) for i in range(len(ends[0]))]
    size = 1e-9 if kind == "tiny" else 1.0
    np.testing.assert_allclose(got.numpy(), expected, atol=2e-7 * size)
    for turned in ((2, 3, 0, 1), (1, 0, 2, 3), (0, 1, 3, 2)):
        torch.testing.assert_close(segment_distance(*(ends[i] for i in turned)), got, atol=1e-9 * size, rtol=0)


@pytest.mark.parametrize("kind", KINDS)
def test_segment_distance_in_single_precision_keeps_a_tenth_of_a_millimetre(kind: str) -> None:
    ends = segments(kind)
    got = segment_distance(*(x.float() for x in ends)).double()
    scale = max(float(x.abs().max()) for x in ends)
    torch.testing.assert_close(got, segment_distance(*ends), atol=1e-4 * max(1.0, scale / 100), rtol=0)


@WHO_SLOWLY
def test_penetration_equals_a_plain_loop(choose: Choose) -> None:
    batch = generated, truth, present = crowd()
    counts = scored(batch, choose)
    totals, deepest = [], []
    for b, s, t in itertools.product(range(3), range(2), range(4)):
        depths, counted = [0.0], False
        for p, q in itertools.combinations(range(3), 2):
            if not (present[b, p] and present[b, q] and (counts[b][t][p] or counts[b][t][q])):
                continue
            counted = True
            one, other = generated[s, b, t, p], generated[s, b, t, q]
            for i, j in itertools.product(CAPSULES, CAPSULES):
                if "forearm" in i.name and "forearm" in j.name:
                    continue
                apart = gridded(one[i.joint_a], one[i.joint_b], other[j.joint_a], other[j.joint_b])
                depth = i.radius + j.radius - apart
                depths.append(depth if depth >= 0.05 else 0.0)
        if counted:
            totals.append(sum(depths))
            deepest.append(max(depths))
    hits = [d for d in deepest if d > 0]
    assert 0.1 < len(hits) / len(deepest) < 0.95
    metric = Interpenetration()
    metric.update(generated, truth, present, agents=choose(batch))
    got = metric.compute()
    assert float(got["ip_ratio"]) == pytest.approx(len(hits) / len(deepest), abs=1e-12)
    assert float(got["ip_mean_total_depth"]) == pytest.approx(np.mean(totals), abs=1e-3)
    assert float(got["ip_mean_max_depth"]) == pytest.approx(np.mean(hits), abs=1e-4)


def test_people_apart_do_not_penetrate_and_people_in_one_place_do_as_deep_as_capsules_go() -> None:
    generated, _, _ = crowd(people=1)
    body = generated.flatten(0, 3)
    assert float(penetration_depth(body, body + torch.tensor([50.0, 0, 0])).max()) == 0
    inside = penetration_depth(body, body)
    assert torch.allclose(inside.amax(dim=(1, 2)), torch.tensor(0.24, dtype=torch.float64))


def test_crossed_forearms_are_no_collision() -> None:
    assert all("forearm" in CAPSULES[i].name for i in FOREARMS)
    assert sum("forearm" in capsule.name for capsule in CAPSULES) == len(FOREARMS)
    body = crowd(people=1)[0].flatten(0, 3)
    block = penetration_depth(body, body)[:, 7:9, 7:9]
    assert float(block.abs().max()) == 0


def test_skipping_far_capsules_changes_nothing() -> None:
    """Every pair of capsules measured, against those that the bounding spheres let through."""
    from magnet.body.capsules import capsule_segments

    generated, _, _ = crowd(scenes=8)
    one, other = generated[..., 0, :, :].flatten(0, 2), generated[..., 1, :, :].flatten(0, 2)
    (a, b, radius), (c, d, _) = capsule_segments(one), capsule_segments(other)
    apart = segment_distance(a[:, :, None], b[:, :, None], c[:, None], d[:, None])
    depth = radius[:, None] + radius - apart
    depth = torch.where(depth >= 0.05, depth, 0.0)
    depth[:, 7:9, 7:9] = 0
    torch.testing.assert_close(penetration_depth(one, other), depth, atol=1e-12, rtol=0)
