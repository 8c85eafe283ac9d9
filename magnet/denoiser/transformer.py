"""The diffusion forcing transformer: noisy tokens and their levels in, clean tokens out (paper 3.2, Table A.2)."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.attention import SDPBackend, sdpa_kernel

from magnet.denoiser.options import TransformerOptions
from magnet.motion.tokens import TokenLayout
from magnet.sampling.noise import LEVELS, alpha_bar
from magnet.waiting import may_look

FEW_SLOTS = 8
"""Most agent slots that a GPU runs at once, whoever is in them; with more, the empty ones cost too much."""


LONGEST = 10_000.0
"""Over 2 pi, the longest wave of level embeddings and of rotations by time."""


def sinusoids(values: Tensor, width: int) -> Tensor:
    """Sines and cosines of geometrically spaced frequencies. (...) -> (..., width)"""
    frequency = torch.exp(torch.arange(width // 2, device=values.device) * (-math.log(LONGEST) / (width // 2)))
    angle = values[..., None].float() * frequency
    return torch.cat([angle.sin(), angle.cos()], dim=-1)


def rotate(x: Tensor, time: Tensor) -> Tensor:
    """Rotary position encoding: pairs of channels (d, d + D/2) turned by an angle that grows with time.

    x (..., L, D) with D even, time (L,) -> same as x
    """
    return rotated(x, *rotation(time, x.shape[-1]))


def rotation(time: Tensor, width: int) -> tuple[Tensor, Tensor]:
    """Cosines and sines by which `rotated` turns vectors of `width` numbers. time (L,) -> (L, width / 2) each"""
    half = width // 2
    frequency = LONGEST ** (-torch.arange(half, device=time.device, dtype=torch.float32) / half)
    angle = time[:, None].float() * frequency
    return angle.cos(), angle.sin()


def rotated(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """`rotate` by a `rotation` that is known. x (..., L, D), cos and sin (L, D / 2) -> same as x"""
    cos, sin = cos.to(x.dtype), sin.to(x.dtype)
    a, b = x.chunk(2, dim=-1)
    return torch.cat([a * cos - b * sin, a * sin + b * cos], dim=-1)


def block_causal(time: Tensor, size: int) -> Tensor:
    """Whom each token sees where time comes in blocks of `size` steps: those of its own block and of earlier ones.

    time (L,) int -> (L, L) bool: who looks, at whom
    """
    block = time // size
    return block[:, None] >= block[None, :]


def skipped(made: Tensor, shown: Tensor, levels: Tensor, layout: TokenLayout) -> Tensor:
    """Clean tokens where a network tells what noise hides: sqrt(a) shown + sqrt(1 - a) made, of a = `alpha_bar`.

    The preconditioning of Karras et al. 2022 (Elucidating the design space of diffusion-based generative models, Table
    1) for numbers of unit variance, with noise that takes the signal's place: what is shown clean comes back as it was.
    made, shown (B, N, P, D), levels (B, N, P) int -> (B, N, P, D)
    """
    signal = alpha_bar(layout.spread(layout.group_levels(levels)))
    return (signal.sqrt() * shown + (1 - signal).sqrt() * made).to(made.dtype)


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


def quick_to_train(like: Tensor) -> AbstractContextManager[None]:
    """Attention by plain products on a CPU: backwards its flash attention takes 1.4 times as long."""
    return sdpa_kernel(SDPBackend.MATH) if like.device.type == "cpu" else nullcontext()


def is_sharded(module: nn.Module) -> bool:
    """Whether a module's weights lie in shards on several processes (FSDP), which must all run it equally often."""
    fsdp = sys.modules.get("torch.distributed.fsdp")
    return fsdp is not None and isinstance(module, (fsdp.FSDPModule, fsdp.FullyShardedDataParallel))


