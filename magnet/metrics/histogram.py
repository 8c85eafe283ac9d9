"""Quantiles that merge exactly over processes: read off a histogram, they are within one bin's width."""

from __future__ import annotations

import torch
from torch import Tensor


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
