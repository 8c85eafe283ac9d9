"""The transformer as it is sampled with: the same numbers to rounding, in half of the time on a CPU.

`Transformer` is written to be read and trained. Here its weights are packed once for the processor's matrix products
(oneDNN), tables take the place of sines, only people who are there are computed, and in the last block only tokens that
are asked for. One token's part of a packed product does not depend on how many tokens there are, so neither do samples.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.weak import WeakIdKeyDictionary

from magnet.denoiser.compiled import Compiled, records
from magnet.denoiser.transformer import Transformer, TransformerBlock, block_causal, conditioned, rotation, sinusoids
from magnet.packing import Kept, Linear, int8_linear_of, linear_of, norm_of, packs
from magnet.precision import quick_bf16, quick_int8
from magnet.sampling.noise import LEVELS

Precision = Literal["float32", "bf16", "int8"]


class LeanBlock:
    """`TransformerBlock` with packed weights, for tokens whose times are turned by given complex numbers.

    Only of the last one some tokens may be asked for: it keeps weights of queries beside those of keys and values.

    Args:
        layer: a packed layer of weights and bias.
        dtype: the type that it computes in.
    """

    def __init__(
        self, block: TransformerBlock, layer: Callable[[Tensor, Tensor], Linear], dtype: torch.dtype, asked: bool
    ) -> None:
        width = block.out.in_features
        self.heads, self.each = block.heads, width // block.heads
        weight, bias = block.qkv.weight.detach(), block.qkv.bias.detach()
        # A turn rotates channels d and d + half of a head: put side by side they are one complex number.
        half = self.each // 2
        pairs = torch.arange(self.each).view(2, half).T.flatten()
        order = (torch.arange(self.heads)[:, None] * self.each + pairs).flatten() if block.rope_heads else None
        keep = torch.arange(width) if order is None else order
        channels = torch.cat([keep, width + keep, 2 * width + torch.arange(width)]).to(weight.device)
        weight, bias = weight[channels], bias[channels]
        self.qkv = layer(weight, bias)
        if asked:
            self.query = layer(weight[:width], bias[:width])
            self.key_value = layer(weight[width:], bias[width:])
        self.out = layer(block.out.weight, block.out.bias)
        self.first, self.last = (layer(x.weight, x.bias) for x in block.mlp if isinstance(x, nn.Linear))
        self.norm_attention, self.norm_mlp = (norm_of(n, dtype) for n in (block.norm_attention, block.norm_mlp))

    def __call__(
        self,
        x: Tensor,
        turn: Tensor | None,
        sees: Tensor | None,
        asked: Tensor | None = None,
        before: tuple[Tensor, Tensor] | None = None,
    ) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """One block, and the keys and values of its tokens.

        Args:
            x: (B, L, d).
            turn: (L, D / 2) complex, or None.
            sees: (L, M + L) bool, or None.
            asked: (r,) int, which tokens are wanted; None: all.
            before: keys and values (B, heads, M, D) of tokens in front of these.

        Returns:
            (B, L or r, d), and keys and values (B, heads, M + L, D).
        """
        if asked is None:
            made = self.qkv(x).unflatten(-1, (3, self.heads, self.each))
            both, value = made[:, :, :2], made[:, :, 2]
            both = both if turn is None else turned(both, turn[:, None, None])
            query, key = both.permute(2, 0, 3, 1, 4).unbind(0)
        else:
            made = self.key_value(x).unflatten(-1, (2, self.heads, self.each))
            key, value = made[:, :, 0], made[:, :, 1]
            x = x[:, asked]
            query = self.query(x).unflatten(-1, (self.heads, self.each))
            sees = None if sees is None else sees[asked]
            if turn is not None:
                query, key = turned(query, turn[asked][:, None]), turned(key, turn[:, None])
            query, key = query.transpose(1, 2), key.transpose(1, 2)
        value = value.transpose(1, 2)
        if before is not None:
            key, value = torch.cat([before[0], key], dim=2), torch.cat([before[1], value], dim=2)
        looked = F.scaled_dot_product_attention(query, key, value, attn_mask=sees).transpose(1, 2).flatten(-2)
        x = self.norm_attention(self.out(looked, plus=x))
        return self.norm_mlp(self.last(self.first(x, gelu=True), plus=x)), (key, value)


def turned(x: Tensor, turn: Tensor) -> Tensor:
    """Neighbouring channels turned as one complex number. (..., D), complex (..., D / 2) -> (..., D)"""
    pairs = torch.view_as_complex(x.float().unflatten(-1, (-1, 2)))
    return torch.view_as_real(pairs * turn).flatten(-2).to(x.dtype)


@dataclass
class Memory:
    """What does not change from call to call while a stage denoises: made in its first call and kept.

    Tokens that are shown the same go into the first block as the same. And where attention is causal by block, earlier
    blocks do not see later ones, so what was computed of them once holds for all calls.

    Attributes:
        steps: so many first token steps, whole blocks, whose keys and values are kept.
        changes: token steps [first, stop) that are shown otherwise in each call; None: all of them.
        entered: of each group of scenes (B, n, p, d), token steps `span` before the first block.
        blocks: (group of scenes, transformer block) -> keys and values (B, heads, steps * people, D).
        answers: (B, steps, P, D) what was predicted of them.
    """

    steps: int = 0
    changes: tuple[int, int] | None = None
    span: tuple[int, int] | None = None
    entered: list[Tensor] = field(default_factory=list)
    blocks: dict[tuple[int, int], tuple[Tensor, Tensor]] = field(default_factory=dict)
    answers: Tensor | None = None


class LeanTransformer:
    """A `Transformer` frozen for sampling.

    Args:
        network: what it computes; changes of its weights afterwards are not seen.
        precision: `bf16` rounds the weights of the blocks to bfloat16 and computes them in it, where the processor
            does so; `int8` does their products in 8-bit whole numbers; what goes in and out stays float32.
    """

    def __init__(self, network: Transformer, precision: Precision = "float32") -> None:
        self.options, self.layout = network.options, network.layout
        o, device = network.options, network.out_proj.weight.device
        if network.out_proj.weight.dtype != torch.float32:
            raise ValueError(f"weights are {network.out_proj.weight.dtype}, expected float32; bf16 is made here")
        held = torch.bfloat16 if precision == "bf16" else torch.float32
        self.dtype = held if quick_bf16(device) else torch.float32
        steps = torch.arange(LEVELS + 1, device=device)
        self.levels, self.slots = sinusoids(steps, o.level_width), sinusoids(steps, o.slot_width)
        self.agent = None if network.agent is None else network.agent.detach().clone()
        layers = list(network.in_proj)
        self.entry = [
            linear_of(x.weight, x.bias, torch.float32) if isinstance(x, nn.Linear) else plain_layer(x) for x in layers
        ]
        blocks = list(network.blocks)

        def layer(weight: Tensor, bias: Tensor) -> Linear:
            return linear_of(weight.to(held), bias.to(held), self.dtype)

        packed = int8_linear_of if precision == "int8" else layer
        self.blocks = [LeanBlock(block, packed, self.dtype, block is blocks[-1]) for block in blocks]  # type: ignore[arg-type]
        self.exit = linear_of(network.out_proj.weight, network.out_proj.bias, torch.float32)
        # Not the network's own method: who holds that holds the network, which then is never let go.
        given = functools.partial(conditioned, network.cond_proj, network.no_cond) if o.cond_dim else None
        self.condition: Callable[..., Tensor] | None = given
        packed_once = device.type == "cpu" and packs() and not (precision == "int8" and quick_int8(device))
        why = f"what is packed for the processor ({precision}) is not compiled; int8 is" if packed_once else None
        self._compiled = Compiled(self._all_blocks, "sampler.compile", refused=why)

    def __call__(
        self,
        noisy: Tensor,
        levels: Tensor,
        present: Tensor,
        cond: Tensor | None = None,
        wanted: Tensor | None = None,
        memory: Memory | None = None,
        compiled: bool = False,
    ) -> Tensor:
        """As `Transformer.forward`; of tokens that are not `wanted` (N, P) bool, or absent, the output is zero.

        With a `memory`, what this was last asked with it must have been the same but for the token steps that change.
        The blocks are `compiled` where they can be, and where keys and values of earlier blocks are not kept; on a GPU
        never, where whole evaluations are recorded instead (`magnet.denoiser.compiled.answered`).
        """
        B, N, _, _ = noisy.shape
        begins, ends = self._span(N, wanted, memory)
        groups = seats(present)
        entered = self._entered(noisy, levels, present, groups, (begins, ends), memory)
        finished = torch.zeros_like(noisy)
        extra = self._extra(cond, B, N)
        if extra is not None and extra.shape[1] > 1:
            extra = extra[:, begins:ends]
        for group, ((scenes, slots), x) in enumerate(zip(groups, entered, strict=True)):
            if extra is not None:
                x = x + (extra if len(extra) == 1 or scenes is None else extra[scenes])
            asked = None if wanted is None else wanted[begins:ends, slots].flatten().nonzero()[:, 0]
            y = self._blocks(x, begins, asked, memory, group, compiled)
            answer = self.exit(y)
            if asked is not None:
                whole = answer.new_zeros(len(x), x.shape[1] * x.shape[2], answer.shape[-1])
                whole[:, asked] = answer
                answer = whole
            answer = answer.unflatten(1, (ends - begins, -1)).to(finished.dtype)  # bfloat16 under autocast on a GPU
            if scenes is None:
                finished[:, begins:ends, slots] = answer
            else:
                finished[scenes[:, None], begins:ends, slots] = answer.transpose(1, 2)
        if memory is not None and memory.steps:
            if begins and memory.answers is not None:
                finished[:, :begins] = memory.answers
            memory.answers = finished[:, : memory.steps].clone()
        return finished

    def _span(self, N: int, wanted: Tensor | None, memory: Memory | None) -> tuple[int, int]:
        """Which token steps are computed: behind those that are remembered, up to the last that a wanted one sees."""
        block = self.options.causal_block
        if memory is not None and memory.steps and (not block or memory.steps % block):
            raise ValueError(f"memory of {memory.steps} token steps: expected whole blocks of network.causal_block")
        begins = memory.steps if memory is not None and memory.blocks else 0
        if not block or wanted is None or not bool(wanted.any()):
            return begins, N
        last = int(wanted.any(dim=1).nonzero()[-1])
        return begins, max(min((last // block + 1) * block, N), begins)

    def _extra(self, cond: Tensor | None, B: int, N: int) -> Tensor | None:
        if self.condition is not None:
            return self.condition(cond, B, N)
        if cond is not None:
            raise ValueError(f"cond: got {tuple(cond.shape)}, expected none: the model has network.cond_dim 0")
        return None

    def _entered(
        self,
        noisy: Tensor,
        levels: Tensor,
        present: Tensor,
        groups: list[tuple[Tensor | None, slice | Tensor]],
        span: tuple[int, int],
        memory: Memory | None,
    ) -> list[Tensor]:
        """What token steps `span` are before the first block, of each group of scenes. -> [(B, n, p, d)]"""
        begins, ends = span
        same = memory is not None and memory.changes is not None and memory.span == span
        if memory is not None and memory.changes is not None and same:
            begins, ends = (min(max(edge, begins), ends) for edge in memory.changes)
        here = slice(begins, ends)
        made = [self._first(noisy[:, here], levels[:, here], present, *each) for each in groups]
        if memory is None:
            return made
        if not same:
            memory.span, memory.entered = span, made
        else:  # not in place: a stage's steps are made in inference mode, and may be asked again outside
            low, high, kept = begins - span[0], ends - span[0], memory.entered
            memory.entered = [
                torch.cat([x[:, :low], new, x[:, high:]], dim=1) for x, new in zip(kept, made, strict=True)
            ]
        return memory.entered

    def _first(
        self, noisy: Tensor, levels: Tensor, present: Tensor, scenes: Tensor | None, slots: slice | Tensor
    ) -> Tensor:
        """The layers before the first block, of some slots of some scenes. -> (B, n, p, d)"""
        if scenes is not None:
            noisy, levels, present = noisy[scenes], levels[scenes], present[scenes]
        noisy, own = noisy[:, :, slots], self.layout.group_levels(levels)[:, :, slots]
        if not everybody(present):
            there = self.layout.group_present(present)[:, None, slots]
            own, noisy = torch.where(there, own, LEVELS), torch.where(self.layout.spread(there), noisy, 0.0)
        parts = [noisy, self.levels[own[..., 0]]]
        if self.layout.slots:
            parts.append(self.slots[own[..., 1:]].flatten(-2))
        if self.agent is not None:
            parts.append(self.agent[slots].expand(*own.shape[:-1], -1))
        x = torch.cat(parts, dim=-1)
        for layer in self.entry:
            x = layer(x)
        return x

    def _blocks(
        self, x: Tensor, begins: int, asked: Tensor | None, memory: Memory | None, group: int, compiled: bool = False
    ) -> Tensor:
        """All blocks, of token steps from `begins` on. (B, n, p, d) -> (B, n * p or as many as are asked for, d)"""
        o, people = self.options, x.shape[2]
        steps, skipped = begins + x.shape[1], begins * people
        x = x.flatten(1, 2)
        sees = seen(steps, people, o.causal_block, x.device)
        sees = None if sees is None else sees[skipped:]
        turn = None
        if o.rope == "heads":
            turn = turns(steps, people, o.width // o.heads, x.device)[skipped:]
        elif o.rope == "hidden":
            x = x + split_turned(x, turns(steps, people, o.width, x.device)[skipped:])
        x = x.to(self.dtype)
        if compiled and not records(x) and (memory is None or not memory.steps):
            made: Tensor = self._compiled(x, turn, sees, asked)
            return made
        for number, block in enumerate(self.blocks):
            before = None if memory is None else memory.blocks.get((group, number))
            x, pair = block(x, turn, sees, asked if number == len(self.blocks) - 1 else None, before)
            if memory is not None and memory.steps and before is None:
                keys, values = pair
                kept = memory.steps * people
                memory.blocks[group, number] = keys[:, :, :kept].clone(), values[:, :, :kept].clone()
        return x.float()

    def _all_blocks(self, x: Tensor, turn: Tensor | None, sees: Tensor | None, asked: Tensor | None) -> Tensor:
        """All blocks, of which nothing is remembered: what is compiled. (B, L, d) -> (B, L or r, d)"""
        for block in self.blocks[:-1]:
            x = block(x, turn, sees)[0]
        return self.blocks[-1](x, turn, sees, asked)[0].float()


def split_turned(x: Tensor, turn: Tensor) -> Tensor:
    """Channels d and d + half turned as one complex number. (..., D), complex (..., D / 2) -> (..., D)"""
    a, b = x.chunk(2, dim=-1)
    return torch.cat([a * turn.real - b * turn.imag, a * turn.imag + b * turn.real], dim=-1)


def plain_layer(layer: nn.Module) -> Callable[[Tensor], Tensor]:
    return norm_of(layer, torch.float32) if isinstance(layer, nn.LayerNorm) else F.gelu


def everybody(present: Tensor) -> bool:
    """Whether every slot is taken; read on the CPU alone, where that waits for nothing."""
    return present.device.type == "cpu" and bool(present.all())


def seats(present: Tensor) -> list[tuple[Tensor | None, slice | Tensor]]:
    """Scenes with equally many people, and the slots that these are in. present (B, P) -> [(scenes, slots)]

    Scenes None: all of them, which then use the same slots.
    """
    if present.device.type == "cpu":
        return _seats(present.detach().contiguous().numpy().tobytes(), *present.shape, present.device)
    if present not in _SEATED:  # one wait for the device a stage, in place of one an evaluation
        key = present.detach().cpu().contiguous()
        _SEATED[present] = _seats(key.numpy().tobytes(), *key.shape, present.device)
    return _SEATED[present]


_SEATED: WeakIdKeyDictionary = WeakIdKeyDictionary()
"""Seats by the tensor that was asked about; who is present is never changed in place."""


@functools.lru_cache(maxsize=256)
def _seats(present: bytes, B: int, P: int, device: torch.device) -> list[tuple[Tensor | None, slice | Tensor]]:
    with torch.inference_mode(False):
        there = torch.frombuffer(bytearray(present), dtype=torch.bool).view(B, P)
        if bool((there == there[0]).all()):
            slots = there[0].nonzero()[:, 0]
            if not len(slots):
                return []
            if int(slots[-1]) == len(slots) - 1:
                return [(None, slice(0, len(slots)))]
            return [(None, slots.to(device))]
        found: list[tuple[Tensor | None, slice | Tensor]] = []
        for taken in there.unique(dim=0):
            scenes, slots = (there == taken).all(dim=1).nonzero()[:, 0], taken.nonzero()[:, 0]
            if len(slots):
                found.append((scenes.to(device), slots.to(device)))
        return found


@functools.lru_cache(maxsize=64)
def turns(steps: int, people: int, width: int, device: torch.device) -> Tensor:
    """What each token's channels are turned by, as `rotate` has it. -> (steps * people, width / 2) complex"""
    with torch.inference_mode(False):
        time = torch.arange(steps, device=device).repeat_interleave(people)
        return torch.complex(*rotation(time, width))


@functools.lru_cache(maxsize=64)
def seen(steps: int, people: int, block: int, device: torch.device) -> Tensor | None:
    """`block_causal` of these tokens; None: everything is seen."""
    if not block:
        return None
    with torch.inference_mode(False):
        return block_causal(torch.arange(steps, device=device).repeat_interleave(people), block)


LEAN: dict[Precision, Kept[LeanTransformer]] = {
    "float32": Kept(LeanTransformer),  # type: ignore[arg-type]
    "bf16": Kept(lambda network: LeanTransformer(network, "bf16")),  # type: ignore[arg-type]
    "int8": Kept(lambda network: LeanTransformer(network, "int8")),  # type: ignore[arg-type]
}
"""Lean forms of networks by how they round."""


def lean(network: Transformer, precision: Precision = "float32") -> LeanTransformer:
    """The lean form of a network of float32 weights, made once and again after they have changed."""
    return LEAN[precision].of(network)
