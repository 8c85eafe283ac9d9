"""The tokenizer's networks for sampling: they compute only the steps asked for, with weights packed once.

A convolution over time is the product of its taps, side by side, with one packed matrix. To decode the frames of one
token, each layer computes only the steps on which these frames depend. A step does not depend on which others are
computed, so frames decoded one by one are bit-identical to those of the whole clip.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from magnet.motion.scene import Scene
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.packing import Kept, Linear, linear_of, norm_of, packs
from magnet.precision import dtype_of
from magnet.tokenizer.base import PoseTokenizer
from magnet.tokenizer.carried import Carried, Span, SpanLayer
from magnet.tokenizer.core import TokenizerCore
from magnet.tokenizer.features import features, fold, unfold
from magnet.tokenizer.losses import orthonormalize
from magnet.tokenizer.vqvae import Conv, Decoder, Encoder, ResidualBlock, Upsample


@dataclass(frozen=True)
class Taps:
    """A convolution: which steps of its input each step of its output sees, and the packed product."""

    kernel: int
    stride: int
    dilation: int
    pad: int
    product: Linear

    @classmethod
    def of(cls, conv: Conv) -> Taps:
        layer = conv.conv
        weight = layer.weight.detach().transpose(1, 2).flatten(1)  # (outputs, kernel * inputs)
        assert layer.bias is not None
        product = linear_of(weight, layer.bias, torch.float32)
        return cls(layer.kernel_size[0], layer.stride[0], layer.dilation[0], conv.pad[0], product)

    def needs(self, span: Span, length: int) -> Span:
        first = span[0] * self.stride - self.pad
        stop = (span[1] - 1) * self.stride - self.pad + self.dilation * (self.kernel - 1) + 1
        return max(first, 0), min(stop, length)

    def final(self, steps: int) -> int:
        return (steps - 1 - self.dilation * (self.kernel - 1) + self.pad) // self.stride + 1

    def __call__(self, x: Tensor, held: Span, span: Span, length: int, gelu: bool = False) -> Tensor:
        low = span[0] * self.stride - self.pad
        high = (span[1] - 1) * self.stride - self.pad + self.dilation * (self.kernel - 1) + 1
        first, stop = max(low, 0), min(high, length)
        x = x[:, first - held[0] : stop - held[0]]
        if first > low or high > stop:
            x = F.pad(x, (0, 0, first - low, high - stop))
        # Each step's taps side by side: a view that reads steps several times, so one operator in place of many.
        scene, step, channel = x.stride()
        size = len(x), span[1] - span[0], self.kernel, x.shape[2]
        taps = x.as_strided(size, (scene, self.stride * step, self.dilation * step, channel))
        return self.product(taps.flatten(2), gelu)


class LeanResidual:
    """`ResidualBlock`: x + proj(gelu(norm(conv(gelu(norm(x))))))."""

    def __init__(self, block: ResidualBlock) -> None:
        self.taps = Taps.of(block.conv)
        self.before, self.after = norm_of(block.norm_1, torch.float32), norm_of(block.norm_2, torch.float32)
        self.proj = linear_of(block.proj.weight, block.proj.bias, torch.float32)

    def needs(self, span: Span, length: int) -> Span:
        return self.taps.needs(span, length)

    def final(self, steps: int) -> int:
        return self.taps.final(steps)

    def __call__(self, x: Tensor, held: Span, span: Span, length: int) -> Tensor:
        seen = self.taps(F.gelu(self.before(x)), held, span, length)
        return self.proj(F.gelu(self.after(seen)), plus=x[:, span[0] - held[0] : span[1] - held[0]].contiguous())


class Each:
    """A layer that works on each step alone."""

    def __init__(self, run: Callable[[Tensor], Tensor]) -> None:
        self.run = run

    def needs(self, span: Span, length: int) -> Span:
        return span

    def final(self, steps: int) -> int:
        return steps

    def __call__(self, x: Tensor, held: Span, span: Span, length: int) -> Tensor:
        return self.run(x[:, span[0] - held[0] : span[1] - held[0]])


class Twice:
    """`Upsample`: each step repeated."""

    def needs(self, span: Span, length: int) -> Span:
        return span[0] // 2, (span[1] + 1) // 2

    def final(self, steps: int) -> int:
        return 2 * steps

    def __call__(self, x: Tensor, held: Span, span: Span, length: int) -> Tensor:
        begins = 2 * held[0]
        return x.repeat_interleave(2, dim=1)[:, span[0] - begins : span[1] - begins]


class LeanNetwork:
    """An encoder or decoder frozen for sampling, which computes spans of its output."""

    def __init__(self, network: Encoder | Decoder) -> None:
        self.layers: list[SpanLayer] = []
        for layer in network.layers:
            self.layers += [lean_layer(each) for each in (layer if isinstance(layer, nn.Sequential) else [layer])]

    def __call__(self, x: Tensor, span: Span) -> Tensor:
        """Steps [first, stop) of what the network makes of x. (B, T, C) -> (B, stop - first, outputs)"""
        lengths = self.lengths(x.shape[1])[:-1]
        spans = [span]
        for layer, length in zip(reversed(self.layers), reversed(lengths), strict=True):
            spans.append(layer.needs(spans[-1], length))
        spans.reverse()
        held = spans[0]
        x = x[:, held[0] : held[1]]
        for layer, length, wanted in zip(self.layers, lengths, spans[1:], strict=True):
            x, held = layer(x, held, wanted, length), wanted
        return x

    def lengths(self, steps: int) -> list[int]:
        lengths = [steps]
        for layer in self.layers:
            stride = layer.stride if isinstance(layer, Taps) else 1
            lengths.append(lengths[-1] * 2 if isinstance(layer, Twice) else lengths[-1] // stride)
        return lengths


def lean_layer(layer: nn.Module) -> SpanLayer:
    if isinstance(layer, Conv):
        return Taps.of(layer)
    if isinstance(layer, ResidualBlock):
        return LeanResidual(layer)
    if isinstance(layer, Upsample):
        return Twice()
    return Each(norm_of(layer, torch.float32) if isinstance(layer, nn.LayerNorm) else F.gelu)


LEAN: Kept[LeanNetwork] = Kept(LeanNetwork)  # type: ignore[arg-type]
"""The lean form of encoders and decoders."""


def usable(tokenizer: PoseTokenizer) -> bool:
    """Whether there is a lean form of a tokenizer's networks."""
    if not isinstance(tokenizer, TokenizerCore) or not packs():
        return False
    return tokenizer.device.type == "cpu" and dtype_of(tokenizer.vqvae.decoder) == torch.float32


