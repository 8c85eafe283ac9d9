"""Tokens: what the denoiser sees. One token is one agent during `TOKEN_FRAMES` frames (paper Eq. 6)."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from magnet.motion.frames import canonical_deltas, canonical_frame, pairwise, partners, to_9d
from magnet.motion.scene import Scene

TOKEN_FRAMES = 4
"""Frames in a token: the temporal stride omega of the paper."""
MOST_SLOTS = 1000
"""People in a scene, at most: each token of each of them tells of all the others."""


@dataclass(frozen=True)
class TokenLayout:
    """Where things lie in a packed token: latent, 4 x 9 deltas, then 4 x 9 for each partner slot.

    The numbers fall into *groups* that share one noise level: group 0 is the agent's own (latent and
    deltas), group 1 + s is partner slot s.

    >>> TokenLayout(latent=512, agents=2).width
    584
    >>> TokenLayout(latent=4, agents=2).group_levels(torch.tensor([0, 900]))  # own, then the pair's: the noisier end
    tensor([[  0, 900],
            [900, 900]])
    """

    latent: int = 512
    agents: int = 2
    pairwise: bool = True  # False: tokens carry no pairwise transforms (paper Table 5)
    pairwise_noise: Literal["noisier_end", "token"] = "noisier_end"  # "token" is the paper read literally; it leaks

    @property
    def slots(self) -> int:
        return self.agents - 1 if self.pairwise else 0

    @property
    def width(self) -> int:
        """Numbers in a token: 512 + 36 P at the paper's sizes."""
        return self.latent + 9 * TOKEN_FRAMES * (1 + self.slots)

    def groups(self, device: torch.device | None = None) -> Tensor:
        """Group of each number of a token. (D,) int"""
        return _groups(self.latent, self.slots, device)

    def partners(self, device: torch.device | None = None) -> Tensor:
        """Which agent each partner slot of an agent points at. (P, slots) int; its own number: at nobody"""
        return partners(self.agents, device)

    def group_levels(self, levels: Tensor) -> Tensor:
        """Noise level of each group: pairwise ones are as noisy as their noisier end. (..., P) -> (..., P, 1 + slots)

        Otherwise a clean token would reveal where its unknown partner is; `pairwise_noise="token"` does that, for
        comparison.
        """
        own = levels[..., None]
        if not self.slots:
            return own
        if self.pairwise_noise == "token":
            return own.expand(*levels.shape, 1 + self.slots)
        return torch.cat([own, torch.maximum(own, levels[..., self.partners(levels.device)])], dim=-1)

    def group_present(self, present: Tensor) -> Tensor:
        """Whether each group concerns people who are present. (B, P) -> (B, P, 1 + slots) bool"""
        own = present[..., None]
        if not self.slots:
            return own
        return torch.cat([own, own & present[..., self.partners(present.device)]], dim=-1)

    def spread(self, grouped: Tensor) -> Tensor:
        """Expand one value for each group to one for each number of a token. (..., 1 + slots) -> (..., D)"""
        return grouped[..., self.groups(grouped.device)]

    def pack(self, latent: Tensor, deltas: Tensor, pairs: Tensor) -> Tensor:
        """(B, N, P, C), (B, N, P, 4, 9), (B, N, P, P - 1, 4, 9) -> (B, N, P, D)"""
        parts = [latent, deltas.flatten(-2)]
        if self.slots:
            parts.append(pairs.flatten(-3))
        return torch.cat(parts, dim=-1)

    def unpack(self, tokens: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Inverse of `pack`; without pairs the last one has no slots."""
        sizes = [self.latent, 9 * TOKEN_FRAMES, 9 * TOKEN_FRAMES * self.slots]
        latent, deltas, pairs = tokens.split(sizes, dim=-1)
        return latent, deltas.unflatten(-1, (TOKEN_FRAMES, 9)), pairs.unflatten(-1, (self.slots, TOKEN_FRAMES, 9))


@functools.cache
def _groups(latent: int, slots: int, device: torch.device | None) -> Tensor:
    with torch.inference_mode(False):  # or training, later, could not use it
        sizes = [latent + 9 * TOKEN_FRAMES] + [9 * TOKEN_FRAMES] * slots
        each = [torch.full((size,), group, device=device) for group, size in enumerate(sizes)]
        return torch.cat(each)


def by_token(frames: Tensor) -> Tensor:
    """Group the time axis into tokens, the frames inside a token last but one. (B, T, P, D) -> (B, N, P, 4, D)

    >>> by_token(torch.zeros(1, 64, 2, 9)).shape  # 64 frames of two people are 16 tokens each
    torch.Size([1, 16, 2, 4, 9])
    """
    B, T, P, D = frames.shape
    if T % TOKEN_FRAMES:
        raise ValueError(f"{T} frames are not a whole number of tokens of {TOKEN_FRAMES} frames; cut the scene first")
    return frames.view(B, T // TOKEN_FRAMES, TOKEN_FRAMES, P, D).transpose(2, 3)


def by_frame(tokens: Tensor) -> Tensor:
    """Inverse of `by_token`. (B, N, P, 4, D) -> (B, T, P, D)"""
    return tokens.transpose(2, 3).flatten(1, 2)


def scene_deltas(scene: Scene) -> Tensor:
    """Canonical deltas in 9-D, a frame each. -> (B, T, P, 9)"""
    return to_9d(canonical_deltas(canonical_frame(scene.T_world_root)))


def scene_transforms(scene: Scene) -> tuple[Tensor, Tensor]:
    """Deltas (B, N, P, 4, 9) and pairwise transforms (B, N, P, P - 1, 4, 9) of a scene, by token."""
    return transforms(canonical_frame(scene.T_world_root))


def transforms(T_world_can: Tensor) -> tuple[Tensor, Tensor]:
    """Deltas and pairwise transforms of canonical frames, by token. (B, T, P, 4, 4)"""
    return by_token(to_9d(canonical_deltas(T_world_can))), pairwise_by_token(to_9d(pairwise(T_world_can)))


def pairwise_by_token(pairs: Tensor) -> Tensor:
    """Group pairwise numbers of frames into tokens. (B, T, P, P - 1, 9) -> (B, N, P, P - 1, 4, 9)"""
    return by_token(pairs.flatten(-2)).unflatten(-1, pairs.shape[-2:]).transpose(-3, -2)


def pairwise_by_frame(pairs: Tensor) -> Tensor:
    """Inverse of `pairwise_by_token`. (B, N, P, P - 1, 4, 9) -> (B, T, P, P - 1, 9)"""
    return pairs.permute(0, 1, 4, 2, 3, 5).flatten(1, 2)
