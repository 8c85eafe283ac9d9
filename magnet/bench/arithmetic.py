"""The arithmetic floor: the matrix products of an evaluation of the network, run alone, on the same numbers."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

Clock = Callable[[], float]
"""Seconds: `time.perf_counter`, or `time.process_time`, which others on the machine disturb less."""

PRODUCTS = ("mm", "addmm", "bmm", "baddbmm", "convolution", "_scaled_dot_product", "_linear_pointwise")
"""Beginnings of the names of the operators that count: everything that grows with a product of two sizes."""


class Recorder(TorchDispatchMode):
    """Counts every operator that runs within it, and keeps those that are matrix products.

    Attributes:
        operators: how many ran.
        products: the matrix products, ready to be run again.
    """

    def __init__(self) -> None:
        super().__init__()
        self.operators = 0
        self.products: list[Callable[[], Any]] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        self.operators += 1
        if func._schema.name.rpartition("::")[2].startswith(PRODUCTS):
            self.products.append(lambda: func(*args, **kwargs))
        return func(*args, **kwargs)


def products_of(run: Callable[[], Any]) -> tuple[list[Callable[[], Any]], int]:
    """The matrix products that a function runs, and how many operators it runs in all."""
    with torch.no_grad(), Recorder() as recorder:
        run()
    return recorder.products, recorder.operators


def seconds_of(runs: Iterable[Callable[[], Any]], device: torch.device, clock: Clock = time.perf_counter) -> float:
    """How long some functions take together, until the device is done."""
    began = clock()
    for run in runs:
        run()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return clock() - began
