"""Layers whose weights are packed once for the processor's matrix products (oneDNN); they cannot be trained.

On a CPU a packed product takes about half the time of a plain one, and its rows do not depend on how many there are.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from magnet.precision import quick_int8

ROWS = 32
"""Rows that weights are packed for; products with fewer or more give the same numbers and are about as fast."""

LEAST = 1e-30
"""Rows and weights of nothing but zeros are divided by this."""

Linear = Callable[..., Tensor]


def packs() -> bool:
    """Whether this build of torch packs weights for oneDNN."""
    there = all(hasattr(torch.ops.mkldnn, name) for name in ("_linear_pointwise", "_reorder_linear_weight"))
    return there and torch.backends.mkldnn.is_available()


def linear_of(weight: Tensor, bias: Tensor, dtype: torch.dtype) -> Linear:
    """A linear layer with packed weights: (x, gelu=False, plus=None) -> gelu(x W + b) or x W + b + plus."""
    weight, bias = weight.detach().to(dtype).contiguous(), bias.detach().to(dtype)
    if weight.device.type != "cpu" or not packs():

        def plain(x: Tensor, gelu: bool = False, plus: Tensor | None = None) -> Tensor:
            made = F.linear(x, weight, bias)
            return F.gelu(made) if gelu else made if plus is None else plus + made

        return plain
    packed = torch.ops.mkldnn._reorder_linear_weight(weight, ROWS)
    product = torch.ops.mkldnn._linear_pointwise

    def fast(x: Tensor, gelu: bool = False, plus: Tensor | None = None) -> Tensor:
        x = x.to(dtype)  # autocast makes some of what comes in half as precise
        if plus is not None:
            return product.binary(x, plus.to(dtype), packed, bias, "add")
        return product.default(x, packed, bias, *(("gelu", [], "none") if gelu else ("none", [], "")))

    return fast


def int8_linear_of(weight: Tensor, bias: Tensor) -> Linear:
    """As `linear_of`, in whole numbers from -127 to 127: weights scaled by output, what comes in by row.

    So a row's numbers do not depend on the others. Where a processor does not multiply such numbers quickly, weights
    are rounded to them and the rest is float32.
    """
    weight, bias = weight.detach().float(), bias.detach().float()
    scale = (weight.abs().amax(1) / 127).clamp_min(LEAST)
    held = (weight / scale[:, None]).round().to(torch.int8)
    if not quick_int8(weight.device):
        return linear_of(held * scale[:, None], bias, torch.float32)
    held = held.T

    def fast(x: Tensor, gelu: bool = False, plus: Tensor | None = None) -> Tensor:
        rows = x.float().flatten(0, -2)
        size = (rows.abs().amax(1, keepdim=True) / 127).clamp_min_(LEAST)
        product = torch._int_mm((rows / size).round_().to(torch.int8), held)
        start = bias if plus is None else plus.float().flatten(0, -2) + bias
        made = product.float().mul_(size).mul_(scale).add_(start).unflatten(0, x.shape[:-1])
        return F.gelu(made) if gelu else made

    return fast


def norm_of(norm: nn.LayerNorm, dtype: torch.dtype) -> Callable[[Tensor], Tensor]:
    weight, bias = norm.weight.detach().to(dtype), norm.bias.detach().to(dtype)
    shape, eps = list(norm.normalized_shape), norm.eps
    return lambda x: torch.layer_norm(x, shape, weight, bias, eps)


Made = TypeVar("Made")


class Kept(Generic[Made]):
    """What is made of a network's weights, made once and again after they have changed.

    Args:
        make: from a network.
    """

    def __init__(self, make: Callable[[nn.Module], Made]) -> None:
        self.make = make
        self._made: weakref.WeakKeyDictionary[nn.Module, tuple[list[nn.Parameter], list[float], Made]]
        self._made = weakref.WeakKeyDictionary()

    def of(self, network: nn.Module) -> Made:
        kept = self._made.get(network)
        # Finding all parameters takes as long as a layer: where the first is the same, so are the others.
        if kept is None or kept[0][0] is not next(network.parameters()) or kept[1] != state_of(kept[0]):
            weights = list(network.parameters())
            kept = self._made[network] = (weights, state_of(weights), self.make(network))
        return kept[2]


def state_of(weights: Sequence[Tensor]) -> list[float]:
    """Numbers that change when weights do."""
    return [number for each in weights for number in (each.data_ptr(), version_of(each))]


def version_of(weight: Tensor) -> float:
    """How often a tensor was written to; what was made in inference mode does not count that, so all of it is read."""
    return float(weight.sum(dtype=torch.float64)) if weight.is_inference() else weight._version


_SUMS: weakref.WeakKeyDictionary[nn.Module, list[tuple[int, int, float]]] = weakref.WeakKeyDictionary()
"""Of each weight of a model, which it is, how often it was written to and its sum, when it last was asked to sample."""


@torch.no_grad()
def count_unseen_writes(model: nn.Module) -> None:
    """Count writes into `.data`, and weights put in the place of others: what was made of them is made anew.

    For once a call: all weights are added up, which takes a millisecond for ten million. Shards are left alone.
    """
    weights = [each for each in model.parameters() if type(each) is nn.Parameter and not each.is_inference()]
    if not weights or weights[0].is_meta:
        return
    sums = torch.stack([each.sum(dtype=torch.float32) for each in weights]).tolist()
    before = _SUMS.get(model, [])
    others = [number for number, _, _ in before] != [id(each) for each in weights]
    for each, now, (_, version, old) in zip(weights, sums, before, strict=False):
        if others or (now != old and each._version == version):
            torch.autograd.graph.increment_version(each)
    _SUMS[model] = [(id(each), each._version, now) for each, now in zip(weights, sums, strict=True)]
