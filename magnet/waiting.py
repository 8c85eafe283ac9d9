"""Whether the host may look at numbers: of a CPU at any time, for those of a GPU it would have to wait.

What looks chooses shapes by what it sees (only those who are there, only scenes with a past). Off a CPU such code takes
fixed shapes and masks, so that nothing waits and a whole training step can be recorded once (`magnet.cuda_graphs`).
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

_looking = True


def may_look(device: torch.device) -> bool:
    """Whether looking at numbers that are on a device costs nothing."""
    return _looking and device.type == "cpu"


def is_recording(device: torch.device) -> bool:
    """Whether a CUDA graph is being recorded, in which looking is not slow but impossible."""
    return not _looking or (device.type == "cuda" and torch.cuda.is_current_stream_capturing())


@contextmanager
def as_off_cpu() -> Iterator[None]:
    """Within it numbers on a CPU are not looked at either, as if a GPU recorded what runs: for tests and rehearsals."""
    global _looking
    before, _looking = _looking, False
    try:
        yield
    finally:
        _looking = before


def constant(values: tuple[float, ...], like: Tensor) -> Tensor:
    """A vector of numbers on the device and of the type of another tensor, sent there once."""
    return _constant(values, like.device, like.dtype)


@functools.cache
def _constant(values: tuple[float, ...], device: torch.device, dtype: torch.dtype) -> Tensor:
    with torch.inference_mode(False):  # or training, later, could not use it
        return torch.tensor(values, device=device, dtype=dtype)