def is_plain(module: nn.Module) -> bool:
    """Whether it is made of our own layers alone: adapters in their place, and hooks, have no lean form."""
    layers = (nn.ModuleList, nn.Sequential, nn.Linear, nn.LayerNorm, nn.GELU, nn.Dropout)
    plain = {Transformer, TransformerBlock, *layers}
    return all(
        type(each) in plain and not each._forward_hooks and not each._forward_pre_hooks for each in module.modules()
    )


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

    def forward(self, x: Tensor, cos: Tensor, sin: Tensor, sees: Tensor | None = None) -> Tensor:
        """x (B, L, d) -> (B, L, d)

        cos, sin (L, d / heads / 2) each token's `rotation`; sees (L, L) or (B, 1, L, L) bool, whom each one sees; None:
        everybody.
        """
        query_key, value = self.qkv(x).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4).split([2, 1])
        query, key = rotated(query_key, cos, sin) if self.rope_heads else query_key
        value = value[0]
        dropout = self.dropout if self.training else 0.0
        with quick_to_train(query) if self.training else nullcontext():
            looked = F.scaled_dot_product_attention(query, key, value, attn_mask=sees, dropout_p=dropout)
        x = self.norm_attention(x + self.drop(self.out(looked.transpose(1, 2).flatten(-2))))
        return self.norm_mlp(x + self.drop(self.mlp(x)))


def conditioned(proj: nn.Linear, no_cond: Tensor, cond: Tensor | None, B: int, N: int) -> Tensor:
    """What a condition of C numbers adds to each token; `no_cond` (d,) where it is None or not finite.

    cond (B, C) or (B, N, C) -> (B or 1, N or 1, 1, d)
    """
    size = proj.in_features
    if cond is None:
        return no_cond[None, None, None]
    if cond.shape not in ((B, size), (B, N, size)):
        raise ValueError(f"cond: got {tuple(cond.shape)}, expected ({B}, {size}) or ({B}, {N}, {size})")
    cond = cond[:, None, None] if cond.ndim == 2 else cond[:, :, None]
    known = cond.isfinite().all(dim=-1, keepdim=True)
    embedded = proj(torch.where(known, cond, 0.0).to(no_cond.dtype))
    return torch.where(known, embedded, no_cond)


