"""FD: distance between the distributions of generated and real poses (docs/metrics.md)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal, get_args

import torch
from torch import Tensor

from magnet.checks import require_choice
from magnet.metrics.base import MotionMetric
from magnet.metrics.columns import Column
from magnet.metrics.futures import Futures, without_pelvis
from magnet.metrics.own_frame import joint_canonical_frame, seen_from
from magnet.motion.frames import partners
from magnet.motion.scene import FPS

Features = Literal["world_joints", "canonical_joints", "velocity", "own_velocity", "pair"]

FEATURES = 63

JITTER = 1e-6


def frechet_distance(mu1: Tensor, s1: Tensor, mu2: Tensor, s2: Tensor, jitter: float = JITTER) -> Tensor:
    """|mu1 - mu2|^2 + tr(s1 + s2 - 2 (s1^.5 s2 s1^.5)^.5) of two Gaussians. (D,), (D, D) x 2 -> scalar

    `jitter * (tr s + 1)` is added to each covariance's diagonal, so that fewer frames than dimensions do
    no harm; roots by eigenvalues. Negative eigenvalues, and a negative distance, are rounding and taken as 0.

    >>> mean, spread = torch.zeros(3), torch.eye(3)
    >>> frechet_distance(mean, spread, mean + 2, spread).round(decimals=3)  # apart by 2 in each of 3 directions
    tensor(12.)
    """
    eye = torch.eye(len(mu1), dtype=mu1.dtype, device=mu1.device)
    s1, s2 = (s + jitter * (s.trace() + 1) * eye for s in (s1, s2))
    values, vectors = torch.linalg.eigh(s1)
    root = (vectors * values.clamp(min=0).sqrt()) @ vectors.T
    cross = root @ s2 @ root
    overlap = torch.linalg.eigvalsh((cross + cross.T) / 2).clamp(min=0).sqrt().sum()
    return (((mu1 - mu2) ** 2).sum() + s1.trace() + s2.trace() - 2 * overlap).clamp(min=0)


def moments(count: Tensor, total: Tensor, outer: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and unbiased covariance from sums. (), (D,), (D, D) -> (D,), (D, D)"""
    mean = total / count
    return mean, (outer - count * torch.outer(mean, mean)) / (count - 1)


def joint_features(joints: Tensor, features: Features, fps: float = FPS) -> Tensor:
    """What is compared, 63 numbers each. (..., T, P, 22, 3) -> (..., T, P, 63); see `FrechetDistance`.

    `velocity` and `own_velocity` have T - 1 frames; `pair` has (..., T, P, P - 1, 63).
    """
    if features == "world_joints":
        chosen = joints
    elif features == "velocity":
        chosen = joints.diff(dim=-4) * fps
    elif features == "own_velocity":
        R_world_self = joint_canonical_frame(joints[..., 1:, :, :, :])[..., :3, :3]
        chosen = joints.diff(dim=-4) * fps @ R_world_self
    elif features == "canonical_joints":
        chosen = seen_from(joint_canonical_frame(joints), joints)
    elif features == "pair":
        partner = joints[..., partners(joints.shape[-3], joints.device), :, :]
        chosen = seen_from(joint_canonical_frame(joints)[..., None, :, :], partner)
    else:
        raise ValueError(f"features={features!r}: expected {', '.join(get_args(Features))}")
    return without_pelvis(chosen).flatten(-2)


