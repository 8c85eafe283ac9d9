"""Systems of equations by Cholesky factors, without checks and loops for which a GPU would be waited for."""

from __future__ import annotations

import torch
from torch import Tensor

from magnet.waiting import may_look


def factored(matrix: Tensor) -> Tensor:
    """The lower Cholesky factor of matrices that are known to be positive definite. (..., n, n) -> same"""
    return torch.linalg.cholesky_ex(matrix).L


def solved(right: Tensor, factor: Tensor) -> Tensor:
    """x of matrix x = right, by the matrix's factor. (..., n, C), (..., n, n) -> (..., n, C)"""
    if may_look(right.device):
        return torch.cholesky_solve(right, factor)
    # torch's own goes from matrix to matrix on a GPU.
    half = torch.linalg.solve_triangular(factor, right, upper=False)
    return torch.linalg.solve_triangular(factor.mT, half, upper=True)


def inverted(factor: Tensor) -> Tensor:
    """The inverse of a matrix by its factor. (..., n, n) -> same"""
    if may_look(factor.device):
        return torch.cholesky_inverse(factor)
    return solved(torch.eye(factor.shape[-1], dtype=factor.dtype, device=factor.device).expand_as(factor), factor)
