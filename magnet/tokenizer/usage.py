"""How much of a codebook is used."""

from __future__ import annotations

import torch
from torch import Tensor
from torchmetrics import Metric


def usage(counts: Tensor) -> Tensor:
    """Share of the codes that were chosen at all. (..., codes) -> (...)"""
    return (counts > 0).float().mean(-1)


def perplexity(counts: Tensor) -> Tensor:
    """Perplexity of the codes chosen: exp of their entropy. (..., codes) -> (...), from 1 to codes"""
    share = counts.double() / counts.double().sum(-1, keepdim=True).clamp(min=1)
    return torch.special.entr(share).sum(-1).exp().float()


def by_quantizer(counts: Tensor) -> dict[str, Tensor]:
    """Usage and perplexity of each quantizer, numbered when there are several. counts: (quantizers, codes)"""
    named = {}
    for number, count in enumerate(counts):
        suffix = f"_{number}" if len(counts) > 1 else ""
        named[f"usage{suffix}"] = usage(count)
        named[f"perplexity{suffix}"] = perplexity(count)
    return named


class CodeUse(Metric):
    """Usage and perplexity over an epoch, exact over processes.

    Args:
        num_quantizers: residual quantizers in a row.
        codebook_size: codes of each.
    """

    higher_is_better = True
    full_state_update = False
    counts: Tensor  # (quantizers, codes)

    def __init__(self, num_quantizers: int, codebook_size: int) -> None:
        super().__init__()
        counts = torch.zeros(num_quantizers, codebook_size, dtype=torch.long)
        self.add_state("counts", counts, dist_reduce_fx="sum")

    def update(self, counts: Tensor) -> None:
        self.counts += counts.long()

    def compute(self) -> dict[str, Tensor]:
        return by_quantizer(self.counts)
