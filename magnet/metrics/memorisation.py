"""Memorisation: distance of a future to the nearest training window."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor

from magnet.baselines.windows import Windows
from magnet.metrics.base import ClipMeans
from magnet.metrics.columns import Column
from magnet.metrics.futures import Futures, without_pelvis

EVERY = 3
"""Futures are compared at every third frame."""

CHUNK = 32
"""Windows compared together, to bound memory."""


class NearestTraining(ClipMeans):
    """`nearest_training` in metres: from each sample's future to the nearest training window, mean over samples.

    A distance is the mean over scored frames, agents and 21 joints, with both futures in the same world: origin
    between the people and facing as the first of them at the last context frame. What is measured is expected there
    (`magnet.evaluation.evaluator.shared_world`); windows are put there once for each order of their people
    (`magnet.baselines.retrieval.assignments`).
    Only windows with as many people count; a scene that has none is not measured.

    Samples much nearer than recordings that training has not seen (the ground truth's row) repeat the training set.

    Args:
        windows: of the training set, as long as the scenes that are measured.

    >>> import torch
    >>> from magnet.body import load_body
    >>> from magnet.baselines import Windows
    >>> from magnet.motion.scene import empty_scene
    >>> scene = empty_scene(1, 12, 1, like=torch.zeros(()))
    >>> scene = scene.replace(present=~scene.present)  # somebody who stands still
    >>> metric = NearestTraining(Windows.of([scene], load_body(), context=4))
    >>> future = load_body().joints(scene)[:, 4:]
    >>> metric.update(future[None], future)
    >>> round(metric.compute()["nearest_training"].item(), 3)
    0.0
    """

    higher_is_better = None

    columns: ClassVar[Mapping[str, Column]] = {
        "nearest_training": Column("nearest", "m", "real", "distance to the nearest training window", main=True)
    }

    def __init__(self, windows: Windows, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.windows = windows

    def measure(self, futures: Futures) -> Sequence[tuple[Tensor, Tensor]]:
        scored = futures.scored[:, ::EVERY]
        total = scored.new_zeros(len(scored), dtype=torch.float64)
        count = torch.zeros_like(total)
        for b, there in enumerate(futures.present):
            people = int(there.sum())
            if not bool(scored[b].any()) or not len(self.windows.of_people(people)):
                continue
            made = without_pelvis(futures.generated[:, b, ::EVERY, there])
            windows = without_pelvis(self.windows.futures_in_every_order(people, EVERY))
            nearest = nearest_distance(made, windows, scored[b][:, there])
            total[b], count[b] = nearest.double().sum(), len(nearest)
        return [(total, count)]


def nearest_distance(futures: Tensor, windows: Tensor, scored: Tensor) -> Tensor:
    """Mean distance of joints to the nearest window. (S, T, n, J, 3), (M, T', n, J, 3), (T, n) bool -> (S,) metres

    Over the frames that both have; infinite where that leaves none that is scored.
    """
    frames = min(futures.shape[1], windows.shape[1])
    scored = scored[:frames]
    made = futures[:, :frames][:, scored].to(windows).movedim(-1, 0).contiguous()  # (3, S, k, J)
    least = made.new_full((made.shape[1],), torch.inf)
    for part in windows[:, :frames].split(CHUNK):
        # x, y and z apart: sums along an axis of three are slow.
        seen = part[:, scored].movedim(-1, 0).contiguous()  # (3, m, k, J)
        squares = (made[0][:, None] - seen[0]).square_()
        for axis in (1, 2):
            squares += (made[axis][:, None] - seen[axis]).square_()
        away = squares.sqrt_().mean(dim=(-1, -2))  # (S, m)
        least = torch.minimum(least, away.nan_to_num(torch.inf).amin(dim=1))
    return least
