"""`Denoiser`: the diffusion forcing transformer and its training."""

from __future__ import annotations

import copy
import inspect
from pathlib import Path
from typing import Any, Literal, get_args

import lightning as L
import torch
from torch import Tensor

from magnet import weights
from magnet.body import Body, load_body
from magnet.checks import require_number
from magnet.denoiser import starting
from magnet.denoiser.levels import NoiseLevels
from magnet.denoiser.losses import Weighting
from magnet.denoiser.objective import training_losses
from magnet.denoiser.pairwise_posterior import PairwisePosterior
from magnet.denoiser.statistics import token_statistics
from magnet.denoiser.transformer import Rope, Transformer
from magnet.motion.scene import Scene
from magnet.motion.tokens import STRIDE, TokenLayout, scene_transforms
from magnet.old_names import renamed_checkpoint
from magnet.precision import dtype_of, require_float32_scenes
from magnet.seeding import derive, step_generator
from magnet.tokenizer.module import RawPose, Tokenizer
from magnet.tokenizer.normalizer import Normalizer
from magnet.training.optim import adamw_cosine

Target = Literal["quantized", "continuous"]


class Denoiser(L.LightningModule):
    """Diffusion forcing transformer over the motion tokens of all agents (paper 3.2).

    Holds the frozen tokenizer it was trained with, so one checkpoint is all that a user needs.

    Args:
        tokenizer: checkpoint of a trained tokenizer, or of a denoiser with one, or the name of a shipped model such as
            `duet`. `raw` uses plain poses instead (ablation, paper Table 5). A checkpoint of this module brings its
            own, and this is then not read.
        max_agents: agent slots P; smaller scenes leave slots empty. Linked to the data's.
        window: token steps that the model sees at once; 16 tokens are 64 frames. Linked to the data's.
        width: hidden size d, paper Table A.2.
        layers: transformer blocks, paper Table A.2.
        heads: attention heads, paper Table A.2.
        mlp_ratio: MLP size over d, paper Table A.2.
        dropout: in attention and MLPs; the paper does not say.
        level_width: size of the noise-level embedding, paper Table A.2.
        agent_width: size of the agent embedding, paper Table A.2.
        slot_width: size of the level embedding of each partner slot (ours; see pairwise_noise).
        rope: where time enters: `hidden` as in paper Table A.2, `heads` as usual elsewhere, `none` (ablation,
            Table A.5).
        agent_embedding: False takes the agents' identities away (ablation, paper Table A.5).
        pairwise: False takes pairwise transforms out of the tokens (ablation, paper Table 5).
        causal_block: token steps of a block of attention: a token sees blocks up to its own, so that what is finished
            is not changed by what is not (ours). 0: everything sees everything, as in the paper.
        target: what of the pose is generated: `quantized`, the tokenizer's codes, as in the paper, or `continuous`,
            its encoder's latents before they are snapped to codes (ours); sampling follows.
        pairwise_noise: `noisier_end`: a pairwise transform is as noisy as the noisier of its two agents.
            `token`: one level a token as the paper reads literally, which leaks where unknown agents are.
        pairwise_posterior: replaces predicted pairwise transforms by their posterior, given what is shown of them and
            the predicted steps (ours), see `PairwisePosterior`.
        noise_levels: how training draws levels: `per_token` (paper 3.2), `per_timestep`, `per_sequence`, or
            `mixture` (ours: these and the patterns that sampling asks about).
        level_shift: over 1 draws high levels more often; see `magnet.sampling.noise.shifted`.
        weighting: how much a token's error counts by its noise: `uniform`, as in the paper, or `min_snr`; see
            `magnet.denoiser.losses.snr_weights`.
        snr_most: gamma of `min_snr`, the most that an error counts.
        own_past: share of the scenes with a past whose past is shown as the model would have made it (ours).
        latent_weight: lambda_0 of paper Eq. 10.
        step_weight: lambda_1 of paper Eq. 10.
        pairwise_weight: lambda_2 of paper Eq. 10.
        near_weight: adds the error of pairwise transforms in which centimetres near a partner count (ours); see
            `magnet.denoiser.losses.near_loss`.
        consistency_weight: lambda_3 of paper Eq. 10, for rotation and translation alike.
        consistency_warmup: steps over which lambda_3 grows from 0.
        pose_weight: adds the distance of decoded joints in metres to the loss (ours); see `body_losses`.
        motion_weight: adds the error of decoded joints' velocities in m/s (ours).
        partner_weight: adds the distance of the partners' decoded joints, as each sees them, in metres (ours).
        hands_weight: adds the error of vectors between people's wrists within reach, in metres (ours).
        decoded_share: share of a batch's scenes, the least noisy ones, that are decoded for these four.
        start_from: checkpoint of a denoiser, or the name of a shipped model such as `duet`, whose weights training
            starts from. Without a `tokenizer` its own is kept, frozen, and with it how tokens are normalized.
        pairwise_metres: metres in a pairwise transform that count as one when tokens are normalized (ours): the
            smaller, the less noise hides where a partner is. 0: their standard deviation, as in the paper.
        learning_rate: paper A.3.
        weight_decay: paper A.3.
        warmup_steps: linear warm-up; the rate then falls to zero on a cosine (paper A.3).
        compile: compile the transformer's blocks for training; worth it on a GPU, not on a CPU.
        seed: all training noise follows from it.
    """

    def __init__(
        self,
        tokenizer: str | None = None,
        max_agents: int = 2,
        window: int = 16,
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
        pairwise: bool = True,
        causal_block: int = 0,
        target: Target = "quantized",
        pairwise_noise: Literal["noisier_end", "token"] = "noisier_end",
        pairwise_posterior: bool = False,
        noise_levels: NoiseLevels = "per_token",
        level_shift: float = 1.0,
        weighting: Weighting = "uniform",
        snr_most: float = 5.0,
        own_past: float = 0.0,
        latent_weight: float = 1.0,
        step_weight: float = 1.0,
        pairwise_weight: float = 1.0,
        near_weight: float = 0.0,
        consistency_weight: float = 0.1,
        consistency_warmup: int = 1000,
        pose_weight: float = 0.0,
        motion_weight: float = 0.0,
        partner_weight: float = 0.0,
        hands_weight: float = 0.0,
        decoded_share: float = 0.25,
        start_from: str | None = None,
        pairwise_metres: float = 0.0,
        learning_rate: float = 2e-4,
        weight_decay: float = 1e-4,
        warmup_steps: int = 1000,
        compile: bool = False,
        seed: int = 1111,
    ) -> None:
        super().__init__()
        for name, value, kind in (("target", target, Target), ("weighting", weighting, Weighting)):
            if value not in get_args(kind):
                raise ValueError(f"{name}: got {value!r}, expected {' or '.join(get_args(kind))}")
        require_number("snr_most", snr_most, over=0)
        self.save_hyperparameters()
        self.window = window
        self.tokenizer: Tokenizer | RawPose
        self._body: tuple[Body, ...] = ()  # in a tuple, so that it is no part of the model that is saved and averaged
        if tokenizer == "raw":
            self.build(RawPose())
        elif tokenizer is not None and weights.named(tokenizer).exists():
            self.build(Tokenizer.load(tokenizer))
        elif tokenizer is None and start_from is not None and weights.named(start_from).exists():
            self.build(starting.tokenizer_of(start_from))

    # -- parts ---------------------------------------------------------------------------------

    def build(self, tokenizer: Tokenizer | RawPose) -> None:
        """Make the parts whose sizes depend on the tokenizer."""
        h: Any = self.hparams
        self.tokenizer = tokenizer.requires_grad_(False).eval()
        self.layout = TokenLayout(tokenizer.latent, h.max_agents, h.pairwise, h.pairwise_noise)
        self.normalizer = Normalizer(self.layout.width, floor=0.0)
        self.transformer = Transformer(
            self.layout,
            width=h.width,
            layers=h.layers,
            heads=h.heads,
            mlp_ratio=h.mlp_ratio,
            dropout=h.dropout,
            level_width=h.level_width,
            agent_width=h.agent_width,
            slot_width=h.slot_width,
            rope=h.rope,
            agent_embedding=h.agent_embedding,
            causal_block=h.causal_block,
        )
        self.posterior = PairwisePosterior(self.layout) if h.pairwise_posterior and self.layout.slots else None

    @property
    def quantized(self) -> bool:
        """Whether latents are codes, in training and so in sampling."""
        return bool(self.hparams["target"] == "quantized")

    @property
    def built(self) -> bool:
        return hasattr(self, "transformer")

    def require_tokenizer(self) -> None:
        if not self.built:
            name = "tokenizer" if self.hparams["tokenizer"] or not self.hparams["start_from"] else "start_from"
            path = self.hparams[name]
            given = "not given" if path is None else f"{path!r}, which is no file and no shipped model"
            raise ValueError(
                f"the denoiser has no tokenizer: --model.{name} is {given}. "
                "Train one with `magnet fit --config configs/synthetic_tokenizer.yaml` and give its checkpoint, or go "
                "on from the shipped model: --model.start_from duet"
            )

    def train(self, mode: bool = True) -> Denoiser:
        super().train(mode)
        if self.built:
            self.tokenizer.eval()  # frozen: its codebook must never move
        return self

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        tokenizer = self.tokenizer
        checkpoint["tokenizer_hyper_parameters"] = dict(tokenizer.hparams) if isinstance(tokenizer, Tokenizer) else None

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Bring back the tokenizer that the checkpoint was trained with, whatever was given here."""
        checkpoint.update(renamed_checkpoint(checkpoint))
        if "tokenizer_hyper_parameters" not in checkpoint:
            raise ValueError("this is not a denoiser's checkpoint: it carries no tokenizer")
        stored = checkpoint["tokenizer_hyper_parameters"]
        given = dict(self.tokenizer.hparams) if self.built and isinstance(self.tokenizer, Tokenizer) else None
        if not self.built or stored != given:
            self.build(RawPose() if stored is None else Tokenizer(**stored))
            self.to(self.device)
        if self.posterior is not None:  # a checkpoint from before it was switched on has none
            for name, value in self.posterior.state_dict().items():
                checkpoint["state_dict"].setdefault(f"posterior.{name}", value)

    @classmethod
    def load(cls, name_or_path: str | Path | None = None) -> Denoiser:
        """A trained model ready for use: one that comes with the package by name, or a checkpoint's path.

        Raises:
            ValueError: no such checkpoint, or not a denoiser's.
        """
        path = weights.resolve(name_or_path)
        checkpoint = weights.read(path)
        if "tokenizer_hyper_parameters" not in checkpoint:
            raise ValueError(f"{path}: not a denoiser's checkpoint, for it carries no tokenizer")
        fields = inspect.signature(cls).parameters  # Lightning's command line stores more than these
        stored = {name: value for name, value in checkpoint["hyper_parameters"].items() if name in fields}
        model = cls(**{**stored, "tokenizer": None, "start_from": None})
        model.on_load_checkpoint(checkpoint)
        model.load_state_dict(checkpoint["state_dict"])
        return model.eval()

    # -- what the model does -------------------------------------------------------------------

    def encode(self, scene: Scene) -> Tensor:
        """Latents of those present, codes if `quantized`; invalid frames are not looked at. -> (B, N, P, C) float32

        The first and the last pose are held for a token each and those tokens dropped: beyond the edge a
        convolution sees zeros, which would give the last known token, of all, a code that is used nowhere else.
        """
        people = self.tokenizer.encode_scene(scene.people().pad_frames(STRIDE), self.quantized).float()[:, 1:-1, 0]
        latent = people.new_zeros(scene.scenes, scene.agents, *people.shape[1:])
        latent[scene.present] = people
        return latent.transpose(1, 2)

    def denoise(self, noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
        """Predict clean tokens. noisy (B, N, P, D) normalized, levels (B, N, P) int, present (B, P) -> (B, N, P, D)

        A window does not know what came before it: its first step is always shown as standing still, in
        training as in sampling.
        """
        clean = self.transformer(self._without_lead(noisy).to(dtype_of(self.transformer)), levels, present)
        if self.posterior is None:
            return clean
        with torch.autocast(noisy.device.type, enabled=False):  # half precision would blur the transforms
            return self.posterior(clean.float(), noisy.float(), levels, present, self.normalizer)

    def _without_lead(self, tokens: Tensor) -> Tensor:
        lead = slice(self.layout.latent, self.layout.latent + 9)
        identity = torch.tensor([1.0, 0, 0, 0, 1, 0, 0, 0, 0], device=tokens.device)
        still = (identity - self.normalizer.mean[lead]) / self.normalizer.std[lead]
        tokens = tokens.clone()
        tokens[:, 0, :, lead] = still.to(tokens.dtype)
        return tokens

    def tokenize(self, scene: Scene) -> tuple[Tensor, Tensor]:
        """Tokens in real units (B, N, P, D) and which groups of them count (B, N, P, 1 + slots) bool."""
        scene = scene.pad_agents(self.layout.agents)
        latent = self.encode(scene)
        with torch.autocast(self.device.type, enabled=False):  # half precision would blur the transforms
            tokens = self.layout.pack(latent, *scene_transforms(scene))
        there = self.layout.group_present(scene.present)[:, None].expand(*tokens.shape[:3], -1)
        if scene.valid is not None:
            whole = scene.valid.unflatten(1, (-1, STRIDE)).all(dim=-1)
            there = there & whole[:, :, None, None]
        return tokens, there

    # -- training ------------------------------------------------------------------------------

    def setup(self, stage: str) -> None:
        require_float32_scenes(self.trainer.precision)

    def on_fit_start(self) -> None:
        if not self.normalizer.ready:
            if self.hparams["start_from"]:
                starting.start_from(self, self.hparams["start_from"])
            if not self.normalizer.ready:
                self._fit_statistics()
        if self.hparams["compile"]:
            for block in self.transformer.blocks:
                block.compile(dynamic=True)

    @torch.no_grad()
    def _fit_statistics(self) -> None:
        """z-scores from the first training batches; the same on every rank, because ranks draw alike here."""
        datamodule = self.trainer.datamodule  # type: ignore[attr-defined]
        scenes = [scene.to(self.device) for scene in datamodule.statistics_batches()]
        if isinstance(self.tokenizer, RawPose):
            self.tokenizer.fit_normalizers(scenes)
        parts = [self.tokenize(scene) for scene in scenes]
        self.fit_normalizer(torch.cat([tokens for tokens, _ in parts]), torch.cat([there for _, there in parts]))

    def fit_normalizer(self, tokens: Tensor, there: Tensor) -> None:
        """Set how tokens are normalized from real ones, as `tokenize` returns them."""
        self.normalizer.set(*token_statistics(self.layout, tokens, there, self.hparams["pairwise_metres"]))

    def training_step(self, batch: Scene, batch_idx: int) -> Tensor:
        generator = step_generator(
            self.device, self.hparams["seed"], "train", self.global_step, batch_idx, self.global_rank
        )
        losses = self.losses(batch, generator)
        self.log_dict({f"train/{name}": value for name, value in losses.items()}, prog_bar=False)
        self.log("loss", losses["loss"], prog_bar=True)
        return losses["loss"]

    def validation_step(self, batch: Scene, batch_idx: int) -> None:
        # The same noise at every validation, so that epochs can be compared.
        seed = derive(self.hparams["seed"], "validation", batch_idx, self.global_rank)
        generator = torch.Generator(device=self.device).manual_seed(seed)
        losses = self.losses(batch, generator)
        logged = {f"val/{name}": value for name, value in losses.items()}
        self.log_dict(logged, batch_size=batch.scenes, sync_dist=True, prog_bar=False)

    losses = training_losses

    def require_body(self) -> Body:
        """The body whose joints decoded losses compare, on this model's device."""
        if not self._body:
            datamodule = getattr(self._trainer, "datamodule", None)
            # A copy, because this one moves to the model's device.
            self._body = (copy.deepcopy(getattr(datamodule, "body", None) or load_body()).to(self.device),)
        return self._body[0]

    def configure_optimizers(self) -> Any:
        self.require_tokenizer()
        h: Any = self.hparams
        parts = [self.transformer] if self.posterior is None else [self.transformer, self.posterior]
        trained = [parameter for part in parts for parameter in part.parameters()]
        return adamw_cosine(self, trained, h.learning_rate, h.weight_decay, h.warmup_steps)