@dataclass
class Growing:
    """Says that a call goes on with the sequence of the one before, and where.

    Attributes:
        carried: what is kept between the calls.
        first: the token, of the sequence, that the call's tokens begin with.
        final: how many of the call's tokens will be the same in later calls.
    """

    carried: Carried
    first: int
    final: int


@torch.inference_mode()
def decoded(
    tokenizer: PoseTokenizer,
    latent: Tensor,
    betas: Tensor,
    deltas: Tensor,
    frames: slice,
    growing: Growing | None = None,
) -> Tensor:
    """Some frames of `PoseTokenizer.decode`. -> (B, stop - start, P, 135)"""
    if not usable(tokenizer):
        return tokenizer.decode(latent, betas, deltas)[:, frames]
    assert isinstance(tokenizer, TokenizerCore)
    vqvae = tokenizer.vqvae
    inputs = vqvae.decoder_inputs(fold(latent), betas.flatten(0, 1), fold(deltas))
    network, span = LEAN.of(vqvae.decoder), (frames.start, frames.stop)
    if growing is None:
        made = network(inputs, span)
    else:
        first, final = growing.first, growing.first + growing.final
        begins = first * TOKEN_FRAMES
        made = growing.carried(network, inputs, first, final, (begins + span[0], begins + span[1]))
    return orthonormalize(unfold(vqvae.pose.denormalize(made), latent))


def encoded_plainly(tokenizer: PoseTokenizer, scene: Scene, quantize: bool, tokens: slice) -> Tensor:
    """Some tokens of `PoseTokenizer.encode_scene`. -> (B, stop - start, P, C) float32"""
    return tokenizer.encode_scene(scene, quantize).float()[:, tokens]


@torch.inference_mode()
def encoded(
    tokenizer: PoseTokenizer, scene: Scene, quantize: bool, tokens: slice, growing: Growing | None = None
) -> Tensor:
    """As `encoded_plainly`, computing no others.

    In a `growing` scene a token more at each end stands in for the others (`Denoiser.encode`), which is not counted.
    """
    if not usable(tokenizer) or scene.valid is not None or not scene.scenes:
        return encoded_plainly(tokenizer, scene, quantize, tokens)
    assert isinstance(tokenizer, TokenizerCore)
    seen, vqvae = features(scene), tokenizer.vqvae
    known = torch.ones(1, 1, 2, dtype=torch.bool)
    inputs = vqvae.encoder_inputs(fold(seen.pose), seen.betas.flatten(0, 1), fold(seen.deltas), known)
    network, span = LEAN.of(vqvae.encoder), (tokens.start, tokens.stop)
    if growing is None:
        made = network(inputs, span)
    else:
        first, final = growing.first, (growing.first + 1 + growing.final) * TOKEN_FRAMES
        begins = first * TOKEN_FRAMES
        # The delta into the first frame that is not held is another one where a window begins elsewhere.
        made = growing.carried(
            network, inputs, begins, final, (first + span[0], first + span[1]), edge=TOKEN_FRAMES + 1
        )
    latent = unfold(made, seen.pose)
    latent = tokenizer.quantizer.continuous(latent)
    return tokenizer.quantizer.nearest(latent) if quantize else latent
