"""Metrics of generated motion: a pure function on joints, then a thin torchmetrics Metric (paper 4; A.4)."""

from __future__ import annotations

from typing import Any

from torch import Tensor
from torchmetrics import Metric, MetricCollection

from magnet.metrics.base import ClipMeans, MotionMetric, Of
from magnet.metrics.diversity import Diversity, diversity
from magnet.metrics.frechet import FrechetDistance, frechet_distance
from magnet.metrics.futures import Futures
from magnet.metrics.interaction import MotionInteraction, pearson
from magnet.metrics.interval import bootstrap_interval
from magnet.metrics.jitter import Jitter, jitter
from magnet.metrics.partners import HandsHeld, PartnerDistance, hand_distance, partner_distance
from magnet.metrics.penetration import Interpenetration, penetration_depth, segment_distance
from magnet.metrics.position_error import PositionError, joint_error
from magnet.metrics.skating import FootSkating, toe_steps
from magnet.metrics.velocity_error import VelocityError, velocity_error

__all__ = [
    "ClipMeans",
    "Diversity",
    "FootSkating",
    "FrechetDistance",
    "Futures",
    "HandsHeld",
    "Interpenetration",
    "Jitter",
    "MotionInteraction",
    "MotionMetric",
    "PartnerDistance",
    "PositionError",
    "VelocityError",
    "all_metrics",
    "bootstrap_interval",
    "diversity",
    "frechet_distance",
    "ground_truth_metrics",
    "hand_distance",
    "jitter",
    "joint_error",
    "partner_distance",
    "pearson",
    "penetration_depth",
    "segment_distance",
    "toe_steps",
    "velocity_error",
]


def all_metrics(fps: float = 30.0, scored: Tensor | None = None, confidence: float | None = None) -> MetricCollection:
    """Every metric of the paper's tables and a few more, fed together: `update(generated, truth, present)`.

    Args:
        scored: (P,) or (T, P) bool, what was generated: partner tasks generate the partner, in-betweening the frames
            between keyframes; None: everything. `update(..., agents=...)` says it for one batch instead.
        confidence: such as 0.95, for metrics that are means over clips; adds `_low` and `_high`.
    """
    means: dict[str, Any] = {"agents": scored, "confidence": confidence}
    return MetricCollection(
        {
            "FD": FrechetDistance(fps=fps, agents=scored),
            "FD pair": FrechetDistance("pair", fps=fps, agents=scored),
            "DIV": Diversity(**means),
            **_of_motion(fps, "generated", scored, confidence),
            "MPJPE": PositionError(fps, **means),
            "MPJVE": VelocityError(fps, **means),
        },
        compute_groups=False,
    )


def ground_truth_metrics(
    fps: float = 30.0, scored: Tensor | None = None, confidence: float | None = None
) -> MetricCollection:
    """What recorded motion itself has, under the names of `all_metrics`: the ground truth's row of a table.

    Fed like `all_metrics`; what is generated is not read.
    """
    return MetricCollection(dict(_of_motion(fps, "truth", scored, confidence)), compute_groups=False)


def _of_motion(fps: float, of: Of, scored: Tensor | None, confidence: float | None) -> dict[str, Metric]:
    """Metrics that need one motion, or for MI make sense of one."""
    means: dict[str, Any] = {"of": of, "agents": scored, "confidence": confidence}
    return {
        "MI": MotionInteraction(of=of, agents=scored),
        "FS": FootSkating(fps, **means),
        "IP": Interpenetration(**means),
        "jitter": Jitter(fps, **means),
        "hands": HandsHeld(**means),
        "distance": PartnerDistance(of=of, agents=scored),
    }
