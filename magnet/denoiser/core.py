"""`DenoiserCore`: the diffusion forcing transformer (paper 3.2) as it is used; its training is `Denoiser`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from magnet import checkpoints
from magnet.checks import require_choice, require_whole
from magnet.denoiser import starting
from magnet.denoiser.options import DenoiserLoss, NoiseOptions, Sampling, SelfForcing, TransformerOptions
from magnet.denoiser.pairwise_posterior import PairwisePosterior
from magnet.denoiser.token_core import TokenModelCore
from magnet.denoiser.transformer import Transformer, skipped
from magnet.motion.scene import Scene
from magnet.motion.tokens import MOST_SLOTS, TokenLayout
from magnet.precision import dtype_of
from magnet.tokenizer.base import PoseTokenizer
from magnet.training.options import OptimizerOptions, group_of, plain
from magnet.waiting import constant

Target = Literal["quantized", "continuous"]


class DenoiserCore(TokenModelCore):
    """Diffusion forcing transformer over the motion tokens of all agents (paper 3.2).

    Holds the frozen tokenizer it was trained with, so one checkpoint is all that a user needs.

    Args:
        tokenizer: checkpoint of a trained tokenizer, or of a denoiser with one, or the name of a shipped model such as
            `duet`. `raw` uses plain poses instead (ablation, paper Table 5). A checkpoint of this module brings its
            own, and this is then not read.
        max_agents: agent slots P; smaller scenes leave slots empty. Linked to the data's.
        window: token steps that the model sees at once; 16 are 64 frames. Linked to the data's.
        target: what of the pose is generated: `quantized`, the tokenizer's codes, as in the paper, or `continuous`,
            its encoder's latents before they are rounded to codes (ours); sampling follows.
        start_from: checkpoint of a denoiser, or the name of a shipped model such as `duet`, whose weights training
            starts from. Without a `tokenizer` its own is kept, frozen, and with it how tokens are normalized.
        network: the transformer.
        noise: noise levels in training.
        loss: weights of the terms.
        self_forcing: training on a past that the model has made itself.
        optimizer: AdamW, or Muon for matrices.
        sampling: how the trained model is best sampled, where a sampler leaves it open.
        compile: compile the blocks for training; worth it on a GPU, not on a CPU.
        cuda_graph: train by replaying forward and backward as one CUDA graph, so that a GPU does not wait for its host;
            on other devices nothing changes.
        seed: all training noise follows from it.
    """

    def __init__(
        self,
        tokenizer: str | None = None,
        max_agents: int = 2,
        window: int = 16,
        target: Target = "quantized",
        start_from: str | None = None,
        network: TransformerOptions = TransformerOptions(),
        noise: NoiseOptions = NoiseOptions(),
        loss: DenoiserLoss = DenoiserLoss(),
        self_forcing: SelfForcing = SelfForcing(),
        optimizer: OptimizerOptions = OptimizerOptions(warmup_steps=1000),
        sampling: Sampling = Sampling(),
        compile: bool = False,
        cuda_graph: bool = False,
        seed: int = 1111,
    ) -> None:
        super().__init__()
        require_choice("target", target, Target)
        require_whole("max_agents", max_agents, 1, MOST_SLOTS)
        require_whole("window", window, 1)
        self.network, self.noise = group_of(TransformerOptions, network), group_of(NoiseOptions, noise)
        self.loss, self.self_forcing = group_of(DenoiserLoss, loss), group_of(SelfForcing, self_forcing)
        self.optimizer, self.sampling = group_of(OptimizerOptions, optimizer), group_of(Sampling, sampling)
        groups = {"network": self.network, "noise": self.noise, "loss": self.loss, "self_forcing": self.self_forcing}
        sizes = {"tokenizer": tokenizer, "max_agents": max_agents, "window": window, "target": target}
        rest = {"start_from": start_from, "compile": compile, "cuda_graph": cuda_graph, "seed": seed}
        groups |= {"optimizer": self.optimizer, "sampling": self.sampling}
        self.keep(plain({**sizes, **groups, **rest}))
        self.window = window
        self.build_named(tokenizer)
        if tokenizer is None and start_from is not None and checkpoints.named(start_from).exists():
            self.build(starting.tokenizer_of(start_from))

    # -- parts ---------------------------------------------------------------------------------

    def build(self, tokenizer: PoseTokenizer) -> None:
        """Make the parts whose sizes depend on the tokenizer, any `PoseTokenizer`."""
        agents, pairwise = self.hparams["max_agents"], self.network.pairwise
        self.hold(tokenizer, TokenLayout(tokenizer.codebook_dim, agents, pairwise, self.noise.pairwise))
        self.transformer = Transformer(self.layout, self.network)
        posterior = self.network.pairwise_posterior and self.layout.slots
        self.posterior = PairwisePosterior(self.layout) if posterior else None

    @property
    def quantized(self) -> bool:
        return bool(self.hparams["target"] == "quantized")

    # -- what the model does -------------------------------------------------------------------

    def condition(self, scene: Scene) -> Tensor | None:
        """What scenes are conditioned on, (B, C) or (B, N, C); None: nothing, as in the paper.

        The place for text, music or a goal: a subclass embeds them here, C is `network.cond_dim`. Training and testing
        ask for it; who samples gives it to `generate` as `cond`. It must tell nothing that a user would not know.
        """
        return None

    def denoise(
        self,
        noisy: Tensor,
        levels: Tensor,
        present: Tensor,
        cond: Tensor | None = None,
        network: Callable[..., Tensor] | None = None,
    ) -> Tensor:
        """Predict clean tokens. noisy (B, N, P, D) normalized, levels (B, N, P) int, present (B, P) -> (B, N, P, D)

        `cond` is that of `Transformer.forward`; `network` runs in its place, such as a `LeanTransformer` of it.

        A window does not know what came before it: its first step is always shown as standing still, in
        training as in sampling.
        """
        clean = self.predict_tokens(noisy, levels, present, cond, network)
        return self.fused(clean, noisy, levels, present)

    def predict_tokens(
        self,
        noisy: Tensor,
        levels: Tensor,
        present: Tensor,
        cond: Tensor | None = None,
        network: Callable[..., Tensor] | None = None,
    ) -> Tensor:
        """What the transformer itself predicts, before `fused`; as `denoise`."""
        shown = self._without_lead(noisy).to(dtype_of(self.transformer))
        made = (network or self.transformer)(shown, levels, present, cond)
        return skipped(made, shown, levels, self.layout) if self.network.skip else made

    def fused(self, clean: Tensor, noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
        """Predicted tokens with their deltas and pairwise transforms as one posterior, if the model has one."""
        if self.posterior is None:
            return clean
        with torch.autocast(noisy.device.type, enabled=False):  # half precision would blur the transforms
            return self.posterior(clean.float(), noisy.float(), levels, present, self.normalizer)

    def _without_lead(self, tokens: Tensor) -> Tensor:
        lead = slice(self.layout.latent, self.layout.latent + 9)
        mean, std = self.normalizer.mean, self.normalizer.std
        still = (constant((1, 0, 0, 0, 1, 0, 0, 0, 0), mean) - mean[lead]) / std[lead]
        tokens = tokens.clone()
        tokens[:, 0, :, lead] = still.to(tokens.dtype)
        return tokens
