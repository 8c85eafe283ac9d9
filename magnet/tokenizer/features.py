"""What tokenizers read of a scene, and the statistics of it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from magnet.motion.frames import canonical_frame, pose_features, posed
from magnet.motion.required import require_rate
from magnet.motion.scene import Scene
from magnet.motion.tokens import TOKEN_FRAMES, scene_deltas
from magnet.tokenizer.quantizer import sum_over_processes


@dataclass(frozen=True)
class Features:
    """Poses of a scene with their conditions, in real units."""

    pose: Tensor  # (B, T, P, 135)
    deltas: Tensor  # (B, T, P, 9)
    betas: Tensor  # (B, P, 10)
    counts: Tensor  # (B, T, P) bool, somebody is there and the frame is good
    tokens: Tensor  # (B, N, P) bool, all four frames count
    valid: Tensor | None  # (B, T) bool, None: all frames are good


def features(scene: Scene) -> Features:
    """Read a scene, cut to a whole number of tokens.

    Raises:
        ValueError: another frame rate than the model's.
    """
    require_rate(scene)
    scene = scene.slice(0, scene.frames - scene.frames % TOKEN_FRAMES)
    # Mixed precision would round the products of transforms.
    with torch.autocast(scene.device.type, enabled=False):
        pose, deltas = pose_features(scene), scene_deltas(scene)
    counts = scene.present[:, None].expand(pose.shape[:3])
    if scene.valid is not None:
        counts = counts & scene.valid[..., None]
    tokens = counts.unflatten(1, (-1, TOKEN_FRAMES)).all(dim=2)
    return Features(pose, deltas, scene.betas, counts, tokens, scene.valid)


def delta_known(valid: Tensor) -> Tensor:
    """A delta is known where both of its frames are; the first one always is. (..., T) bool -> same"""
    return valid & torch.cat([valid[..., :1], valid[..., :-1]], dim=-1)


def statistics(scenes: Iterable[Scene]) -> dict[str, tuple[Tensor, Tensor]]:
    """Mean and standard deviation (D,) of `pose`, `deltas` and `betas` over everybody present in all processes.

    Raises:
        ValueError: nobody is present in any frame.
    """
    sums: dict[str, Tensor] = {}
    for scene in scenes:
        seen = features(scene)
        deltas_count = seen.counts if seen.valid is None else seen.counts & delta_known(seen.valid)[..., None]
        parts = {
            "pose": seen.pose[seen.counts],
            "deltas": seen.deltas[deltas_count],
            "betas": seen.betas[:, None].expand(*seen.counts.shape, -1)[seen.counts],
        }
        for name, values in parts.items():
            values = values.double()
            one = torch.cat([values.new_full((1,), len(values)), values.sum(0), values.square().sum(0)])
            sums[name] = sums[name] + one if name in sums else one
    result = {}
    for name, total in sums.items():
        total = sum_over_processes(total)
        mean, square = (total[1:] / total[0]).chunk(2)
        result[name] = (mean.float(), (square - mean.square()).clamp(min=0).sqrt().float())
    if not result or not all(mean.isfinite().all() for mean, _ in result.values()):
        raise ValueError("statistics: nobody is present in the scenes given, or they hold NaN; check the data")
    return result


def put(pose: Tensor, scene: Scene) -> Scene:
    """Decoded poses where everybody's canonical frames are in a scene. pose (B, T, P, 135)"""
    with torch.autocast(pose.device.type, enabled=False):
        return posed(pose, canonical_frame(scene.T_world_root), scene)


def fold(x: Tensor) -> Tensor:
    """Every agent a sequence of its own. (B, T, P, ...) -> (B P, T, ...)"""
    return x.transpose(1, 2).flatten(0, 1)


def unfold(x: Tensor, like: Tensor) -> Tensor:
    """Inverse of `fold` of `like`. (B P, T, ...), (B, _, P, ...) -> (B, T, P, ...)"""
    return x.unflatten(0, (like.shape[0], like.shape[2])).transpose(1, 2)
