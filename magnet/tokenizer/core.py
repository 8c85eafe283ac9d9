"""`TokenizerCore`: the conditional VQ-VAE of poses (paper 3.1) as it is used; its training is `Tokenizer`.

Lightning takes longer to import than a model to load, so nothing here needs it.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor, nn

from magnet.body import Body
from magnet.motion.frames import POSE_FEATURES
from magnet.motion.scene import Scene
from magnet.motion.tokens import TOKEN_FRAMES, by_token
from magnet.precision import cpu_by_default
from magnet.tokenizer.base import Quantizer
from magnet.tokenizer.checkpoint import check_weights, read_checkpoint, shaping
from magnet.tokenizer.features import delta_known, features, fold, put, statistics, unfold
from magnet.tokenizer.fsq import FSQ
from magnet.tokenizer.losses import orthonormalize
from magnet.tokenizer.options import AugmentOptions, AutoencoderOptions, QuantizerOptions, TokenizerLoss
from magnet.tokenizer.quantizer import ResidualVQ
from magnet.tokenizer.vqvae import VQVAE
from magnet.training.options import OptimizerOptions, group_of, plain


def make_quantizer(options: QuantizerOptions) -> Quantizer:
    """The quantizer that options describe; a new kind has a line here and a file beside `fsq.py`."""
    if options.kind == "fsq":
        return FSQ(options.levels)
    return ResidualVQ(
        options.codebook_size,
        options.codebook_dim,
        options.num_quantizers,
        options.ema_decay,
        options.dead_code_threshold,
        waits=options.continuous_steps > 0,
    )


class TokenizerCore(nn.Module):
    """Conditional VQ-VAE of one person's pose: four frames are one code (paper 3.1, Table A.2).

    Args:
        network: encoder and decoder.
        quantizer: what makes codes of the encoder's output.
        loss: weights of the terms.
        augment: what is changed in training batches.
        optimizer: AdamW.
        start_from: checkpoint of a tokenizer, or of a denoiser with one, or the name of a shipped model such as `duet`:
            training starts from its encoder and decoder, and from its codes if their number is the same.
        decoder_only: train only the decoder, after `start_from`. Codes keep their meaning, so a denoiser that was
            trained on them can use the new decoder.
        compile: compile encoder and decoder for training; faster on a GPU, not on a CPU.
        seed: seed of the start and the revival of codes.
    """

    def __init__(
        self,
        network: AutoencoderOptions = AutoencoderOptions(),
        quantizer: QuantizerOptions = QuantizerOptions(),
        loss: TokenizerLoss = TokenizerLoss(),
        augment: AugmentOptions = AugmentOptions(),
        optimizer: OptimizerOptions = OptimizerOptions(),
        start_from: str | None = None,
        decoder_only: bool = False,
        compile: bool = False,
        seed: int = 1111,
    ) -> None:
        super().__init__()
        self.network = network = group_of(AutoencoderOptions, network)
        options = group_of(QuantizerOptions, quantizer)
        self.loss, self.augment = group_of(TokenizerLoss, loss), group_of(AugmentOptions, augment)
        self.optimizer = group_of(OptimizerOptions, optimizer)
        groups = {"network": network, "quantizer": options, "loss": self.loss, "augment": self.augment}
        rest = {"start_from": start_from, "decoder_only": decoder_only, "compile": compile, "seed": seed}
        self.keep(plain({**groups, "optimizer": self.optimizer, **rest}))
        self.quantizer = made = make_quantizer(options)
        self.codebook_dim = made.dim
        sizes = (network.width, network.depth, network.causal)
        ends = (made.unit_input, network.lookahead, network.embed_dim)
        self.vqvae = VQVAE(POSE_FEATURES, made.dim, *sizes, TOKEN_FRAMES, *ends)
        self.body: Body | None = None  # whose joints are compared in training

    def keep(self, options: dict[str, Any]) -> None:
        """Keep the options it was built with as `hparams`."""
        self.hparams = options

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device

    # -- using it ------------------------------------------------------------------------------

    def encode(
        self, pose: Tensor, betas: Tensor, deltas: Tensor, valid: Tensor | None = None, quantize: bool = True
    ) -> Tensor:
        """Quantized latents, summed over quantizers.

        Args:
            pose: (B, T, P, 135), T a multiple of 4.
            betas: (B, P, 10).
            deltas: (B, T, P, 9), the identity at the first frame.
            valid: (B, T) bool, frames that may be looked at; None: all.
            quantize: False: the encoder's latents as they are.

        Returns:
            (B, N, P, C) float32.
        """
        latent = self.quantizer.continuous(self.embed(pose, betas, deltas, valid))
        return self.quantizer.nearest(latent) if quantize else latent

    def decode(self, latent: Tensor, betas: Tensor, deltas: Tensor, window: int | None = None) -> Tensor:
        """Poses with valid rotations. (B, N, P, C), (B, P, 10), (B, N, P, 4, 9) -> (B, T, P, 135)

        `window` tokens are decoded at a time, each with all the neighbours it can depend on: the same poses in
        bounded memory. None decodes the whole clip at once.
        """
        if window is None or latent.shape[1] <= window:
            return self._reconstruct(latent, betas, deltas)
        before, after = self.receptive_field
        parts = []
        for start in range(0, latent.shape[1], window):
            first = max(start - before, 0)
            near = slice(first, start + window + after)
            frames = self._reconstruct(latent[:, near], betas, deltas[:, near])
            parts.append(frames[:, (start - first) * TOKEN_FRAMES : (start - first + window) * TOKEN_FRAMES])
        return torch.cat(parts, dim=1)

    @property
    def receptive_field(self) -> tuple[int, int]:
        """Tokens before and after its own that a latent or a decoded frame can depend on."""
        return self.vqvae.decoder.receptive_field  # the encoder's is no larger

    def requantize(self, latent: Tensor) -> Tensor:
        """The code nearest to each latent; with several quantizers, their sum. (..., C) -> same"""
        return self.quantizer.nearest(latent)

    def encode_scene(self, scene: Scene, quantize: bool = True) -> Tensor:
        """Latents of a scene, cut to whole tokens; frames that are not valid are not looked at."""
        seen = features(scene)
        return self.encode(seen.pose, seen.betas, seen.deltas, seen.valid, quantize)

    def reconstruct(self, scene: Scene) -> Scene:
        """The scene after encoding and decoding, bodies put at their true canonical frames."""
        scene = scene.slice(0, scene.frames - scene.frames % TOKEN_FRAMES)
        seen = features(scene)
        latent = self.encode(seen.pose, seen.betas, seen.deltas, seen.valid)
        return put(self._reconstruct(latent, seen.betas, by_token(seen.deltas), seen.valid), scene)

    def embed(self, pose: Tensor, betas: Tensor, deltas: Tensor, valid: Tensor | None) -> Tensor:
        """(B, T, P, 135) ... -> (B, N, P, C) before quantisation"""
        B, T, P, _ = pose.shape
        if T % TOKEN_FRAMES:
            raise ValueError(
                f"{T} frames are not a whole number of tokens of {TOKEN_FRAMES} frames; cut the clip first"
            )
        known = pose.new_ones(B, T, 2, dtype=torch.bool)
        if valid is not None:
            known = torch.stack([valid, delta_known(valid)], dim=-1)
        known = known.repeat_interleave(P, dim=0)
        vectors = self.vqvae.encode(fold(pose), betas.flatten(0, 1), fold(deltas), known)
        return unfold(vectors, pose)

    def _reconstruct(self, latent: Tensor, betas: Tensor, deltas: Tensor, valid: Tensor | None = None) -> Tensor:
        P = latent.shape[2]
        known = (
            None if valid is None else delta_known(valid).unflatten(1, (-1, TOKEN_FRAMES)).repeat_interleave(P, dim=0)
        )
        pose = self.vqvae.decode(fold(latent), betas.flatten(0, 1), fold(deltas), known)
        with torch.autocast(pose.device.type, enabled=False):
            return orthonormalize(unfold(pose, latent))

    def fit_normalizers(self, scenes: Iterable[Scene]) -> None:
        """z-scores of poses, deltas and shapes from scenes; kept in the checkpoint."""
        for name, (mean, std) in statistics(scenes).items():
            getattr(self.vqvae, name).set(mean, std)

    # -- freezing and loading ------------------------------------------------------------------

    def requires_grad_(self, requires_grad: bool = True) -> Self:
        """Freezing the weights freezes the codes too."""
        self.quantizer.frozen = not requires_grad
        return super().requires_grad_(requires_grad)

    @classmethod
    @cpu_by_default
    def load(cls, path: str | Path) -> Self:
        """A trained tokenizer, from its checkpoint, from that of a denoiser, or by a shipped model's name.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: the file is no such checkpoint, or a weight's shape does not fit its fields; says which.
        """
        fields, state = read_checkpoint(path)
        known = inspect.signature(TokenizerCore.__init__).parameters
        tokenizer = cls(**{name: value for name, value in fields.items() if name in known})
        expected = tokenizer.state_dict()
        check_weights(Path(path), state, expected, shaping(tokenizer.hparams))
        tokenizer.load_state_dict({name: state[name] for name in expected})
        return tokenizer.eval()
