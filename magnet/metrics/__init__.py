"""Metrics of generated motion: a pure function on joints, then a thin torchmetrics Metric (paper 4)."""

from __future__ import annotations

from typing import Any

from torch import Tensor
from torchmetrics import Metric

from magnet.body.contact import hand_distance, penetration_depth, segment_distance, toe_steps
from magnet.body.energy import hand_points
from magnet.metrics.base import ClipMeans, MotionMetric, Of
from magnet.metrics.body_depth import BodyDepth
from magnet.metrics.collection import MotionMetrics
from magnet.metrics.columns import Beside, Better, Column, beside, column, columns_of
from magnet.metrics.diversity import Diversity, diversity
from magnet.metrics.floor import Down, Floating, GroundPenetration, lowest_foot
from magnet.metrics.frechet import FrechetBySecond, FrechetDistance, frechet_distance
from magnet.metrics.futures import Futures
from magnet.metrics.hand_contact import HandContact
from magnet.metrics.interaction import MotionInteraction, pearson
from magnet.metrics.interval import bootstrap_interval, independent_units
from magnet.metrics.jitter import Jitter, Jolts, jitter
from magnet.metrics.memorisation import NearestTraining
from magnet.metrics.partners import PartnerBearing, PartnerDistance, TurnRate, bearing, partner_distance, turn_rate
from magnet.metrics.penetration import Interpenetration
from magnet.metrics.position_error import PositionError, VelocityError, joint_error, velocity_error
from magnet.metrics.registry import other_metrics
from magnet.metrics.skating import FootSkating, StandingToes
from magnet.metrics.token_borders import TokenBorders
from magnet.motion.scene import FPS

__all__ = [
    "Beside",
    "Better",
    "BodyDepth",
    "ClipMeans",
    "Column",
    "Diversity",
    "Down",
    "Floating",
    "FootSkating",
    "FrechetBySecond",
    "FrechetDistance",
    "Futures",
    "GroundPenetration",
    "HandContact",
    "Interpenetration",
    "Jitter",
    "Jolts",
    "MotionInteraction",
    "MotionMetric",
    "MotionMetrics",
    "NearestTraining",
    "PartnerBearing",
    "PartnerDistance",
    "PositionError",
    "StandingToes",
    "TokenBorders",
    "TurnRate",
    "VelocityError",
    "all_metrics",
    "bearing",
    "beside",
    "bootstrap_interval",
    "column",
    "columns_of",
    "diversity",
    "frechet_distance",
    "ground_truth_metrics",
    "hand_distance",
    "hand_points",
    "independent_units",
    "jitter",
    "joint_error",
    "lowest_foot",
    "partner_distance",
    "pearson",
    "penetration_depth",
    "segment_distance",
    "toe_steps",
    "turn_rate",
    "velocity_error",
]


def all_metrics(fps: float = FPS, scored: Tensor | None = None, confidence: float | None = None) -> MotionMetrics:
    """Every metric of the paper's tables, a few more, and those of installed packages (entry points `magnet.metrics`).

    They are fed together: `update(generated, truth, present)`.

    Args:
        scored: (P,) or (T, P) bool, what was generated: partner tasks generate the partner, in-betweening the frames
            between keyframes; None: everything. `update(..., agents=...)` says it for one batch instead.
        confidence: such as 0.95, for metrics that are means over clips; adds `_low` and `_high`.
    """
    ours = _ours(fps, scored, confidence)  # made first: it refuses what no metric takes
    others = other_metrics(_ours, "generated", scored, fps, confidence)
    return MotionMetrics({**ours, **others}, compute_groups=False)


def ground_truth_metrics(
    fps: float = FPS, scored: Tensor | None = None, confidence: float | None = None
) -> MotionMetrics:
    """What recorded motion itself has, under the names of `all_metrics`: the ground truth's row of a table.

    Fed like `all_metrics`; what is generated is not read.
    """
    ours = _of_motion(fps, "truth", scored, confidence)
    others = other_metrics(_ours, "truth", scored, fps, confidence)
    return MotionMetrics({**ours, **others}, compute_groups=False)


def _ours(fps: float = FPS, scored: Tensor | None = None, confidence: float | None = None) -> dict[str, Metric]:
    means: dict[str, Any] = {"agents": scored, "confidence": confidence, "fps": fps}
    return {
        "FD": FrechetDistance(fps=fps, agents=scored),
        "FD pair": FrechetBySecond("pair", fps=fps, agents=scored),
        "FD own pose": FrechetDistance("canonical_joints", fps=fps, agents=scored),
        "FD own velocity": FrechetDistance("own_velocity", fps=fps, agents=scored),
        "DIV": Diversity(**means),
        **_of_motion(fps, "generated", scored, confidence),
        "MPJPE": PositionError(**means),
        "MPJVE": VelocityError(**means),
    }


def _of_motion(fps: float, of: Of, scored: Tensor | None, confidence: float | None) -> dict[str, Metric]:
    """Metrics that need one motion, or for MI make sense of one."""
    means: dict[str, Any] = {"of": of, "agents": scored, "confidence": confidence, "fps": fps}
    return {
        "MI": MotionInteraction(of=of, agents=scored),
        "FS": FootSkating(**means),
        "IP": Interpenetration(**means),
        "depth": BodyDepth(**means),
        "bearing": PartnerBearing(**means),
        "turning": TurnRate(of=of, agents=scored, fps=fps),
        "hands": HandContact(**means),
        "distance": PartnerDistance(of=of, agents=scored),
        "floating": Floating(**means),
        "down": Down(**means),
        "ground": GroundPenetration(**means),
        "toes": StandingToes(**means),
        "jitter": Jitter(**means),
        "jolts": Jolts(**means),
        "borders": TokenBorders(of=of, agents=scored),
    }
