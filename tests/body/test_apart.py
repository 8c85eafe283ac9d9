"""People who are kept out of each other's bodies."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from magnet.body import load_body
from magnet.body.apart import APART, Apart, direction, eased, excess_depth, kept_apart, lifted, nearest_points
from magnet.body.contact import deepest, penetration_depth, segment_distance
from magnet.datamodules.synthetic import Synthetic

EVERYBODY = torch.ones(1, 2, dtype=torch.bool)


@pytest.fixture(scope="module")
def walker() -> Tensor:
    """Somebody who walks. (1, 120, 22, 3)"""
    scene = Synthetic(train_clips=1, clip_frames=120, couplings=["follow"], people=[2]).clips("train")[0].scene
    return load_body().joints(scene)[:, :, 0]


def shifted(joints: Tensor, x: Tensor | float = 0.0, z: float = 0.0) -> Tensor:
    x = torch.as_tensor(x, dtype=joints.dtype).expand(joints.shape[1])
    return joints + lifted(torch.stack([x, torch.full_like(x, z)], dim=-1))[:, None]


def depth(joints: Tensor) -> float:
    """How deep the two are in each other at most, arm on arm left out, as the metric measures it."""
    return float(deepest(joints[0, :, 0], joints[0, :, 1])[:, 1].max())


def after(joints: Tensor, offsets: Tensor) -> Tensor:
    return joints + lifted(offsets)[..., None, :]


def test_nearest_points_are_as_far_apart_as_segments_are(generator: torch.Generator) -> None:
    a, b, c, d = torch.randn(4, 500, 3, generator=generator, dtype=torch.float64)
    d[:50] = c[:50] + 2.0 * (b - a)[:50]  # parallel ones
    b[50:60] = a[50:60]  # points
    first, second = nearest_points(a, b, c, d)
    assert torch.allclose((first - second).norm(dim=-1), segment_distance(a, b, c, d), atol=1e-6)
    on_first = segment_distance(first, first, a, b)
    assert float(on_first.max()) < 1e-6


def test_excess_is_the_metrics_depth_less_what_is_allowed(walker: Tensor) -> None:
    one, other = walker[0], shifted(walker, 0.2, 0.1)[0]
    keep = Apart(body=0.03, arms=0.03)
    depths = penetration_depth(one, other, touch=0.0, forearms=True)
    depths[:, 5:9, 5:9] = 0.0  # arm on arm
    expected = depths.amax(dim=(1, 2))
    touching = expected > 0
    assert touching.any()
    assert torch.allclose(excess_depth(one, other, keep)[touching], expected[touching] - 0.03, atol=1e-5)
    assert (excess_depth(one, other, keep)[~touching] <= -0.03 + 1e-5).all()


@pytest.mark.parametrize(("x", "z"), [(0.02, 0.05), (0.15, 0.0), (-0.1, 0.2)])
def test_people_who_stand_in_each_other_are_freed(walker: Tensor, x: float, z: float) -> None:
    joints = torch.stack([walker, shifted(walker, x, z)], dim=2)
    assert depth(joints) > 0.12
    offsets = kept_apart(joints, EVERYBODY)
    assert depth(after(joints, offsets)) < 0.06
    assert torch.allclose(offsets[:, :, 0], -offsets[:, :, 1]), "each makes half of the way"
    assert float(30 * offsets.diff(dim=1).norm(dim=-1).max()) < 0.5


def test_people_who_pass_step_aside(walker: Tensor) -> None:
    joints = torch.stack([walker, shifted(walker, torch.linspace(-2, 2, walker.shape[1]), 0.05)], dim=2)
    offsets = kept_apart(joints, EVERYBODY)
    assert depth(joints) > 0.15 and depth(after(joints, offsets)) < 0.09
    assert float(30 * offsets.diff(dim=1).norm(dim=-1).max()) < 1.0
    assert torch.all(offsets[:, :10] == 0) and torch.all(offsets[:, -10:] == 0), "far from it nobody moves"


def test_who_passes_and_stops_just_behind_is_not_pushed_through(walker: Tensor) -> None:
    """Most of the encounter is behind the other: the way out of all of it together would lead through him."""
    T = walker.shape[1]
    x = torch.cat([torch.linspace(1.5, -0.3, T // 2), torch.full((T - T // 2,), -0.3)])
    joints = torch.stack([shifted(walker, x, 0.04), walker], dim=2)
    offsets = kept_apart(joints, EVERYBODY, torch.tensor([False, True]))
    assert depth(after(joints, offsets)) < 0.09
    moved = offsets[0, :, 0] + torch.stack([x, torch.full_like(x, 0.04)], dim=-1)
    assert float(30 * moved.diff(dim=0).norm(dim=-1).max()) < 2.0, "he walks at 0.7 m/s"
    assert float(offsets[0, :, 0, 1].max()) > 0.2, "he steps aside"


def test_who_walks_slowly_through_another_is_led_around(walker: Tensor) -> None:
    T = walker.shape[1]
    x = torch.linspace(0.45, -0.45, T)
    joints = torch.stack([shifted(walker, x, 0.02), walker], dim=2)
    offsets = kept_apart(joints, EVERYBODY, torch.tensor([False, True]))
    assert depth(after(joints, offsets)) < 0.09
    assert float(30 * offsets.diff(dim=1).norm(dim=-1).max()) < 2.0
    away = direction(joints[:, :, 0], joints[:, :, 1], torch.ones(1, T, dtype=torch.bool))
    angle = torch.rad2deg(torch.acos((away[:, 1:] * away[:, :-1]).sum(dim=-1).clamp(-1, 1)))
    assert float(angle.max()) < 10, "over a second from one side to the other"


def test_whoever_is_in_nobodys_way_stays_bit_for_bit(walker: Tensor) -> None:
    joints = torch.stack([walker, shifted(walker, 1.2)], dim=2)
    assert torch.equal(kept_apart(joints, EVERYBODY), torch.zeros(1, walker.shape[1], 2, 2))
    inside = torch.stack([walker, shifted(walker, 0.1)], dim=2)
    alone = torch.tensor([[True, False]])
    assert torch.equal(kept_apart(inside, alone), torch.zeros(1, walker.shape[1], 2, 2))


def test_only_they_move_who_may(walker: Tensor) -> None:
    joints = torch.stack([walker, shifted(walker, 0.1)], dim=2)
    offsets = kept_apart(joints, EVERYBODY, fixed=torch.tensor([True, False]))
    assert torch.all(offsets[:, :, 0] == 0) and depth(after(joints, offsets)) < 0.06
    nobody = kept_apart(joints, EVERYBODY, fixed=torch.tensor([True, True]))
    assert torch.all(nobody == 0)


def test_what_goes_on_from_a_past_leaves_it_slowly(walker: Tensor) -> None:
    joints = torch.stack([walker, shifted(walker, 0.1)], dim=2)
    keep = Apart(speed=0.3)
    offsets = kept_apart(joints, EVERYBODY, keep=keep, begun=True)
    assert float(offsets[:, 0].norm(dim=-1).max()) <= 0.3 / 30 + 1e-6
    assert depth(after(joints, offsets)[:, 60:]) < 0.06


def test_scenes_and_slots_do_not_matter_to_each_other(walker: Tensor) -> None:
    near = torch.stack([walker, shifted(walker, 0.1)], dim=2)
    far = torch.stack([walker, shifted(walker, 0.22, 0.1)], dim=2)
    both = kept_apart(torch.cat([near, far]), EVERYBODY.expand(2, 2))
    assert torch.equal(both[:1], kept_apart(near, EVERYBODY))
    assert torch.equal(both[1:], kept_apart(far, EVERYBODY))
    swapped = kept_apart(near.flip(2), EVERYBODY)
    assert torch.allclose(swapped.flip(2), kept_apart(near, EVERYBODY), atol=1e-6)


def test_three_people_in_one_place_are_freed(walker: Tensor) -> None:
    joints = torch.stack([walker, shifted(walker, 0.1), shifted(walker, 0.05, 0.05)], dim=2)
    present = torch.ones(1, 3, dtype=torch.bool)
    freed = after(joints, kept_apart(joints, present, keep=Apart(rounds=4)))
    for one, other in ((0, 1), (0, 2), (1, 2)):
        assert depth(freed[:, :, [one, other]]) < 0.1 < depth(joints[:, :, [one, other]])


def test_an_eased_distance_is_never_less_than_what_is_needed(generator: torch.Generator) -> None:
    needed = torch.rand(3, 80, generator=generator) * (torch.rand(3, 80, generator=generator) < 0.1)
    smooth = eased(needed, 6)
    assert (smooth >= needed - 1e-6).all() and smooth.shape == needed.shape
    assert float(smooth.diff(dim=1).abs().max()) <= float(needed.max()) / 13 + 1e-6


def test_presets_differ_in_what_they_allow() -> None:
    assert APART["light"].body > APART["firm"].body and APART["light"].arms > APART["firm"].arms
