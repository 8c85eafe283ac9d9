"""Confidence intervals over clips: frames of a clip are not independent, nor are clips that overlap."""

from __future__ import annotations

import math
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Unit = Literal["auto", "take", "scene"]
"""What an interval takes as independent; see `independent_units`."""

ENOUGH_TAKES = 5
"""From so many recordings on, intervals are over recordings."""

STUDENT = (12.71, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160, 2.145, 2.131)
"""95 % of Student's t lies within so many deviations, by degrees of freedom from 1 on."""

AT_ONCE = 1_000_000
"""Units that are drawn at once, to bound memory."""


def independent_units(
    recordings: NDArray[np.int64], starts: NDArray[np.int64], frames: int, by: Unit = "auto"
) -> NDArray[np.int64]:
    """Which test scenes to resample together, because they are not independent of each other.

    Args:
        recordings: (C,) the recording of each scene.
        starts: (C,) its first frame there.
        frames: length of a scene.
        by: `take`: all scenes of a recording are one unit. `scene`: a recording is cut into runs of scenes, so that
            the first scenes of two runs do not overlap: there are no more units than scenes that do not overlap,
            however densely scenes are taken. `auto`: `take` where there are `ENOUGH_TAKES` recordings, else `scene`,
            which takes no account of what sets one recording apart from another, so it is rather too narrow.

    Returns:
        (C,) number of each scene's unit.

    Raises:
        ValueError: `by` is something else.
    """
    if by not in get_args(Unit):
        raise ValueError(f"interval: got {by!r}, expected {', '.join(get_args(Unit))}")
    takes = np.unique(recordings)
    if by == "take" or (by == "auto" and len(takes) >= ENOUGH_TAKES):
        return np.searchsorted(takes, recordings).astype(np.int64)
    units, unit = np.zeros(len(recordings), dtype=np.int64), -1
    for take in takes:
        until = None
        for scene in np.flatnonzero(recordings == take)[np.argsort(starts[recordings == take], kind="stable")]:
            if until is None or starts[scene] >= until:
                unit, until = unit + 1, starts[scene] + frames
            units[scene] = unit
    return units


def bootstrap_interval(
    totals: Tensor,
    counts: Tensor | None = None,
    level: float = 0.95,
    resamples: int = 1000,
    generator: torch.Generator | None = None,
    units: Tensor | None = None,
) -> tuple[Tensor, Tensor] | None:
    """Confidence interval of the mean by percentile bootstrap over independent units.

    With fewer than some ten units it is too narrow.

    Args:
        totals: (C,) one value a clip, or its sum.
        counts: (C,) what each sum is over; None: plain values.
        level: share of resamples inside.
        resamples: how many.
        generator: None draws the same resamples every time. Units are sorted first, so their order,
            which depends on the number of processes, makes no difference.
        units: (C,) int, the unit that each clip is resampled with; a negative one, and None: a clip is its own.

    Returns:
        Lower and upper end; None with fewer than two units, which say nothing of others.
    """
    counts = torch.ones_like(totals) if counts is None else counts
    sums = torch.stack([totals, counts], dim=-1).double().cpu()
    if units is not None:
        units = units.cpu()
        own = torch.arange(len(units)) + int(units.max().clamp_min(-1)) + 1 if len(units) else units
        _, place = torch.where(units < 0, own, units).unique(return_inverse=True)
        sums = torch.zeros(int(place.max()) + 1 if len(place) else 0, 2, dtype=sums.dtype).index_add_(0, place, sums)
    sums = sums[sums[:, 1] > 0]
    if len(sums) < 2:
        return None
    sums = sums[sums[:, 1].argsort(stable=True)]
    sums = sums[sums[:, 0].argsort(stable=True)]
    if generator is None:
        generator = torch.Generator().manual_seed(0)
    means = []
    for several in torch.arange(resamples).split(max(1, AT_ONCE // len(sums))):
        drawn = torch.randint(len(sums), (len(several), len(sums)), generator=generator)
        means.append(sums[drawn].sum(dim=1))
    total, count = torch.cat(means).unbind(-1)
    tail = (1 - level) / 2
    ends = torch.quantile(total / count, torch.tensor([tail, 1 - tail], dtype=torch.float64))
    return ends[0].to(totals.device), ends[1].to(totals.device)


def student(free: int) -> float:
    """So many standard errors enclose 95 %, with so many degrees of freedom, at least one."""
    return STUDENT[free - 1] if free <= len(STUDENT) else 1.96 + 2.5 / free


def widening(units: int) -> float:
    """What the distance of a bootstrap's 95 % ends from its estimate is multiplied by, with so few units, at least two.

    Resamples spread as if the deviation had been divided by the number of units, and as if it were known exactly.
    """
    return student(units - 1) / 1.96 * math.sqrt(units / (units - 1))


def histogram_of(values: Tensor, width: float, bins: int) -> Tensor:
    """How many values lie in each bin: bin k holds ((k - 1) width, k width], bin 0 zero and below. (...) -> (bins,)

    What is larger than all bins counts in the last one.
    """
    bin = (values.flatten() / width).ceil().long().clamp(0, bins - 1)
    return torch.bincount(bin, minlength=bins).double()


def quantile(histogram: Tensor, q: float, width: float) -> Tensor:
    """The value with a share `q` of all counts below it, between the edges of its bin. (bins,), some count -> scalar"""
    upto = histogram.cumsum(dim=0)
    wanted = q * upto[-1]
    bin = torch.searchsorted(upto, wanted)
    inside = (wanted - upto[bin] + histogram[bin]) / histogram[bin]
    return (bin - 1 + inside).clamp(min=0) * width
