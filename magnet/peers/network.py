"""A transformer over one person's token steps that looks at a partner's."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from magnet.checks import require_number, require_whole
from magnet.denoiser.transformer import TransformerBlock, rotated, rotation


@dataclass(frozen=True)
class PeerNetwork:
    """Size of a peer's network.

    Args:
        width: hidden size d.
        layers: blocks, each of attention to oneself and to the partner.
        heads: attention heads.
        mlp_ratio: MLP size over d.
        dropout: in attention and MLPs.
    """

    width: int = 192
    layers: int = 4
    heads: int = 6
    mlp_ratio: int = 4
    dropout: float = 0.05

    def __post_init__(self) -> None:
        for name in ("width", "layers", "heads", "mlp_ratio"):
            require_whole(name, getattr(self, name), 1)
        require_number("dropout", self.dropout, 0, 1)


class CrossBlock(nn.Module):
    """A transformer block over one's own steps, then attention to the partner's."""

    def __init__(self, options: PeerNetwork) -> None:
        super().__init__()
        o = options
        self.heads = o.heads
        self.own = TransformerBlock(o.width, o.heads, o.mlp_ratio, o.dropout, rope_heads=True)
        self.query, self.out = nn.Linear(o.width, o.width), nn.Linear(o.width, o.width)
        self.key_value = nn.Linear(o.width, 2 * o.width)
        self.norm = nn.LayerNorm(o.width)

    def forward(self, x: Tensor, partner: Tensor, sees: Tensor | None, sees_partner: Tensor | None) -> Tensor:
        """x (B, N, d), partner (B, M, d), sees (N, N) and sees_partner (N, M) bool; None: everything -> (B, N, d)"""
        width = x.shape[-1] // self.heads
        turn, partners_turn = (rotation(torch.arange(each.shape[1], device=x.device), width) for each in (x, partner))
        x = self.own(x, *turn, sees)
        query = rotated(self.query(x).unflatten(-1, (self.heads, -1)).transpose(1, 2), *turn)
        key, value = self.key_value(partner).unflatten(-1, (2, self.heads, -1)).permute(2, 0, 3, 1, 4)
        looked = F.scaled_dot_product_attention(query, rotated(key, *partners_turn), value, attn_mask=sees_partner)
        return self.norm(x + self.out(looked.transpose(1, 2).flatten(-2)))


class PartnerTransformer(nn.Module):
    """`CrossBlock`s over embedded steps.

    Args:
        own: numbers of one's own steps.
        partner: numbers of the partner's.
        options: sizes.
    """

    def __init__(self, own: int, partner: int, options: PeerNetwork) -> None:
        super().__init__()
        self.in_own, self.in_partner = (embedding(size, options.width) for size in (own, partner))
        self.blocks = nn.ModuleList(CrossBlock(options) for _ in range(options.layers))

    def forward(
        self, own: Tensor, partner: Tensor, sees: Tensor | None = None, sees_partner: Tensor | None = None
    ) -> Tensor:
        """own (B, N, .), partner (B, M, .); whom each step sees as in `CrossBlock` -> (B, N, d)"""
        x, partner = self.in_own(own), self.in_partner(partner)
        for block in self.blocks:
            x = block(x, partner, sees, sees_partner)
        return x


def embedding(size: int, width: int) -> nn.Sequential:
    """An MLP with normalized output, from `size` numbers to `width`."""
    return nn.Sequential(nn.Linear(size, width), nn.GELU(), nn.Linear(width, width), nn.LayerNorm(width))


def up_to(steps: int, others: int, ahead: int = 0, device: torch.device | None = None) -> Tensor:
    """Each step sees others up to so many after its own. (N, M) bool"""
    step, other = torch.arange(steps, device=device), torch.arange(others, device=device)
    return other[None, :] <= step[:, None] + ahead
