"""FD by second, and metrics over any number of slots."""

import itertools

import numpy as np
import pytest
import torch

from magnet.metrics import FrechetBySecond, FrechetDistance, all_metrics

from .batches import WHO, Batch, Choose, draw_batch, result


def second_of(batch: Batch, fps: int, second: int) -> Batch:
    part = slice(second * fps, (second + 1) * fps)
    return batch[0][:, :, part], batch[1][:, part], batch[2]


@WHO
@pytest.mark.parametrize("features", ["pair", "canonical_joints"])
def test_each_second_is_the_distance_of_that_second_alone(features: str, choose: Choose) -> None:
    batch = draw_batch(scenes=6, frames=44)
    agents = choose(batch)
    got = result(FrechetBySecond(features, fps=10.0), *batch, agents=agents)  # type: ignore[arg-type]
    name = f"fd_{features}"
    whole = result(FrechetDistance(features), *batch, agents=agents)  # type: ignore[arg-type]
    assert got[name] == pytest.approx(whole[name], abs=1e-9)
    for second in range(5):
        of = agents[:, second * 10 : (second + 1) * 10] if agents is not None and agents.ndim == 3 else agents
        alone = result(FrechetDistance(features), *second_of(batch, 10, second), agents=of)  # type: ignore[arg-type]
        assert got[f"{name}@second{second + 1}"] == pytest.approx(alone[name], abs=1e-9)
    assert len(got) == 6


def test_a_step_belongs_to_the_second_in_which_it_ends() -> None:
    """Still but for one step, from the last frame of the first second to the first of the next."""
    truth = torch.zeros(1, 20, 1, 22, 3, dtype=torch.float64)
    generated = truth[None].clone()
    generated[:, :, 10:] += 1.0
    got = result(FrechetBySecond("velocity", fps=10.0), generated, truth, torch.ones(1, 1, dtype=torch.bool))
    assert got["fd_velocity@second1"] == pytest.approx(0.0, abs=1e-6)
    assert got["fd_velocity@second2"] > 10


def test_sixteen_slots_of_which_two_are_taken_measure_what_two_slots_do() -> None:
    generated, truth, present = draw_batch(people=2, frames=24)
    metrics, wide = all_metrics(), all_metrics()
    metrics.update(generated, truth, present)

    def widened(x: torch.Tensor) -> torch.Tensor:
        return torch.cat([torch.zeros_like(x).repeat_interleave(7, dim=-3), x], dim=-3)

    there = torch.cat([torch.zeros(len(present), 14, dtype=torch.bool), present], dim=1)
    wide.update(widened(generated), widened(truth), there)
    expected = {name: float(value) for name, value in metrics.compute().items()}
    got = {
        name.replace("agent14", "agent0").replace("agent15", "agent1"): float(v) for name, v in wide.compute().items()
    }
    assert got == pytest.approx(expected, abs=1e-9)


def test_nine_people_are_all_measured() -> None:
    generated, truth, present = batch = draw_batch(people=9, scenes=2, frames=16)
    present[:] = True
    draw = torch.Generator().manual_seed(1)
    truth[:] = torch.randn(truth.shape, generator=draw) * 0.4
    generated[:] = truth + torch.randn(generated.shape, generator=draw) * 0.2
    metrics = all_metrics()
    metrics.update(*batch)
    got = metrics.compute()
    assert {f"turn_rate@agent{p}" for p in range(9)} <= set(got)
    x, y = generated.double().numpy(), truth.double().numpy()[None]
    correlations = [
        [
            np.corrcoef(motion[:, :, :, p, j, c].ravel(), motion[:, :, :, q, j, c].ravel())[0, 1]
            for p, q in itertools.combinations(range(9), 2)
            for j in range(1, 22)
            for c in range(3)
        ]
        for motion in (x, y)
    ]
    assert float(got["mi_generated"]) == pytest.approx(np.mean(correlations[0]), abs=1e-9)
    assert float(got["mi"]) == pytest.approx(abs(np.mean(correlations[0]) - np.mean(correlations[1])), abs=1e-9)
