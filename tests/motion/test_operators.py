"""Changes of frame are so small that their time is that of their operators: these are counted."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from magnet.bench.speed import products_of
from magnet.motion.frames import canonical_frame, from_planar, inverse, to_9d, to_planar

T = from_planar(torch.linspace(-3, 3, 6), torch.arange(12.0).view(6, 2)).view(2, 3, 4, 4)
WORK: dict[str, tuple[Callable[[Tensor], object], int]] = {
    "inverse": (inverse, 16),
    "to_9d": (to_9d, 7),
    "to_planar": (to_planar, 15),
    "project": (lambda T: from_planar(*to_planar(T)), 24),
    "canonical_frame": (canonical_frame, 30),
}


@pytest.mark.parametrize("name", WORK)
def test_a_change_of_frame_is_few_operators(name: str) -> None:
    run, most = WORK[name]
    run(T)  # constants are made once
    assert products_of(lambda: run(T))[1] <= most


def test_constants_made_while_sampling_serve_training() -> None:
    with torch.inference_mode():
        inverse(T.to(torch.float64))
    twice = T.to(torch.float64).requires_grad_()
    inverse(twice).sum().backward()
    assert twice.grad is not None
