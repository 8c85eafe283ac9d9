"""The closed-form solve against a general least-squares solver."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

from magnet.motion.frames import from_planar, inverse, pairwise, partners, to_planar
from magnet.motion.planar import rotate_ground
from magnet.motion.pose_graph import GAUGE, PoseGraph, factor


@dataclass(frozen=True)
class Planar:
    """Turns and moves, as deltas (B, T, P) or pairwise transforms (B, T, P, P - 1), with how sure they are."""

    yaw: torch.Tensor
    ground: torch.Tensor
    yaw_precision: torch.Tensor
    ground_precision: torch.Tensor
    yaw_smoothness: torch.Tensor | float = 0.0
    ground_smoothness: torch.Tensor | float = 0.0


def solve_pose_graph(
    deltas: Planar, pairs: Planar, start_yaw: torch.Tensor, start_ground: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    held = torch.stack([deltas.yaw_precision, deltas.ground_precision])
    smooth = [0 * each + s for each, s in zip(held, (deltas.yaw_smoothness, deltas.ground_smoothness), strict=True)]
    graph = PoseGraph.of(held, torch.stack(smooth), torch.stack([pairs.yaw_precision, pairs.ground_precision]))
    return graph.solve(deltas.yaw, deltas.ground, pairs.yaw, pairs.ground, start_yaw, start_ground)


def paths(B: int, T: int, P: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Headings (B, T + 1, P) and positions (B, T + 1, P, 2), the first before the stretch."""
    generator = torch.Generator().manual_seed(seed)
    yaw = torch.randn(B, T + 1, P, generator=generator, dtype=torch.float64).cumsum(dim=1) * 0.2
    ground = torch.randn(B, T + 1, P, 2, generator=generator, dtype=torch.float64).cumsum(dim=1) * 0.1
    return yaw, ground


def observed(
    yaw: torch.Tensor, ground: torch.Tensor, noise: float, seed: int = 1, delta: float = 50.0, pair: float = 20.0
) -> tuple[Planar, Planar]:
    """Steps and pairwise transforms of paths, noisy, with precisions that differ from one to the next."""
    generator = torch.Generator().manual_seed(seed)
    T_world = from_planar(yaw, ground)

    def noisy(T: torch.Tensor, precision: float) -> Planar:
        angle, move = to_planar(T)
        drawn = [torch.rand(angle.shape, generator=generator, dtype=torch.float64) + 0.5 for _ in range(2)]
        angle = angle + noise * torch.randn(angle.shape, generator=generator, dtype=torch.float64)
        move = move + noise * torch.randn(move.shape, generator=generator, dtype=torch.float64)
        return Planar(angle, move, precision * drawn[0], precision * drawn[1])

    return noisy(inverse(T_world[:, :-1]) @ T_world[:, 1:], delta), noisy(pairwise(T_world[:, 1:]), pair)


@pytest.mark.parametrize(("T", "P"), [(1, 3), (3, 1), (8, 3), (23, 3), (33, 3), (300, 1), (1, 70), (2, 70), (9, 33)])
def test_elimination_in_runs_solves_what_a_dense_solver_solves(T: int, P: int):
    generator = torch.Generator().manual_seed(T + 10 * P)
    before = torch.randn(2, T, P, P, generator=generator, dtype=torch.float64)
    diagonal = torch.eye(P, dtype=torch.float64) * (6.0 * P) + torch.rand(2, T, P, P, generator=generator).double()
    diagonal = (diagonal + diagonal.transpose(-1, -2)) / 2
    right = torch.randn(2, T, P, 3, generator=generator, dtype=torch.float64)
    whole = torch.zeros(2, T * P, T * P, dtype=torch.float64)
    for t in range(T):
        here = slice(t * P, (t + 1) * P)
        whole[:, here, here] = diagonal[:, t]
        if t:
            last = slice((t - 1) * P, t * P)
            whole[:, here, last] = before[:, t]
            whole[:, last, here] = before[:, t].transpose(-1, -2)
    expected = torch.linalg.solve(whole, right.flatten(1, 2)).view(right.shape)
    assert torch.allclose(factor(diagonal, before).solve(right), expected, atol=1e-9)


