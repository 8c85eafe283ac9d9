"""The diffusion forcing transformer: noisy tokens and their levels in, clean tokens out (paper 3.2, Table A.2)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from magnet.checks import require_whole
from magnet.motion.tokens import TokenLayout
from magnet.sampling.noise import LEVELS

Rope = Literal["hidden", "heads", "none"]


def sinusoids(values: Tensor, width: int, longest: float = 10_000.0) -> Tensor:
    """Sines and cosines of geometrically spaced frequencies. (...) -> (..., width)"""
    frequency = torch.exp(torch.arange(width // 2, device=values.device) * (-math.log(longest) / (width // 2)))
    angle = values[..., None].float() * frequency
    return torch.cat([angle.sin(), angle.cos()], dim=-1)


def rotate(x: Tensor, time: Tensor, base: float = 10_000.0) -> Tensor:
    """Rotary position encoding: pairs of channels (d, d + D/2) turned by an angle that grows with time.

    x (..., L, D) with D even, time (L,) -> same as x
    """
    half = x.shape[-1] // 2
    frequency = base ** (-torch.arange(half, device=x.device, dtype=torch.float32) / half)
    angle = time[:, None].float() * frequency
    cos, sin = angle.cos().to(x.dtype), angle.sin().to(x.dtype)
    a, b = x[..., :half], x[..., half:]
    return torch.cat([a * cos - b * sin, a * sin + b * cos], dim=-1)


def block_causal(time: Tensor, size: int) -> Tensor:
    """Whom each token sees where time comes in blocks of `size` steps: those of its own block and of earlier ones.

    time (L,) int -> (L, L) bool, row: who looks, column: at whom
    """
    block = time // size
    return block[:, None] >= block[None, :]


@contextmanager
def without_dropout(network: nn.Module) -> Iterator[None]:
    """Within it a network drops nothing out, whatever mode it is in; it is left in that mode."""
    training = network.training
    if training:
        network.eval()
    try:
        yield
    finally:
        if training:
            network.train()


class TransformerBlock(nn.Module):
    """Post-norm transformer encoder block: self-attention over all tokens of a scene, then a GELU MLP."""

    def __init__(self, width: int, heads: int, mlp_ratio: int, dropout: float, rope_heads: bool) -> None:
        super().__init__()
        if width % (2 * heads):
            raise ValueError(f"width {width} must be a multiple of twice the {heads} heads")
        self.heads = heads
        self.rope_heads = rope_heads
        self.dropout = dropout
        self.qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)
        self.norm_attention = nn.LayerNorm(width)
        self.mlp = nn.Sequential(
            nn.Linear(width, mlp_ratio * width), nn.GELU(), nn.Dropout(dropout), nn.Linear(mlp_ratio * width, width)
        )
        self.norm_mlp = nn.LayerNorm(width)
        self.drop = nn.Dropout(dropout)

    def forward(self, x: Tensor, time: Tensor, sees: Tensor | None = None) -> Tensor:
        """x (B, L, d), time (L,), sees (L, L) bool, whom each one sees; None: everybody -> (B, L, d)"""
        query, key, value = self.qkv(x).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        if self.rope_heads:
            query, key = rotate(query, time), rotate(key, time)
        dropout = self.dropout if self.training else 0.0
        looked = F.scaled_dot_product_attention(query, key, value, attn_mask=sees, dropout_p=dropout)
        x = self.norm_attention(x + self.drop(self.out(looked.transpose(1, 2).flatten(-2))))
        return self.norm_mlp(x + self.drop(self.mlp(x)))


class Transformer(nn.Module):
    """Predicts clean tokens from tokens at any mix of noise levels.

    Args:
        layout: what a token holds.
        width: hidden size d, paper Table A.2.
        layers: transformer blocks, paper Table A.2.
        heads: attention heads, paper Table A.2.
        mlp_ratio: hidden size of a block's MLP over d, paper Table A.2.
        dropout: the paper does not say; 0.05 is that of the authors' configuration.
        level_width: size of the noise-level embedding, paper Table A.2.
        agent_width: size of the agent embedding, paper Table A.2.
        slot_width: size of the noise-level embedding of each partner slot (ours: the paper has one level a token).
        rope: `hidden` rotates the embedded token once (paper Table A.2), `heads` rotates queries and keys
            (usual practice), `none` leaves time out (paper Table A.5).
        agent_embedding: False leaves the agent's identity out (paper Table A.5).
        causal_block: token steps of a block; a token sees blocks up to its own, and all of that one, whoever's.
            0: everything sees everything, as in the paper.
    """

    def __init__(
        self,
        layout: TokenLayout,
        width: int = 512,
        layers: int = 6,
        heads: int = 8,
        mlp_ratio: int = 4,
        dropout: float = 0.05,
        level_width: int = 256,
        agent_width: int = 256,
        slot_width: int = 32,
        rope: Rope = "hidden",
        agent_embedding: bool = True,
        causal_block: int = 0,
    ) -> None:
        super().__init__()
        require_whole("causal_block", causal_block, 0)
        self.layout = layout
        self.rope = rope
        self.causal_block = causal_block
        self.level_width = level_width
        self.slot_width = slot_width
        self.agent = nn.Parameter(torch.randn(layout.agents, agent_width) * 0.02) if agent_embedding else None
        enter = layout.width + level_width + layout.slots * slot_width + (agent_width if agent_embedding else 0)
        self.in_proj = nn.Sequential(
            *(nn.Linear(enter, width), nn.LayerNorm(width), nn.GELU()),
            *(nn.Linear(width, width), nn.LayerNorm(width), nn.GELU()),
            *(nn.Linear(width, width), nn.LayerNorm(width)),
        )
        self.blocks = nn.ModuleList(
            TransformerBlock(width, heads, mlp_ratio, dropout, rope_heads=rope == "heads") for _ in range(layers)
        )
        self.out_proj = nn.Linear(width, layout.width)
        self.register_buffer("groups", layout.groups(), persistent=False)

    groups: Tensor

    def forward(self, noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
        """noisy (B, N, P, D) normalized, levels (B, N, P) int in 0..K, present (B, P) bool -> (B, N, P, D)

        Absent agents are not looked at, so they change nothing; their own output is meaningless.
        """
        B, N, P, _ = noisy.shape
        there = self.layout.group_present(present)[:, None]  # (B, 1, P, 1 + slots)
        group_levels = torch.where(there, self.layout.group_levels(levels), LEVELS)
        noisy = torch.where(there[..., self.groups], noisy, 0.0)
        parts = [noisy, sinusoids(group_levels[..., 0], self.level_width).to(noisy.dtype)]
        if self.layout.slots:
            parts.append(sinusoids(group_levels[..., 1:], self.slot_width).flatten(-2).to(noisy.dtype))
        if self.agent is not None:
            parts.append(self.agent.to(noisy.dtype).expand(B, N, P, -1))
        return self.out_proj(self._blocks(self.in_proj(torch.cat(parts, dim=-1)), present))

    def _blocks(self, x: Tensor, present: Tensor) -> Tensor:
        """All blocks, on those who are there only: scenes with equally many people run together. (B, N, P, d)"""
        people = present.sum(dim=1)
        slots_in_use = (~present).int().argsort(dim=1, stable=True)
        finished = torch.zeros_like(x)
        for size in people.unique().tolist():
            if size == 0:
                continue
            rows = (people == size).nonzero()
            slots = slots_in_use[rows[:, 0], :size]
            y = x[rows, :, slots].transpose(1, 2).flatten(1, 2)  # (b, N * size, d)
            time = torch.arange(x.shape[1], device=x.device).repeat_interleave(size)
            sees = block_causal(time, self.causal_block) if self.causal_block else None
            if self.rope == "hidden":
                y = y + rotate(y, time)
            for block in self.blocks:
                y = block(y, time, sees)
            finished[rows, :, slots] = y.unflatten(1, (-1, size)).transpose(1, 2).to(finished.dtype)
        return finished
