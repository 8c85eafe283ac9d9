"""The ablation without a VQ-VAE (paper Table 5)."""

from __future__ import annotations

from collections.abc import Iterable

from torch import Tensor, nn

from magnet.motion.frames import POSE_FEATURES
from magnet.motion.scene import Scene
from magnet.motion.tokens import TOKEN_FRAMES, by_frame, by_token
from magnet.tokenizer.features import features, statistics
from magnet.tokenizer.losses import orthonormalize
from magnet.tokenizer.normalizer import Normalizer


class RawPose(nn.Module):
    """Stands in for a tokenizer: the latent is the z-scored pose of four frames, 540 numbers. Nothing to train."""

    codebook_dim: int = TOKEN_FRAMES * POSE_FEATURES
    receptive_field = (0, 0)

    def __init__(self) -> None:
        super().__init__()
        self.pose = Normalizer(POSE_FEATURES)

    def fit_normalizers(self, scenes: Iterable[Scene]) -> None:
        """Set mean and standard deviation of poses from scenes; before, the latent is the pose, not normalized."""
        self.pose.set(*statistics(scenes)["pose"])

    def encode(
        self, pose: Tensor, betas: Tensor, deltas: Tensor, valid: Tensor | None = None, quantize: bool = True
    ) -> Tensor:
        """(B, T, P, 135) -> (B, N, P, 540); the rest is not read."""
        return by_token(self.pose.normalize(pose)).flatten(-2)

    def decode(self, latent: Tensor, betas: Tensor, deltas: Tensor, window: int | None = None) -> Tensor:
        """(B, N, P, 540) -> (B, T, P, 135); the rest is not read."""
        return orthonormalize(self.pose.denormalize(by_frame(latent.unflatten(-1, (TOKEN_FRAMES, POSE_FEATURES)))))

    def requantize(self, latent: Tensor) -> Tensor:
        """There is no codebook: the same latent."""
        return latent

    def encode_scene(self, scene: Scene, quantize: bool = True) -> Tensor:
        """-> (B, N, P, 540)"""
        seen = features(scene)
        return self.encode(seen.pose, seen.betas, seen.deltas)
