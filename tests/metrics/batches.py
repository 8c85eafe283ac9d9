"""Made-up futures for the tests of metrics, and what of them is scored."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torchmetrics import Metric

from magnet.metrics import FrechetBySecond, FrechetDistance, MotionInteraction, all_metrics
from tests.cases import few

Batch = tuple[Tensor, Tensor, Tensor]


def draw_batch(scenes: int = 3, people: int = 3, samples: int = 4, frames: int = 20, seed: int = 0) -> Batch:
    """Crowded made-up joints, low enough to touch the floor; the last agent of every second scene is absent, NaN."""
    draw = torch.Generator().manual_seed(seed)
    place = torch.randn(scenes, 1, people, 1, 3, generator=draw) * torch.tensor([0.3, 0.0, 0.3])
    steps = torch.randn(scenes, frames, people, 22, 3, generator=draw) * 0.02
    truth = place + torch.rand(scenes, 1, people, 22, 3, generator=draw) * 0.8 + steps.cumsum(dim=1)
    generated = truth + (torch.randn(samples, scenes, frames, people, 22, 3, generator=draw) * 0.02).cumsum(dim=2)
    present = torch.ones(scenes, people, dtype=torch.bool)
    if people > 2:
        present[::2, -1] = False
        truth[::2, :, -1] = math.nan
        generated[:, ::2, :, -1] = math.nan
    return generated, truth, present


def crowd(scenes: int = 3, people: int = 3, samples: int = 2, frames: int = 4) -> tuple[Tensor, Tensor, Tensor]:
    draw = torch.Generator().manual_seed(1)
    generated = torch.randn(samples, scenes, frames, people, 22, 3, generator=draw, dtype=torch.float64) * 0.3
    generated += torch.randn(samples, scenes, frames, people, 1, 3, generator=draw, dtype=torch.float64) * 0.4
    present = torch.ones(scenes, people, dtype=torch.bool)
    present[::3, 2:] = False
    return generated, generated[0], present


def gridded(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> float:
    """Distance of two segments, good to a tenth of a millimetre: the least over points along a-b."""
    points = a + torch.linspace(0, 1, 501, dtype=a.dtype)[:, None] * (b - a)
    along = ((points - c) @ (d - c) / ((d - c) @ (d - c))).clamp(0, 1)
    return float((points - c - along[:, None] * (d - c)).norm(dim=-1).min())


def result(metric: Metric, *batch: Tensor, agents: Tensor | None = None) -> dict[str, float]:
    metric.update(*batch, agents=agents)
    return {name: float(value) for name, value in metric.compute().items()}


def some_frames(batch: Batch) -> Tensor:
    """Stretches of four frames, each agent's own: about half of them generated. (B, T, P) bool"""
    B, T, P = batch[1].shape[:3]
    drawn = torch.rand(B, -(-T // 4), P, generator=torch.Generator().manual_seed(7)) < 0.5
    return drawn.repeat_interleave(4, dim=1)[:, :T]


Choose = Callable[[Batch], Tensor | None]

ONLY_SECOND = torch.tensor([False, True, False])

CHOICES: dict[str, Choose] = {
    "everybody": lambda batch: None,
    "one agent": lambda batch: ONLY_SECOND,
    "some frames": some_frames,
}

WHO = pytest.mark.parametrize("choose", CHOICES.values(), ids=CHOICES.keys())
WHO_SLOWLY = pytest.mark.parametrize("choose", few(CHOICES.values(), 1), ids=CHOICES.keys())
"""Where a plain loop takes its time."""


def scored(batch: Batch, choose: Choose) -> list[list[list[bool]]]:
    """Whether a frame of an agent was generated and is scored: [b][t][p]."""
    _, truth, present = batch
    agents = choose(batch)
    B, T, P = truth.shape[:3]
    return [
        [
            [bool(present[b, p]) and (agents is None or bool(agents.expand(B, T, P)[b, t, p])) for p in range(P)]
            for t in range(T)
        ]
        for b in range(B)
    ]


def every_metric() -> dict[str, Callable[[], Metric]]:
    makers: dict[str, Callable[[], Metric]] = {
        f"FD {f}": lambda f=f: FrechetDistance(f) for f in ("canonical_joints", "velocity")
    }
    makers["FD of velocities by second"] = lambda: FrechetBySecond("velocity", fps=8.0)
    makers["MI per clip"] = lambda: MotionInteraction(per_clip=True)
    for name in all_metrics():
        makers[str(name)] = lambda name=name: all_metrics()[name]
    return makers


EVERY = pytest.mark.parametrize("make", every_metric().values(), ids=every_metric().keys())


def pair_places(batch: Batch, choose: Choose) -> list[tuple[int, int, int, int]]:
    """Scene, frame and two people, wherever a pair counts: both there, at least one of them scored."""
    _, truth, present = batch
    B, T, P = truth.shape[:3]
    counts = scored(batch, choose)
    return [
        (b, t, p, q)
        for b, t, (p, q) in itertools.product(range(B), range(T), itertools.combinations(range(P), 2))
        if present[b, p] and present[b, q] and (counts[b][t][p] or counts[b][t][q])
    ]
