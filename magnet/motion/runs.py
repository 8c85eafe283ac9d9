"""Runs of True in a mask over time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def true_runs(mask: NDArray[np.bool_] | Sequence[bool], least: int = 1) -> list[tuple[int, int]]:
    """Runs of True that are at least so long, as (start, stop). mask (T,)

    >>> true_runs([True, True, False, True])
    [(0, 2), (3, 4)]
    """
    edges = np.flatnonzero(np.diff(np.asarray([False, *mask, False], dtype=np.int8)))
    return [(int(start), int(stop)) for start, stop in edges.reshape(-1, 2) if stop - start >= least]
