"""Both ways of solving, with checks and loops for a CPU and without for a GPU, give the same."""

from __future__ import annotations

import torch

from magnet.motion.cholesky import factored, inverted, solved
from magnet.waiting import as_off_cpu
from tests.counting import Counting


def systems() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    root = torch.randn(2, 3, 5, 5, generator=generator, dtype=torch.float64)
    return root @ root.mT + torch.eye(5), torch.randn(2, 3, 5, 4, generator=generator, dtype=torch.float64)


def test_what_is_solved_solves_the_equations_on_every_device() -> None:
    matrix, right = systems()
    factor = factored(matrix)
    assert torch.allclose(factor @ factor.mT, matrix)
    assert torch.allclose(matrix @ solved(right, factor), right)
    assert torch.allclose(matrix @ inverted(factor), torch.eye(5, dtype=torch.float64).expand_as(matrix))
    with Counting() as checked:
        torch.linalg.cholesky(matrix)
    assert checked.waits  # so that the next lines can fail
    with as_off_cpu(), Counting() as counted:
        off = solved(right, factored(matrix)), inverted(factored(matrix))
    assert not counted.waits
    assert torch.allclose(off[0], solved(right, factor)) and torch.allclose(off[1], inverted(factor))
