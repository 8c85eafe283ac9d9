"""IP: how much bodies run through each other, as capsules (docs/metrics.md)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from magnet.body.contact import penetration_depth
from magnet.metrics.base import ClipMeans
from magnet.metrics.columns import Column
from magnet.metrics.futures import Futures

CHUNK = 8192
"""Pairs of bodies looked at together, to bound memory."""


class Interpenetration(ClipMeans):
    """`ip_ratio`: share of frames in which any two people penetrate each other; the paper's "IP" as read here.

    Beside it `ip_mean_total_depth`, the depths summed over capsules and pairs of people, mean over *all*
    frames, and `ip_mean_max_depth`, the deepest in a frame, mean over the frames with any; both in metres.
    Frames without two people (one of them scored) are not counted.

    >>> from magnet.testing import standing_people
    >>> truth = standing_people(frames=60, agents=2)  # (1, 60, 2, 22, 3), a metre apart one behind the other
    >>> metric = Interpenetration()
    >>> metric.update(truth[None], truth)
    >>> round(metric.compute()["ip_ratio"].item(), 3)
    0.0
    """

    higher_is_better = False
    columns: ClassVar[Mapping[str, Column]] = {
        "ip_ratio": Column("IP", "", "low", "share of frames in which people run through each other"),
        "ip_mean_total_depth": Column("IP depth", "m", "low", "summed depth of penetration, mean over all frames"),
        "ip_mean_max_depth": Column("IP deepest", "m", "low", "deepest penetration, mean over frames with any"),
    }

    def measure(self, futures: Futures) -> list[tuple[Tensor, Tensor]]:
        first, second, counts = futures.pairs()
        S, B, T = futures.generated.shape[:3]
        total = futures.generated.new_zeros(S, B, T)
        deepest = torch.zeros_like(total)
        for q, (one, other) in enumerate(zip(first.tolist(), second.tolist(), strict=True)):
            places = counts[..., q]  # (B, T)
            pair = futures.generated[:, places][..., [one, other], :, :]  # (S, n, 2, 22, 3)
            if not pair.numel():
                continue
            depths = [penetration_depth(*part.unbind(1)) for part in pair.flatten(0, 1).split(CHUNK)]
            shape = pair.shape[:2]
            total[:, places] += torch.cat([depth.sum(dim=(1, 2)) for depth in depths]).view(shape)
            worst = torch.cat([depth.amax(dim=(1, 2)) for depth in depths]).view(shape)
            deepest[:, places] = torch.maximum(deepest[:, places], worst)
        frames = counts.any(dim=-1).sum(dim=1) * S
        hit = deepest > 0
        hits = hit.sum(dim=(0, 2))
        return [(hits, frames), (total.sum(dim=(0, 2)), frames), (deepest.sum(dim=(0, 2)), hits)]
