"""Numbers of joints and pairs of people as tensors that are kept: lists would become tensors at every call."""

from __future__ import annotations

import functools

import torch
from torch import Tensor


@functools.cache
def indices(numbers: tuple[int, ...], device: torch.device) -> Tensor:
    """Whole numbers on a device. -> (N,) int

    >>> indices((20, 21), torch.device("cpu"))
    tensor([20, 21])
    """
    with torch.inference_mode(False):  # or training, later, could not use them
        return torch.tensor(numbers, device=device)


def picked(points: Tensor, joints: tuple[int, ...]) -> Tensor:
    """Some joints of all. (..., J, 3) -> (..., len(joints), 3)"""
    return points.index_select(-2, indices(joints, points.device))


@functools.cache
def pairs_of(people: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """The people of each pair, in the order of `combinations`. -> (Q,) x 2"""
    with torch.inference_mode(False):
        first, second = torch.combinations(torch.arange(people, device=device)).unbind(dim=1)
    return first, second
