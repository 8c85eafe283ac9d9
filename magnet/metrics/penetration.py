"""IP: how much bodies run through each other, as capsules (docs/metrics.md)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from magnet.metrics.base import ClipMeans
from magnet.metrics.columns import Column
from magnet.metrics.futures import Futures

FOREARMS = (7, 8)
"""Capsules that may cross: people who hold hands or link arms do not collide."""

TOUCH = 0.05
"""Depth in metres under which capsules only touch."""

CHUNK = 8192
"""Pairs of bodies looked at together, to bound memory."""


def point_segment_distance(point: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """(..., 3) x 3 -> (...); the segment from a to b may be a point.

    >>> point, a, b = torch.tensor([0.0, 3.0, 0.0]), torch.tensor([-1.0, 0.0, 0.0]), torch.tensor([1.0, 0.0, 0.0])
    >>> point_segment_distance(point, a, b)
    tensor(3.)
    """
    along = b - a
    length = (along * along).sum(dim=-1)
    share = ((point - a) * along).sum(dim=-1) / torch.where(length > 0, length, 1.0)
    return (point - a - share.clamp(0, 1)[..., None] * along).norm(dim=-1)


def segment_distance(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> Tensor:
    """Smallest distance between the segments a-b and c-d, either of which may be a point. (..., 3) x 4 -> (...)

    Two segments come closest either at an end of one of them or where their lines do. Taking the least of
    those five distances needs no case for parallel lines: each is a true distance between two of their
    points, so a badly conditioned fifth can only be too long, and then an end is right.
    """
    a, b, c, d = torch.broadcast_tensors(a, b, c, d)
    u, v, w = b - a, d - c, a - c
    uu, vv, uv = (u * u).sum(-1), (v * v).sum(-1), (u * v).sum(-1)
    uw, vw = (u * w).sum(-1), (v * w).sum(-1)
    det = uu * vv - uv * uv
    det = torch.where(det > 0, det, 1.0)
    s = ((uv * vw - vv * uw) / det).clamp(0, 1)
    t = ((uu * vw - uv * uw) / det).clamp(0, 1)
    inner = (w + s[..., None] * u - t[..., None] * v).norm(dim=-1)
    ends = [
        point_segment_distance(a, c, d),
        point_segment_distance(b, c, d),
        point_segment_distance(c, a, b),
        point_segment_distance(d, a, b),
    ]
    return torch.stack([inner, *ends]).amin(dim=0)


def penetration_depth(joints: Tensor, partner: Tensor, touch: float = TOUCH, forearms: bool = False) -> Tensor:
    """How deep each capsule of one body is in each of another. (N, 22, 3) x 2 -> (N, 13, 13) metres

    Depths below `touch` are 0, and so is forearm against forearm unless asked for.
    """
    from magnet.body.capsules import capsule_segments

    a, b, radius = capsule_segments(joints)
    c, d, _ = capsule_segments(partner)
    reach = radius[:, None] + radius
    # Only capsules whose bounding spheres overlap enough can count; the rest need no segment distance.
    centres = torch.cdist((a + b) / 2, (c + d) / 2, compute_mode="donot_use_mm_for_euclid_dist")
    halves = ((b - a).norm(dim=-1)[:, :, None] + (d - c).norm(dim=-1)[:, None]) / 2
    near = centres - halves <= reach - touch + 1e-9
    if not forearms:
        near[:, FOREARMS[0] : FOREARMS[1] + 1, FOREARMS[0] : FOREARMS[1] + 1] = False
    n, i, j = near.nonzero(as_tuple=True)
    found = reach[i, j] - segment_distance(a[n, i], b[n, i], c[n, j], d[n, j])
    depth = torch.zeros_like(centres)
    depth[n, i, j] = torch.where(found >= touch, found.clamp(min=0.0), 0.0)
    return depth


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
