"""Every placement is listed under its name; `fuse` is its plain loop, without the loop."""

from __future__ import annotations

from typing import get_args

import pytest
import torch
import torch.utils._python_dispatch
from torch import Tensor

import magnet.motion.placement as placement_module
from magnet.motion.frames import from_planar, to_planar
from magnet.motion.placement import PLACEMENTS, Placement, accumulated, place
from magnet.motion.planar import rotate_ground
from tests.counting import Counting


def test_every_placement_has_a_function():
    assert tuple(PLACEMENTS) == get_args(Placement)


@pytest.mark.parametrize("people", [1, 3])
@pytest.mark.parametrize("placement", PLACEMENTS)
def test_without_others_everybody_goes_its_own_way(placement: Placement, people: int) -> None:
    """A walk of complex numbers: each step is turned by the heading before it."""
    generator = torch.Generator().manual_seed(6)
    yaw, start = torch.randn(2, 9, people, generator=generator), torch.randn(2, people, generator=generator)
    step, ground = torch.randn(2, 9, people, 2, generator=generator), torch.randn(2, people, 2, generator=generator)
    alone = torch.zeros(2, 9, 1, 0, 4, 4) if people == 1 else None  # nobody else to be placed by, or nothing is said
    placed = place(from_planar(yaw, step), alone, from_planar(start, ground), placement)
    heading, at = start.double(), torch.view_as_complex(ground.double())
    for t in range(9):
        at = at + torch.view_as_complex(step[:, t].double()) * torch.polar(torch.ones_like(heading), -heading)
        heading = heading + yaw[:, t]
        torch.testing.assert_close(placed[:, t], from_planar(heading, torch.view_as_real(at)).float())


def frame_by_frame(
    deltas: Tensor, pairs: Tensor, start: Tensor, weight: float, present: Tensor, fixed: Tensor
) -> tuple[Tensor, Tensor]:
    """`fuse` as its docstring has it, one frame and one scene at a time: yaws (B, T, P) and grounds (B, T, P, 2)."""
    (dyaw, dground), (pyaw, pground), (yaw0, ground0) = (to_planar(x.double()) for x in (deltas, pairs, start))
    B, T, P = dyaw.shape
    yaws, grounds = torch.zeros(B, T, P).double(), torch.zeros(B, T, P, 2).double()
    others = [[q for q in range(P) if q != p] for p in range(P)]
    for b in range(B):
        own = torch.diag(torch.where(fixed, 1e9, 1.0).double())
        system, yaw, ground = own.clone(), yaw0[b], ground0[b]
        ties = [(p, s, q) for p in range(P) for s, q in enumerate(others[p]) if present[b, p] and present[b, q]]
        for p, _, q in ties:
            system[p, p] += weight
            system[q, q] += weight
            system[p, q] -= weight
            system[q, p] -= weight
        for t in range(T):
            ground = ground + rotate_ground(yaw, dground[b, t])
            yaw = yaw + dyaw[b, t]
            right = torch.zeros(P, 1).double()
            for p, s, q in ties:
                off = pyaw[b, t, p, s] - (yaw[q] - yaw[p])
                off = torch.atan2(off.sin(), off.cos())
                right[q] += weight * off
                right[p] -= weight * off
            yaw = yaw + torch.linalg.solve(system, right)[:, 0]
            right = torch.zeros(P, 2).double()
            for p, s, q in ties:
                away = rotate_ground(yaw[p], pground[b, t, p, s]) - (ground[q] - ground[p])
                right[q] += weight * away
                right[p] -= weight * away
            ground = ground + torch.linalg.solve(system, right)
            yaws[b, t], grounds[b, t] = yaw, ground
    return yaws, grounds


@pytest.mark.parametrize(("frames", "people", "spread"), [(1, 2, 0.1), (9, 3, 0.3), (17, 3, 4.0), (32, 2, 0.1)])
def test_fuse_is_the_compromise_of_each_frame_after_the_one_before(frames: int, people: int, spread: float) -> None:
    """However far pairs are from the deltas: with a spread of 4 they are whole turns off."""
    generator = torch.Generator().manual_seed(frames)

    def planar(*shape: int, turn: float) -> Tensor:
        ground = torch.randn(*shape, 2, generator=generator)
        return from_planar(turn * torch.randn(shape, generator=generator), ground)

    deltas, start = planar(2, frames, people, turn=0.1), planar(2, people, turn=3.0)
    pairs = planar(2, frames, people, people - 1, turn=spread)
    present = torch.ones(2, people, dtype=torch.bool)
    present[1, 0] = people < 3
    fixed = torch.arange(people) == 1
    placed = place(deltas, pairs, start, "fuse", 0.3, present, fixed)
    yaws, grounds = frame_by_frame(deltas, pairs, start, 0.3, present, fixed)
    torch.testing.assert_close(placed, from_planar(yaws, grounds).float(), rtol=1e-5, atol=1e-5)