@pytest.mark.parametrize("P", [2, 3])
def test_the_solve_is_the_least_squares_answer(P: int):
    """Headings, then positions with those headings, each minimised by scipy over a plain sum of residuals."""
    yaw, ground = paths(1, 6, P)
    deltas, pairs = observed(yaw, ground, noise=0.05)
    found_yaw, found = solve_pose_graph(deltas, pairs, yaw[:, 0], ground[:, 0])
    partner = partners(P)
    stepped = yaw[0, 0].numpy() + deltas.yaw[0].cumsum(dim=0).numpy()

    def headings(x: np.ndarray) -> np.ndarray:
        theta = np.concatenate([yaw[0, :1].numpy(), x.reshape(6, P)])
        residuals = [np.sqrt(GAUGE) * (theta[1:] - stepped).ravel()]
        for t in range(6):
            for p in range(P):
                off = theta[t + 1, p] - theta[t, p] - float(deltas.yaw[0, t, p])
                residuals.append([np.sqrt(float(deltas.yaw_precision[0, t, p])) * off])
                for s in range(P - 1):
                    off = theta[t + 1, int(partner[p, s])] - theta[t + 1, p] - float(pairs.yaw[0, t, p, s])
                    off = np.angle(np.exp(1j * off))
                    residuals.append([np.sqrt(float(pairs.yaw_precision[0, t, p, s])) * off])
        return np.concatenate(residuals)

    best = least_squares(headings, stepped.ravel(), xtol=1e-14, ftol=1e-14, gtol=1e-14).x.reshape(6, P)
    assert np.allclose(found_yaw[0].numpy(), best, atol=1e-6)
    theta = torch.cat([yaw[:, :1], found_yaw], dim=1)[0]
    walked = ground[0, 0] + rotate_ground(theta[:-1], deltas.ground[0]).cumsum(dim=0)

    def positions(x: np.ndarray) -> np.ndarray:
        where = torch.cat([ground[0, :1], torch.from_numpy(x).view(6, P, 2)])
        residuals = [np.sqrt(GAUGE) * (where[1:] - walked).flatten().numpy()]
        for t in range(6):
            for p in range(P):
                off = where[t + 1, p] - where[t, p] - rotate_ground(theta[t, p], deltas.ground[0, t, p])
                residuals.append(float(deltas.ground_precision[0, t, p]) ** 0.5 * off.numpy())
                for s in range(P - 1):
                    away = where[t + 1, int(partner[p, s])] - where[t + 1, p]
                    off = away - rotate_ground(theta[t + 1, p], pairs.ground[0, t, p, s])
                    residuals.append(float(pairs.ground_precision[0, t, p, s]) ** 0.5 * off.numpy())
        return np.concatenate(residuals)

    best = least_squares(positions, walked.flatten().numpy(), xtol=1e-14, ftol=1e-14, gtol=1e-14).x.reshape(6, P, 2)
    assert np.allclose(found[0].numpy(), best, atol=1e-6)


@pytest.mark.parametrize("T", [1, 2, 3, 6, 7])
def test_smooth_corrections_are_where_the_sum_of_squares_is_least(T: int):
    """Its gradient, by autograd, vanishes at the solution; a little off it does not."""
    yaw, ground = paths(2, T, 3)
    deltas, pairs = observed(yaw, ground, noise=0.1)
    generator = torch.Generator().manual_seed(5)
    smooth = 500 * torch.rand(2, 2, T, 3, generator=generator, dtype=torch.float64)
    deltas = replace(deltas, yaw_smoothness=smooth[0], ground_smoothness=smooth[1])
    theta, found = solve_pose_graph(deltas, pairs, yaw[:, 0], ground[:, 0])
    partner = partners(3)
    stepped = yaw[:, :1] + deltas.yaw.cumsum(dim=1)
    before = torch.cat([yaw[:, :1], theta[:, :-1]], dim=1)
    walked = ground[:, :1] + rotate_ground(before, deltas.ground).cumsum(dim=1)

    def total(x: torch.Tensor, integrated: torch.Tensor, off: torch.Tensor, *weights: torch.Tensor) -> torch.Tensor:
        own, bend, pair = weights
        correction = torch.nn.functional.pad((x - integrated).movedim(-1, 0), (0, 0, 1, 0)).movedim(0, -1)
        change = correction.diff(dim=1)
        cost = GAUGE * (x - integrated).square().sum() + (own[..., None] * change.square()).sum()
        if T > 2:
            cost = cost + (bend[:, 2:, :, None] * change[:, 1:].diff(dim=1).square()).sum()
        return cost + (pair[..., None] * (x[:, :, partner] - x[:, :, :, None] - off).square()).sum()

    around = pairs.yaw - (theta[:, :, partner] - theta[..., None])
    nearest = theta[:, :, partner] - theta[..., None] + torch.atan2(around.sin(), around.cos())
    turned = (theta[..., None], stepped[..., None], nearest[..., None])
    gone = (found, walked, rotate_ground(theta[..., None], pairs.ground))
    cases = (
        (*turned, deltas.yaw_precision, smooth[0], pairs.yaw_precision),
        (*gone, deltas.ground_precision, smooth[1], pairs.ground_precision),
    )
    for x, *rest in cases:
        for moved, flat in ((x, True), (x + 0.01 * torch.rand(x.shape, generator=generator).double(), False)):
            at = moved.clone().requires_grad_()
            (slope,) = torch.autograd.grad(total(at, *rest), at)
            assert (float(slope.abs().max()) < 1e-8) == flat


def test_exact_steps_and_pairs_give_the_paths_back():
    yaw, ground = paths(3, 20, 4)
    deltas, pairs = observed(yaw, ground, noise=0.0)
    found_yaw, found = solve_pose_graph(deltas, pairs, yaw[:, 0], ground[:, 0])
    assert torch.allclose(found_yaw, yaw[:, 1:], atol=1e-5)
    assert torch.allclose(found, ground[:, 1:], atol=1e-5)


def test_the_solve_can_be_differentiated():
    yaw, ground = paths(1, 5, 2)
    deltas, pairs = observed(yaw, ground, noise=0.05)
    start = yaw[:, 0], ground[:, 0]

    def solved(delta_yaw: torch.Tensor, pair_ground: torch.Tensor) -> torch.Tensor:
        a = Planar(delta_yaw, deltas.ground, deltas.yaw_precision, deltas.ground_precision)
        b = Planar(pairs.yaw, pair_ground, pairs.yaw_precision, pairs.ground_precision)
        return torch.cat([each.flatten() for each in solve_pose_graph(a, b, *start)])

    inputs = (deltas.yaw.clone().requires_grad_(), pairs.ground.clone().requires_grad_())
    assert torch.autograd.gradcheck(solved, inputs)
