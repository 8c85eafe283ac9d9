"""FD: distance between the distributions of generated and real poses (metrics.md B.1)."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from magnet.metrics.base import MotionMetric, Of
from magnet.metrics.futures import Futures, without_pelvis
from magnet.motion.frames import from_planar, inverse, partners

Features = Literal["world_joints", "canonical_joints", "velocity", "pair"]

FEATURES = 63

JITTER = 1e-6


def frechet_distance(mu1: Tensor, s1: Tensor, mu2: Tensor, s2: Tensor, jitter: float = JITTER) -> Tensor:
    """|mu1 - mu2|^2 + tr(s1 + s2 - 2 (s1^.5 s2 s1^.5)^.5) of two Gaussians. (D,), (D, D) x 2 -> scalar

    `jitter * (tr s + 1)` is added to each covariance's diagonal, so that fewer frames than dimensions do
    no harm; roots by eigenvalues, the negative ones of rounding taken as 0.
    """
    eye = torch.eye(len(mu1), dtype=mu1.dtype, device=mu1.device)
    s1, s2 = (s + jitter * (s.trace() + 1) * eye for s in (s1, s2))
    values, vectors = torch.linalg.eigh(s1)
    root = (vectors * values.clamp(min=0).sqrt()) @ vectors.T
    cross = root @ s2 @ root
    overlap = torch.linalg.eigvalsh((cross + cross.T) / 2).clamp(min=0).sqrt().sum()
    return ((mu1 - mu2) ** 2).sum() + s1.trace() + s2.trace() - 2 * overlap


def moments(count: Tensor, total: Tensor, outer: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and unbiased covariance from sums. (), (D,), (D, D) -> (D,), (D, D)"""
    mean = total / count
    return mean, (outer - count * torch.outer(mean, mean)) / (count - 1)


def joint_canonical_frame(joints: Tensor) -> Tensor:
    """Frame on the ground under the pelvis, its x axis along the line through the hips. (..., 22, 3) -> (..., 4, 4)

    Joints alone do not give the pelvis's rotation, so this is near `magnet.motion`'s frame, not equal to it.
    """
    left = joints[..., 1, :] - joints[..., 2, :]
    return from_planar(torch.atan2(-left[..., 2], left[..., 0]), joints[..., 0, [0, 2]])


def seen_from(T_world_self: Tensor, joints: Tensor) -> Tensor:
    """World joints in another frame. (..., 4, 4), (..., J, 3) -> (..., J, 3)"""
    T_self_world = inverse(T_world_self)
    return joints @ T_self_world[..., :3, :3].transpose(-1, -2) + T_self_world[..., None, :3, 3]


def pose_features(joints: Tensor, features: Features, fps: float = 30.0) -> Tensor:
    """What is compared, 63 numbers each. (..., T, P, 22, 3) -> (..., T, P, 63); see `FrechetDistance`.

    `velocity` has T - 1 frames; `pair` has (..., T, P, P - 1, 63).
    """
    if features == "world_joints":
        chosen = joints
    elif features == "velocity":
        chosen = joints.diff(dim=-4) * fps
    elif features == "canonical_joints":
        chosen = seen_from(joint_canonical_frame(joints), joints)
    elif features == "pair":
        partner = joints[..., partners(joints.shape[-3], joints.device), :, :]
        chosen = seen_from(joint_canonical_frame(joints)[..., None, :, :], partner)
    else:
        raise ValueError(f"features={features!r}: expected world_joints, canonical_joints, velocity or pair")
    return without_pelvis(chosen).flatten(-2)


class FrechetDistance(MotionMetric):
    """`fd` in m^2 (`velocity`: (m/s)^2): all frames, agents, samples and clips pooled, no encoder, no z-score.

    The default reads world coordinates, as the paper does, so it depends on where scenes are placed: a
    shift of 1 m costs 21. Report it beside the value of real motion against real motion. With fewer than
    some hundred independent frames the covariance is poor and the distance too large.

    Args:
        features: `world_joints`; `canonical_joints`, each body in its own frame; `velocity`;
            `pair`, each partner's body in one's own frame. All but the first are named
            `fd_<features>` and do not change when the world is moved, `velocity` when it is shifted.
    """

    higher_is_better = False

    count: Tensor  # (2,) generated and truth
    sum: Tensor  # (2, 63)
    outer: Tensor  # (2, 63, 63)

    def __init__(
        self,
        features: Features = "world_joints",
        fps: float = 30.0,
        jitter: float = JITTER,
        of: Of = "generated",
        agents: Tensor | None = None,
    ) -> None:
        super().__init__(of, agents)
        self.features: Features = features
        self.fps = fps
        self.jitter = jitter
        self.name = "fd" if features == "world_joints" else f"fd_{features}"
        self.add_sum("count", 2)
        self.add_sum("sum", 2, FEATURES)
        self.add_sum("outer", 2, FEATURES, FEATURES)

    def add(self, futures: Futures) -> None:
        counts = self._counts(futures)
        for which, joints in [(1, futures.truth), *((0, sample) for sample in futures.generated)]:
            features = pose_features(joints, self.features, self.fps)
            kept = features[counts]
            self.count[which] += len(kept)
            self.sum[which] += kept.sum(dim=0)
            self.outer[which] += kept.T @ kept

    def _counts(self, futures: Futures) -> Tensor:
        """Which features are pooled: (B, T, P), (B, T - 1, P) or (B, T, P, P - 1) bool"""
        if self.features != "pair":
            return futures.spans(2 if self.features == "velocity" else 1)
        partner = partners(futures.present.shape[1], futures.present.device)
        both = futures.present[:, :, None] & futures.present[:, partner]
        return both[:, None] & (futures.scored[..., None] | futures.scored[..., partner])

    def compute(self) -> dict[str, Tensor]:
        if bool((self.count < 2).any()):
            return {}
        generated, truth = (moments(self.count[i], self.sum[i], self.outer[i]) for i in range(2))
        return {self.name: frechet_distance(*generated, *truth, jitter=self.jitter)}
