"""The encoder and decoder of the tokenizer: 1-D convolutions over the time of one agent (paper Table A.2)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from magnet.precision import dtype_of
from magnet.tokenizer.normalizer import Normalizer

STAGES = 2
"""Each stage halves the frame rate: 2 stages are the stride of 4 frames a token."""

DILATION = 3
"""The convolution of block i of a residual stack has a dilation of 3^i."""


class Conv(nn.Module):
    """Convolution over time of (B, T, C) whose output has T / stride steps.

    Args:
        inputs: channels in.
        outputs: channels out.
        kernel: width of the kernel; `kernel - stride` must be even unless causal.
        stride: input steps for each output step.
        dilation: distance of the input steps that a kernel reads.
        causal: an output sees nothing after the last of its own `stride` input steps.
    """

    def __init__(
        self, inputs: int, outputs: int, kernel: int, stride: int = 1, dilation: int = 1, causal: bool = False
    ) -> None:
        super().__init__()
        self.conv = nn.Conv1d(inputs, outputs, kernel, stride=stride, dilation=dilation)
        reach = dilation * (kernel - 1) + 1 - stride
        self.pad = (reach, 0) if causal else (reach // 2, reach - reach // 2)

    def forward(self, x: Tensor) -> Tensor:
        return self.conv(F.pad(x.transpose(1, 2), self.pad)).transpose(1, 2)


class ResidualBlock(nn.Module):
    """Residual block, pre-norm: a dilated convolution of 3 steps, then one of 1. (B, T, C) -> same"""

    def __init__(self, width: int, dilation: int, causal: bool) -> None:
        super().__init__()
        self.norm_1 = nn.LayerNorm(width)
        self.conv = Conv(width, width, 3, dilation=dilation, causal=causal)
        self.norm_2 = nn.LayerNorm(width)
        self.proj = nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.proj(F.gelu(self.norm_2(self.conv(F.gelu(self.norm_1(x))))))


def stack(width: int, depth: int, causal: bool) -> nn.Sequential:
    """`depth` blocks, largest dilation first. (B, T, C) -> same"""
    return nn.Sequential(*[ResidualBlock(width, DILATION**i, causal) for i in reversed(range(depth))])


class Upsample(nn.Module):
    """Each step repeated: nearest-neighbour upsampling by 2. (B, T, C) -> (B, 2 T, C)"""

    def forward(self, x: Tensor) -> Tensor:
        return x.repeat_interleave(2, dim=1)


class Encoder(nn.Module):
    """Frames to token embeddings, of unit spread each where `unit`. (B, T, inputs) -> (B, T / 4, latent)

    With `embed` numbers these are brought to unit spread, and then projected to the `latent` that codes have.
    """

    def __init__(
        self, inputs: int, width: int, latent: int, depth: int, causal: bool, unit: bool = True, embed: int = 0
    ) -> None:
        super().__init__()
        layers: list[nn.Module] = [Conv(inputs, width, 3, causal=causal), nn.GELU()]
        for _ in range(STAGES):
            layers += [Conv(width, width, 4, stride=2, causal=causal), stack(width, depth, causal)]
        layers.append(Conv(width, embed or latent, 3, causal=causal))
        if unit:
            layers.append(nn.LayerNorm(embed or latent))
        if embed:
            layers.append(Conv(embed, latent, 1))
        self.layers = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        return self.layers(x)


class Decoder(nn.Module):
    """Token latents and conditions to frames. (B, N, inputs) -> (B, 4 N, outputs)

    A causal one sees `lookahead` tokens after its own, 0 or 1: with 1, the first convolution alone sees both ways.
    """

    def __init__(self, inputs: int, width: int, outputs: int, depth: int, causal: bool, lookahead: int = 0) -> None:
        super().__init__()
        layers: list[nn.Module] = [Conv(inputs, width, 3, causal=causal and not lookahead), nn.GELU()]
        for _ in range(STAGES):
            layers += [stack(width, depth, causal), Upsample(), Conv(width, width, 3, causal=causal)]
        layers += [nn.LayerNorm(width), nn.GELU(), Conv(width, outputs, 3, causal=causal)]
        self.layers = nn.Sequential(*layers)
        self.depth, self.causal, self.lookahead = depth, causal, lookahead

    @property
    def receptive_field(self) -> tuple[int, int]:
        """Tokens before and after its own that a decoded frame can depend on."""
        steps, rate = 1.0, 1
        for _ in range(STAGES):
            steps += sum(DILATION**i for i in range(self.depth)) / rate
            rate *= 2
            steps += 1 / rate
        tokens = int(steps + 1 / rate) + 1
        return (2 * tokens, self.lookahead) if self.causal else (tokens, tokens)

    def forward(self, x: Tensor) -> Tensor:
        return self.layers(x)


class VQVAE(nn.Module):
    """Encoder and decoder of one agent's pose, with the statistics of what goes in and out.

    Conditions: shape and canonical delta at every frame for the encoder; shape and the token's four deltas at
    every token for the decoder (paper 3.1).

    Args:
        pose: numbers of a pose.
        latent: numbers of a token's latent.
        width: channels of the convolutions.
        depth: residual blocks a stage.
        causal: no frame sees later ones.
        stride: frames in a token.
        unit: bring the encoder's output to unit spread.
        lookahead: tokens after its own that a causal decoder's frame sees, 0 or 1.
        embed: numbers that the encoder ends with before it projects them to `latent`; 0: it makes `latent` at once.
    """

    def __init__(
        self,
        pose: int,
        latent: int,
        width: int,
        depth: int,
        causal: bool,
        stride: int,
        unit: bool = True,
        lookahead: int = 0,
        embed: int = 0,
    ) -> None:
        super().__init__()
        self.stride, self.latent = stride, latent
        self.pose = Normalizer(pose)
        self.deltas = Normalizer(9)
        # Shape numbers come in units of a population's spread; few people in training must not narrow that,
        # or a new person would lie hundreds of deviations away.
        self.betas = Normalizer(10, floor=1.0)
        self.encoder = Encoder(pose + 10 + 9, width, latent, depth, causal, unit, embed)
        self.decoder = Decoder(latent + 10 + 9 * stride, width, pose, depth, causal, lookahead)

    def encode(self, pose: Tensor, betas: Tensor, deltas: Tensor, known: Tensor) -> Tensor:
        """(B, T, pose), (B, 10), (B, T, 9), known (B, T, 2) bool for pose and step -> (B, N, latent)

        What is not known is replaced by its mean.
        """
        inputs = self.encoder_inputs(pose, betas, deltas, known)
        if not inputs.numel():  # convolutions refuse nothing
            return inputs.new_zeros(len(pose), pose.shape[1] // self.stride, self.latent)
        return self.encoder(inputs.to(dtype_of(self.encoder))).float()

    def encoder_inputs(self, pose: Tensor, betas: Tensor, deltas: Tensor, known: Tensor) -> Tensor:
        """What the encoder sees at every frame. -> (B, T, pose + 19)"""
        shape = self.betas.normalize(betas.float())[:, None].expand(-1, pose.shape[1], -1)
        seen = torch.where(known[..., :1], self.pose.normalize(pose.float()), 0.0)
        moved = torch.where(known[..., 1:], self.deltas.normalize(deltas.float()), 0.0)
        return torch.cat([seen, moved, shape], dim=-1)

    def decode(self, latent: Tensor, betas: Tensor, deltas: Tensor, known: Tensor | None = None) -> Tensor:
        """(B, N, latent), (B, 10), (B, N, 4, 9), known (B, N, 4) bool -> (B, 4 N, pose), rotations not yet proper"""
        inputs = self.decoder_inputs(latent, betas, deltas, known)
        if not inputs.numel():
            return inputs.new_zeros(len(latent), latent.shape[1] * self.stride, len(self.pose.mean))
        return self.pose.denormalize(self.decoder(inputs.to(dtype_of(self.decoder))).float())

    def decoder_inputs(self, latent: Tensor, betas: Tensor, deltas: Tensor, known: Tensor | None = None) -> Tensor:
        """What the decoder sees at every token. -> (B, N, latent + 10 + 9 * stride)"""
        shape = self.betas.normalize(betas.float())[:, None].expand(-1, latent.shape[1], -1)
        moved = self.deltas.normalize(deltas.float())
        if known is not None:
            moved = torch.where(known[..., None], moved, 0.0)
        return torch.cat([latent, moved.flatten(-2), shape], dim=-1)
