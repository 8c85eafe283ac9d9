"""Masks over time: runs of True, and what stands in for the rest."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Number = TypeVar("Number", bound=np.floating[Any])


def true_runs(mask: NDArray[np.bool_] | Sequence[bool], least: int = 1) -> list[tuple[int, int]]:
    """Runs of True that are at least so long, as (start, stop). mask (T,)

    >>> true_runs([True, True, False, True])
    [(0, 2), (3, 4)]
    """
    edges = np.flatnonzero(np.diff(np.asarray([False, *mask, False], dtype=np.int8)))
    return [(int(start), int(stop)) for start, stop in edges.reshape(-1, 2) if stop - start >= least]


def filled(array: NDArray[Number], valid: NDArray[np.bool_]) -> NDArray[Number]:
    """Fill invalid frames with the last valid frame before them, or else the first one. (T, P, ...), (T, P)"""
    if valid.all():
        return array
    T = len(valid)
    seen = np.maximum.accumulate(np.where(valid, np.arange(T)[:, None], -1), axis=0)
    take = np.where(seen < 0, valid.argmax(axis=0), seen)
    return array[take, np.arange(valid.shape[1])]
