"""What a tokenizer and a quantizer are, for whoever writes another one."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol, Self, runtime_checkable

import torch
from torch import Tensor

from magnet.motion.scene import Scene


@runtime_checkable
class PoseTokenizer(Protocol):
    """Encodes poses of one person as latents and decodes them: all that a denoiser needs of a tokenizer.

    It is a `torch.nn.Module`; the denoiser freezes it. `Tokenizer` and `RawPose` implement it. A latent covers
    `TOKEN_FRAMES` frames. Give yours to `Denoiser.build`.
    """

    codebook_dim: int  # C, numbers in a latent

    @property
    def receptive_field(self) -> tuple[int, int]:
        """Tokens before and after its own that a latent or a decoded frame can depend on."""
        ...

    def encode_scene(self, scene: Scene, quantize: bool = True) -> Tensor:
        """Latents of a scene that is cut to whole tokens, quantized or not. -> (B, N, P, C) float32"""
        ...

    def decode(self, latent: Tensor, betas: Tensor, deltas: Tensor, window: int | None = None) -> Tensor:
        """Poses with true rotations. (B, N, P, C), (B, P, 10), (B, N, P, 4, 9) -> (B, T, P, 135)

        `window` bounds how many tokens are decoded at a time; it must not change the poses.
        """
        ...

    def requantize(self, latent: Tensor) -> Tensor:
        """The code nearest to each latent. (..., C) -> same"""
        ...

    def fit_normalizers(self, scenes: Iterable[Scene]) -> None:
        """Measure the statistics of normalizers on training scenes."""
        ...

    def requires_grad_(self, requires_grad: bool = True) -> Self: ...

    def eval(self) -> Self: ...

    def state_dict(self) -> dict[str, Tensor]: ...


@dataclass(frozen=True)
class Quantized:
    """The result of quantizing vectors (..., D)."""

    latent: Tensor  # (..., C) the code; gradients pass straight to the vectors
    index: Tensor  # (..., quantizers) int, the code chosen in each codebook; -1 where masked out
    commitment: Tensor  # () mean squared distance from a vector to its code, gradient to the vectors only
    counts: Tensor  # (quantizers, codes) how often each code was chosen, over all processes in training


class Quantizer(Protocol):
    """Maps the encoder's output to codes. `ResidualVQ` and `FSQ` implement it; both are torch modules."""

    size: int  # codes in a codebook
    dim: int  # C, numbers in a code
    num_quantizers: int  # codebooks in a row
    frozen: bool  # nothing moves, also in training
    waits: bool  # not rounding to codes until they are started
    unit_input: bool  # whether the encoder's output is brought to unit spread first
    training: bool

    @property
    def initialized(self) -> Tensor | bool:
        """Whether codes mean something."""
        ...

    def __call__(
        self, vectors: Tensor, mask: Tensor | None = None, generator: torch.Generator | None = None
    ) -> Quantized:
        """Quantize in training. vectors (..., C), mask (...) bool: what is False is neither learned from nor
        counted."""
        ...

    def continuous(self, vectors: Tensor) -> Tensor:
        """Latents before they are rounded to codes, in the space of codes. (..., C) -> (..., C)"""
        ...

    def nearest(self, latents: Tensor) -> Tensor:
        """The code nearest to each latent. (..., C) -> same, float32"""
        ...

    def kmeans_init(self, vectors: Tensor, generator: torch.Generator | None = None) -> None:
        """Start from the encoder's output (M, C) on training scenes; called where nothing is `initialized`."""
        ...
