"""z-scores by stored statistics."""

from __future__ import annotations

import torch
from torch import Tensor

from magnet.precision import Float32

FLOOR = 1e-2
"""Smallest standard deviation of poses and transforms: several of their numbers are nearly constant."""


class Normalizer(Float32):
    """Standardizes each number of a vector by a stored mean and standard deviation; until they are set, the identity.

    Args:
        size: numbers D in a vector.
        floor: smallest standard deviation, so that numbers that hardly vary do not fill the range with noise.
    """

    mean: Tensor
    std: Tensor
    ready: Tensor  # () bool

    def __init__(self, size: int, floor: float = FLOOR) -> None:
        super().__init__()
        self.floor = floor
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float32))
        self.register_buffer("std", torch.ones(size, dtype=torch.float32))
        self.register_buffer("ready", torch.tensor(False))

    def set(self, mean: Tensor, std: Tensor) -> None:
        """Store the statistics, (D,) each."""
        self.mean.copy_(mean)
        self.std.copy_(std.clamp(min=self.floor))
        self.ready.fill_(True)

    def normalize(self, x: Tensor) -> Tensor:
        """(..., D) in real units -> (..., D)"""
        return (x - self.mean) / self.std

    def denormalize(self, z: Tensor) -> Tensor:
        """Inverse of `normalize`."""
        return z * self.std + self.mean
