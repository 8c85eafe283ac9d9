"""Confidence intervals over clips: clips are independent of each other, frames are not."""

import torch
from torch import Tensor


def bootstrap_interval(
    totals: Tensor,
    counts: Tensor | None = None,
    level: float = 0.95,
    resamples: int = 1000,
    generator: torch.Generator | None = None,
) -> tuple[Tensor, Tensor]:
    """Where the mean would lie for other clips of the same kind: percentile bootstrap.

    Args:
        totals: (C,) one value a clip, or its sum.
        counts: (C,) what each sum is over; None: plain values.
        generator: None draws the same resamples every time. Clips are sorted first, so their order,
            which depends on the number of processes, makes no difference.

    Returns:
        Lower and upper end; both NaN-free. One clip gives an interval without width.

    Raises:
        ValueError: no clip has anything to count.
    """
    counts = torch.ones_like(totals) if counts is None else counts
    some = counts > 0
    if not bool(some.any()):
        raise ValueError("no clip has a value; an interval needs at least one")
    rows = torch.stack([totals[some], counts[some]], dim=-1).double().cpu()
    rows = rows[rows[:, 1].argsort(stable=True)]
    rows = rows[rows[:, 0].argsort(stable=True)]
    if generator is None:
        generator = torch.Generator().manual_seed(0)
    means = []
    for _ in range(resamples):
        drawn = rows[torch.randint(len(rows), (len(rows),), generator=generator)].sum(dim=0)
        means.append(drawn[0] / drawn[1])
    tail = (1 - level) / 2
    ends = torch.quantile(torch.stack(means), torch.tensor([tail, 1 - tail], dtype=torch.float64))
    return ends[0].to(totals.device), ends[1].to(totals.device)