class FrechetDistance(MotionMetric):
    """`fd` in m^2 (velocities: (m/s)^2): all frames, agents, samples and clips pooled, no encoder, no z-score.

    The default reads world coordinates, as the paper does, so it depends on where scenes are placed: a
    shift of 1 m costs 21. Report it beside the value of real motion against real motion. With fewer than
    some hundred independent frames the covariance is poor and the distance too large.

    Args:
        features: `world_joints`; `canonical_joints`, each body in its own frame; `velocity`; `own_velocity`, turned
            into the frame that one has behind the step; `pair`, each partner's body in one's own frame. All but the
            first are named `fd_<features>` and do not change when the world is moved, `velocity` when it is shifted.

    >>> import torch
    >>> from magnet.testing import standing_people
    >>> truth = standing_people(frames=60, agents=2)  # (1, 60, 2, 22, 3), a metre apart one behind the other
    >>> metric = FrechetDistance()
    >>> metric.update((truth + torch.tensor([1.0, 0.0, 0.0]))[None], truth)
    >>> round(metric.compute()["fd"].item(), 3)
    21.0
    """

    higher_is_better = False

    columns: ClassVar[Mapping[str, Column]] = {
        "fd": Column(
            "FD", "m²", "low", "distance between the distributions of generated and recorded poses", main=True
        ),
        "fd_canonical_joints": Column("FD own pose", "m²", "low", "FD of each body in its own frame"),
        "fd_velocity": Column("FD velocity", "m²/s²", "low", "FD of velocities in the world"),
        "fd_own_velocity": Column("FD own velocity", "m²/s²", "low", "FD of velocities in one's own frame"),
        "fd_pair": Column("FD pair", "m²", "low", "FD of the partner's body as seen from one's own frame", main=True),
    }

    count: Tensor  # (2,) generated and truth
    sum: Tensor  # (2, 63)
    outer: Tensor  # (2, 63, 63)

    def __init__(self, features: Features = "world_joints", jitter: float = JITTER, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        require_choice("features", features, Features)
        self.features: Features = features
        self.jitter = jitter
        self.name = "fd" if features == "world_joints" else f"fd_{features}"
        self.add_sum("count", 2)
        self.add_sum("sum", 2, FEATURES)
        self.add_sum("outer", 2, FEATURES, FEATURES)

    def add(self, futures: Futures) -> None:
        counts = self._counts(futures)
        for which, joints in [(1, futures.truth), *((0, sample) for sample in futures.generated)]:
            features = joint_features(joints, self.features, self.fps)
            self.pool(which, features, counts)

    def pool(self, which: int, features: Tensor, counts: Tensor) -> None:
        """Add one motion's features to the sums. (B, T, ..., 63), and which of them count: (B, T, ...) bool"""
        kept = features[counts]
        self.count[which] += len(kept)
        self.sum[which] += kept.sum(dim=0)
        self.outer[which] += kept.T @ kept

    def _counts(self, futures: Futures) -> Tensor:
        """Which features are pooled: (B, T, P), (B, T - 1, P) or (B, T, P, P - 1) bool"""
        if self.features != "pair":
            return futures.spans(2 if "velocity" in self.features else 1)
        partner = partners(futures.present.shape[1], futures.present.device)
        both = futures.present[:, :, None] & futures.present[:, partner]
        return both[:, None] & (futures.scored[..., None] | futures.scored[..., partner])

    def compute(self) -> dict[str, Tensor]:
        if bool((self.count < 2).any()):
            return {}
        generated, truth = (moments(self.count[i], self.sum[i], self.outer[i]) for i in range(2))
        return {self.name: frechet_distance(*generated, *truth, jitter=self.jitter)}


class FrechetBySecond(FrechetDistance):
    """`fd_<features>` over all frames, and `fd_<features>@second1`, `@second2` and so on over one second each.

    Both distributions are of that second alone, so a second is compared with the same second of the recording. A
    step belongs to the second in which it ends. A second of few frames is as unsure as any FD of few frames.

    >>> from magnet.testing import standing_people
    >>> truth = standing_people(frames=60, agents=2)  # (1, 60, 2, 22, 3), a metre apart one behind the other
    >>> metric = FrechetBySecond("pair")
    >>> metric.update(truth[None], truth)
    >>> [round(metric.compute()[name].item(), 3) for name in ("fd_pair@second1", "fd_pair@second2")]
    [0.0, 0.0]
    """

    seconds: list[Tensor]  # of (N, 2, 64, 64) by second: sums of products of (1, features), generated and truth

    def __init__(self, features: Features = "pair", **kwargs: Any) -> None:
        super().__init__(features, **kwargs)
        self.add_keyed("seconds", 2, FEATURES + 1, FEATURES + 1)

    def pool(self, which: int, features: Tensor, counts: Tensor) -> None:
        frame = torch.arange(features.shape[1]) + (1 if "velocity" in self.features else 0)
        second = (frame / self.fps).long()
        keys = second.unique()
        sums = features.new_zeros(len(keys), 2, FEATURES + 1, FEATURES + 1)
        for n, key in enumerate(keys):
            inside = (second == key).to(features.device)
            kept = features[:, inside][counts[:, inside]]
            kept = torch.cat([torch.ones_like(kept[:, :1]), kept], dim=-1)
            sums[n, which] = kept.T @ kept
        self.take("seconds", keys.to(features.device), sums)
        whole = sums[:, which].sum(dim=0)
        self.count[which] += whole[0, 0]
        self.sum[which] += whole[0, 1:]
        self.outer[which] += whole[1:, 1:]

    def compute(self) -> dict[str, Tensor]:
        result = super().compute()
        for second, sums in zip(*self.keyed("seconds"), strict=True):
            if bool((sums[:, 0, 0] >= 2).all()):
                made, truth = (moments(s[0, 0], s[0, 1:], s[1:, 1:]) for s in sums)
                distance = frechet_distance(*made, *truth, jitter=self.jitter)
                result[f"{self.name}@second{int(second) + 1}"] = distance
        return result