class Transformer(nn.Module):
    """Predicts clean tokens from tokens at any mix of noise levels.

    Args:
        layout: what a token holds.
        options: sizes and parts.
    """

    def __init__(self, layout: TokenLayout, options: TransformerOptions = TransformerOptions()) -> None:
        super().__init__()
        self.layout = layout
        o = self.options = options
        self.agent = nn.Parameter(torch.randn(layout.agents, o.agent_width) * 0.02) if o.agent_embedding else None
        agent_width = o.agent_width if o.agent_embedding else 0
        entered = layout.width + o.level_width + layout.slots * o.slot_width + agent_width
        self.in_proj = nn.Sequential(
            *(nn.Linear(entered, o.width), nn.LayerNorm(o.width), nn.GELU()),
            *(nn.Linear(o.width, o.width), nn.LayerNorm(o.width), nn.GELU()),
            *(nn.Linear(o.width, o.width), nn.LayerNorm(o.width)),
        )
        rope_heads = o.rope == "heads"
        self.blocks = nn.ModuleList(
            TransformerBlock(o.width, o.heads, o.mlp_ratio, o.dropout, rope_heads) for _ in range(o.layers)
        )
        self.out_proj = nn.Linear(o.width, layout.width)
        if o.cond_dim:
            # Zeros: a model that starts from one without conditions begins as the same model.
            self.cond_proj = nn.Linear(o.cond_dim, o.width)
            nn.init.zeros_(self.cond_proj.weight)
            nn.init.zeros_(self.cond_proj.bias)
            self.no_cond = nn.Parameter(torch.zeros(o.width))
        self.register_buffer("groups", layout.groups(), persistent=False)
        self.in_groups = True  # scenes with equally many people run together; else all slots of all scenes at once

    groups: Tensor

    def forward(self, noisy: Tensor, levels: Tensor, present: Tensor, cond: Tensor | None = None) -> Tensor:
        """Predict clean tokens.

        Absent agents are not looked at, so they change nothing; their own output is meaningless.

        Args:
            noisy: (B, N, P, D) normalized.
            levels: (B, N, P) int in 0..K.
            present: (B, P) bool.
            cond: (B, C) for whole scenes or (B, N, C) for each token step. Where it is NaN, and everywhere where it is
                None, there is no condition.

        Returns:
            (B, N, P, D).

        Raises:
            ValueError: a condition for a model without one, or of another size.
        """
        B, N, P, _ = noisy.shape
        there = self.layout.group_present(present)[:, None]  # (B, 1, P, 1 + slots)
        group_levels = torch.where(there, self.layout.group_levels(levels), LEVELS)
        noisy = torch.where(there[..., self.groups], noisy, 0.0)
        parts = [noisy, sinusoids(group_levels[..., 0], self.options.level_width).to(noisy.dtype)]
        if self.layout.slots:
            parts.append(sinusoids(group_levels[..., 1:], self.options.slot_width).flatten(-2).to(noisy.dtype))
        if self.agent is not None:
            parts.append(self.agent.to(noisy.dtype).expand(B, N, P, -1))
        x = self.in_proj(torch.cat(parts, dim=-1))
        condition = self.condition(cond, B, N)
        return self.out_proj(self._blocks(x if condition is None else x + condition, present))

    def condition(self, cond: Tensor | None, B: int, N: int) -> Tensor | None:
        """What a condition adds to each token. -> (B or 1, N or 1, 1, d)"""
        if self.options.cond_dim:
            return conditioned(self.cond_proj, self.no_cond, cond, B, N)
        if cond is not None:
            raise ValueError(f"cond: got {tuple(cond.shape)}, expected none: the model has network.cond_dim 0")
        return None

    def _blocks(self, x: Tensor, present: Tensor) -> Tensor:
        """All blocks, on those who are there only: scenes with equally many people run together. (B, N, P, d)

        Off a CPU all slots run at once while they are few: a GPU waits for the host to start each operator, not for
        arithmetic, and would wait for it again to hear which groups there are.
        """
        at_once = not may_look(x.device) and x.shape[2] <= FEW_SLOTS
        if is_sharded(self.blocks[0]) or not self.in_groups or at_once:
            return self._blocks_once(x, present)
        people = present.sum(dim=1)
        slots_in_use = (~present).int().argsort(dim=1, stable=True)
        finished = torch.zeros_like(x)
        for size in people.unique().tolist():
            if size == 0:
                continue
            scenes = (people == size).nonzero()
            slots = slots_in_use[scenes[:, 0], :size]
            y = x[scenes, :, slots].transpose(1, 2).flatten(1, 2)  # (b, N * size, d)
            time = torch.arange(x.shape[1], device=x.device).repeat_interleave(size)
            sees = block_causal(time, self.options.causal_block) if self.options.causal_block else None
            y = self._through(y, time, sees)
            finished[scenes, :, slots] = y.unflatten(1, (-1, size)).transpose(1, 2).to(finished.dtype)
        return finished

    def _blocks_once(self, x: Tensor, present: Tensor) -> Tensor:
        """As `_blocks`, each block once whatever scenes hold: processes ask for shards equally often. (B, N, P, d)"""
        B, N, P, _ = x.shape
        time = torch.arange(N, device=x.device).repeat_interleave(P)
        there = present[:, None].expand(B, N, P).reshape(B, 1, 1, N * P)
        # Who is absent sees itself at least: a softmax over nothing is not a number.
        sees = there | torch.eye(N * P, dtype=torch.bool, device=x.device)
        if self.options.causal_block:
            sees = sees & block_causal(time, self.options.causal_block)
        return self._through(x.flatten(1, 2), time, sees).unflatten(1, (N, P))

    def _through(self, y: Tensor, time: Tensor, sees: Tensor | None) -> Tensor:
        """All blocks. y (b, L, d), time (L,), sees as in `TransformerBlock` -> (b, L, d)"""
        if self.options.rope == "hidden":
            y = y + rotate(y, time)
        turn = rotation(time, self.options.width // self.options.heads)
        for block in self.blocks:
            y = block(y, *turn, sees)
        return y
