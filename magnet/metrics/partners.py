"""How far apart people stand."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from magnet.body.joints import PELVIS
from magnet.metrics.base import ClipMeans, MotionMetric, clip_sums
from magnet.metrics.columns import Column
from magnet.metrics.futures import Futures
from magnet.metrics.interval import histogram_of, quantile
from magnet.metrics.own_frame import joint_canonical_frame, seen_from
from magnet.motion.frames import to_planar
from magnet.motion.scene import FPS


def partner_distance(joints: Tensor, partner: Tensor) -> Tensor:
    """Between two pelvises over the ground. (..., 22, 3) x 2 -> (...) metres"""
    return (joints - partner)[..., PELVIS, [0, 2]].norm(dim=-1)


class PartnerDistance(MotionMetric):
    """`partner_distance` in metres: median over samples, frames and pairs of people.

    It is read off a histogram: within `BIN` metres, and `FARTHEST` for people farther apart than that.

    >>> from magnet.testing import standing_people
    >>> truth = standing_people(frames=60, agents=2)  # (1, 60, 2, 22, 3), a metre apart one behind the other
    >>> metric = PartnerDistance()
    >>> metric.update(truth[None], truth)
    >>> round(metric.compute()["partner_distance"].item(), 3)
    0.998
    """

    columns: ClassVar[Mapping[str, Column]] = {
        "partner_distance": Column("distance", "m", "real", "median between two pelvises over the ground")
    }

    BIN = 0.005
    FARTHEST = 20.0

    histogram: Tensor

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.add_sum("histogram", round(self.FARTHEST / self.BIN) + 1)

    def add(self, futures: Futures) -> None:
        first, second, counts = futures.pairs()
        apart = partner_distance(futures.generated[..., first, :, :], futures.generated[..., second, :, :])
        self.histogram += histogram_of(apart[counts.expand_as(apart)], self.BIN, len(self.histogram))

    def compute(self) -> dict[str, Tensor]:
        if float(self.histogram.sum()) == 0:
            return {}
        return {"partner_distance": quantile(self.histogram, 0.5, self.BIN)}


def bearing(joints: Tensor, partner: Tensor) -> Tensor:
    """Angle about the vertical from where a person's hips face to the partner's pelvis.

    (..., 22, 3) x 2 -> (...) radians, 0 straight ahead, positive to the left.
    """
    pelvis = seen_from(joint_canonical_frame(joints), partner[..., :1, :])[..., 0, :]
    return torch.atan2(pelvis[..., 0], pelvis[..., 2])


def turn_rate(joints: Tensor, fps: float = FPS) -> Tensor:
    """How fast the hips turn about the vertical, either way. (..., T, P, 22, 3) -> (..., T - 1, P) degrees/s"""
    yaw, _ = to_planar(joint_canonical_frame(joints))
    step = yaw.diff(dim=-2)
    return torch.atan2(step.sin(), step.cos()).abs().rad2deg() * fps


class PartnerBearing(ClipMeans):
    """`facing`: share of frames in which two people face each other; `behind`: in which one has the other behind.

    Two people face each other where each has the other within `within` degrees of straight ahead. Somebody is behind at
    more than 90 degrees; each of the two counts by itself, so one who follows another counts half. Means over samples,
    frames and pairs of people.

    >>> from magnet.testing import standing_people
    >>> truth = standing_people(frames=60, agents=2)  # (1, 60, 2, 22, 3), a metre apart one behind the other
    >>> metric = PartnerBearing()
    >>> metric.update(truth[None], truth)
    >>> [abs(round(metric.compute()[name].item(), 3)) for name in ("facing", "behind")]
    [0.0, 0.5]
    """

    columns: ClassVar[Mapping[str, Column]] = {
        "facing": Column("facing", "", "real", "share of frames in which two people face each other"),
        "behind": Column("behind", "", "real", "share of frames in which one has the other behind"),
    }

    def __init__(self, within: float = 30.0, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.within = math.radians(within)

    def measure(self, futures: Futures) -> list[tuple[Tensor, Tensor]]:
        first, second, counts = futures.pairs()
        one, other = futures.generated[..., first, :, :], futures.generated[..., second, :, :]
        off = torch.stack([bearing(one, other), bearing(other, one)]).abs()  # (2, S, B, T, Q)
        facing = (off < self.within).all(dim=0)
        behind = (off > math.pi / 2).double().mean(dim=0)
        return [clip_sums(facing.double(), counts), clip_sums(behind, counts)]


class TurnRate(MotionMetric):
    """`turn_rate` in degrees/s: mean over samples, frames and people; `turn_rate@agent0` etc. are each slot's own.

    In recordings of leader and follower slot 0 leads.

    >>> from magnet.testing import standing_people
    >>> truth = standing_people(frames=60, agents=2)  # (1, 60, 2, 22, 3), a metre apart one behind the other
    >>> metric = TurnRate()
    >>> metric.update(truth[None], truth)
    >>> round(metric.compute()["turn_rate"].item(), 3)
    0.0
    """

    columns: ClassVar[Mapping[str, Column]] = {
        "turn_rate": Column("turning", "°/s", "real", "how fast people turn about the vertical")
    }

    turned: list[Tensor]  # of (P, 2) by slot: total and count

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.add_keyed("turned", 2)

    def add(self, futures: Futures) -> None:
        counts = futures.spans(2)
        rate = torch.where(counts, turn_rate(futures.generated, self.fps), 0.0).sum(dim=(0, 1, 2))
        people = torch.arange(counts.shape[-1], device=counts.device)
        self.take("turned", people, torch.stack([rate, counts.sum(dim=(0, 1)) * futures.samples], dim=-1))

    def compute(self) -> dict[str, Tensor]:
        agents, turned = self.keyed("turned")
        agents, turned = agents[turned[:, 1] > 0], turned[turned[:, 1] > 0]
        if not len(agents):
            return {}
        by_agent = {
            f"turn_rate@agent{agent}": total / count for agent, (total, count) in zip(agents, turned, strict=True)
        }
        total, count = turned.sum(dim=0)
        return {"turn_rate": total / count, **by_agent}