def test_fuse_takes_few_products_however_many_frames_there_are() -> None:
    """A loop over frames would be launched on a GPU frame by frame, in each step of training."""

    def operators(frames: int) -> int:
        deltas = from_planar(torch.zeros(1, frames, 2), torch.zeros(1, frames, 2, 2))
        pairs = from_planar(torch.zeros(1, frames, 2, 1), torch.ones(1, frames, 2, 1, 2))
        with Counting() as counter:
            place(deltas, pairs, from_planar(torch.zeros(1, 2), torch.zeros(1, 2, 2)), "fuse")
        return counter.operators

    assert operators(256) < operators(16) + 240, "a loop would take twenty for each frame more"


def random_planar(*shape: int, turn: float, generator: torch.Generator) -> Tensor:
    return from_planar(turn * torch.randn(shape, generator=generator), torch.randn(*shape, 2, generator=generator))


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
@pytest.mark.parametrize("placement", PLACEMENTS)
def test_what_is_not_finite_ends_and_spoils_its_own_scene_from_its_own_frame_on(
    placement: Placement, value: float
) -> None:
    """One NaN of a network made `fuse` count for ever: whole turns of NaN never stay as they were."""
    generator = torch.Generator().manual_seed(3)
    deltas = random_planar(2, 12, 3, turn=0.1, generator=generator)
    pairs = random_planar(2, 12, 3, 2, turn=4.0, generator=generator)
    start = random_planar(2, 3, turn=3.0, generator=generator)
    right = place(deltas, pairs, start, placement, 0.3)
    deltas[0, 7, 0] = pairs[0, 7, 0] = value
    placed = place(deltas, pairs, start, placement, 0.3)
    assert not placed[0, 7, 0].isfinite().all()
    assert torch.equal(placed[1], right[1]) and torch.equal(placed[0, :7], right[0, :7])


def test_fuse_does_not_read_pairs_with_somebody_absent() -> None:
    """Nor where a slot points at nobody: no weight makes a number of NaN."""
    generator = torch.Generator().manual_seed(4)
    deltas = random_planar(2, 12, 3, turn=0.1, generator=generator)
    pairs = random_planar(2, 12, 3, 2, turn=4.0, generator=generator)
    start = random_planar(2, 3, turn=3.0, generator=generator)
    present = torch.tensor([[True, True, False], [True, True, True]])
    partner = torch.tensor([[1, 2], [0, 2], [0, 2]])  # the last slot of agent 2 is at nobody
    right = place(deltas, pairs, start, "fuse", 0.3, present, partner=partner)
    pairs[0, :, :, 1] = pairs[0, :, 2] = pairs[1, :, 2, 1] = torch.nan
    assert torch.equal(place(deltas, pairs, start, "fuse", 0.3, present, partner=partner), right)


def test_fuse_counts_turns_once_a_frame_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each count settles one frame more: so many suffice even where each frame's turns hang on those before."""
    generator = torch.Generator().manual_seed(5)
    deltas, start = (random_planar(1, *shape, turn=3.0, generator=generator) for shape in ((48, 4), (4,)))
    pairs = random_planar(1, 48, 4, 3, turn=4.0, generator=generator)
    counts: list[int] = []

    def counted(*given: Tensor) -> Tensor:
        counts.append(1)
        return accumulated(*given)

    monkeypatch.setattr(placement_module, "accumulated", counted)
    placed = place(deltas, pairs, start, "fuse", 0.3)
    assert 3 < len(counts) <= 49, "one a count of turns, and one of places"
    everybody, nobody = torch.ones(1, 4, dtype=torch.bool), torch.zeros(4, dtype=torch.bool)
    yaws, grounds = frame_by_frame(deltas, pairs, start, 0.3, everybody, nobody)
    torch.testing.assert_close(placed, from_planar(yaws, grounds).float(), rtol=1e-4, atol=1e-4)
