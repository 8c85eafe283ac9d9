"""Finds the nearest codes to a few vectors without reading whole codebooks, which would take most of the time.

Codes lie near a space of few dimensions. First the distances to all codes are computed in that space, with bounds on
what the other dimensions can add. Then only the codes that can still be nearest are read whole: mostly one to five of a
thousand.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[Any]

FEW = 16
"""Up to this many vectors the search is faster than a product with all codes."""

DIMENSIONS = 64
"""Dimensions of that space."""

SLACK = 1e-5
"""Rounding error of the bounds, as a share of squared lengths."""


@dataclass(frozen=True)
class Book:
    """A codebook and where its codes lie.

    Attributes:
        codes: (codes, D).
        lengths: (codes,) squared.
        basis: (D, K) orthonormal.
        near: (K, codes) the codes in that basis; beyond: (codes,) how far each is from the space.
    """

    codes: Array
    lengths: Array
    basis: Array
    near: Array
    beyond: Array

    @classmethod
    def of(cls, codes: Tensor) -> Book:
        """codes (codes, D) float32 on the CPU"""
        wide = min(DIMENSIONS, *codes.shape)
        # Any space gives right answers; one that was multiplied by the codes twice is near the best.
        start = torch.randn(len(codes), wide, generator=torch.Generator().manual_seed(0), dtype=torch.float32)
        basis = torch.linalg.qr(codes.T @ start).Q
        basis = torch.linalg.qr(codes.T @ (codes @ basis)).Q
        near = codes @ basis
        beyond = (codes - near @ basis.T).norm(dim=-1)
        whole = codes.square().sum(-1)
        return cls(*(each.contiguous().numpy() for each in (codes, whole, basis, near.T, beyond)))

    def nearest(self, vectors: Array) -> Array:
        """(M, D) -> (M,) int"""
        inside = vectors @ self.basis
        squares = np.einsum("md,md->m", vectors, vectors)
        outside = np.sqrt(np.maximum(squares - np.einsum("mk,mk->m", inside, inside), 0.0) + SLACK * squares)
        # Squared distances but for the vector's own length; those beyond the space can be apart or together.
        alike, off = self.lengths - 2 * (inside @ self.near), 2 * outside[:, None] * self.beyond
        most = (alike + off).min(axis=1) + SLACK * (squares + self.lengths.max())
        left = (alike - off <= most[:, None]).any(axis=0).nonzero()[0]
        if not len(left):  # NaN has no nearest code
            left = np.zeros(1, dtype=np.int64)
        exact = self.lengths[left] - 2 * (vectors @ self.codes[left].T)
        return left[exact.argmin(axis=1)]


def nearest_codes(books: list[Book], vectors: Array) -> Array:
    """The sum of the nearest codes, codebook by codebook, each to what those before leave. (M, D) -> (M, D)"""
    residual, found = vectors, np.zeros_like(vectors)
    for book in books:
        code = book.codes[book.nearest(residual)]
        found, residual = found + code, residual - code
    return found
