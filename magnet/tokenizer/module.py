"""`Tokenizer`: training the conditional VQ-VAE (paper 3.1)."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor
from torchmetrics import MeanMetric

from magnet.body import Body
from magnet.motion.scene import Scene
from magnet.motion.tokens import by_token
from magnet.precision import require_float32_scenes
from magnet.seeding import derive
from magnet.tokenizer.augment import joint_noise, root_noise, swap_limbs
from magnet.tokenizer.base import Quantized
from magnet.tokenizer.checkpoint import check_fields, read_checkpoint
from magnet.tokenizer.core import TokenizerCore
from magnet.tokenizer.features import Features, features, put
from magnet.tokenizer.losses import JOINT_LOSSES, masked_mean, matrices, reconstruction_losses
from magnet.tokenizer.quantizer import KMEANS_VECTORS
from magnet.tokenizer.raw import RawPose
from magnet.tokenizer.usage import CodeUse, by_quantizer
from magnet.training import origins
from magnet.training.optim import Trained, warmup_cosine
from magnet.training.validation import log_means

__all__ = ["RawPose", "Tokenizer"]

STATISTICS_BATCHES = 50
GLANCE = 4
"""Scenes of a training batch whose joint error is logged: enough for a curve, at no cost."""


class Tokenizer(TokenizerCore, Trained):
    """Conditional VQ-VAE of one person's pose (paper 3.1, Table A.2), and its training.

    Options are those of `TokenizerCore`.
    """

    origin: origins.Origin | None = None  # of its weights; None: nobody recorded it

    def keep(self, options: dict[str, Any]) -> None:
        # As a dictionary: inside a command line that builds another module, Lightning would store that one's fields.
        self.save_hyperparameters(options)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        tokenizer = super().load(path)
        tokenizer.origin = origins.begun(path)
        return tokenizer

    # -- start ---------------------------------------------------------------------------------

    @torch.no_grad()
    def init_codebook(self, scenes: Iterable[Scene]) -> None:
        """Fit normalizers, then initialize the codebook by k-means, on the first training batches; only once.

        Codes wait for the `continuous_steps` of training that go without them.
        """
        settled = self.quantizer.initialized or self.quantizer.waits
        if settled and self.vqvae.pose.ready:
            return
        some = []
        for number, scene in enumerate(scenes):
            some.append(scene.to(self.device))
            if number + 1 == STATISTICS_BATCHES:
                break
        if not self.vqvae.pose.ready:
            self.fit_normalizers(some)
        if settled:
            return
        vectors: list[Tensor] = []
        for scene in some:
            seen = features(scene)
            vectors.append(self.embed(seen.pose, seen.betas, seen.deltas, seen.valid)[seen.tokens])
            if sum(map(len, vectors)) >= KMEANS_VECTORS * self.quantizer.size:
                break
        self.quantizer.kmeans_init(torch.cat(vectors), self._generator("start"))

    def _generator(self, *what: int | str) -> torch.Generator:
        return torch.Generator(device=self.device).manual_seed(derive(self.hparams["seed"], *what))

    # -- training ------------------------------------------------------------------------------

    def setup(self, stage: str) -> None:
        require_float32_scenes(self.trainer.precision)
        if not hasattr(self, "mpjpe"):
            self.mpjpe, self.local_mpjpe = MeanMetric(), MeanMetric()
            self.code_use = CodeUse(self.quantizer.num_quantizers, self.quantizer.size)
        if self.body is None:
            from magnet.body import load_body

            # A copy, because this one moves to the model's device.
            body = getattr(getattr(self.trainer, "datamodule", None), "body", None)
            self.body = load_body() if body is None else copy.deepcopy(body)

    @property
    def _initialized(self) -> bool:
        return bool(self.quantizer.initialized) and bool(self.vqvae.pose.ready)

    def begin(self) -> None:
        if not self.vqvae.pose.ready:  # codes may wait longer: what was trained until then is not to be lost
            if self.hparams["start_from"]:
                self.take_weights(self.hparams["start_from"])
            self.origin = origins.begun(self.hparams["start_from"])
        if self.hparams["decoder_only"]:
            if not self._initialized:
                raise ValueError("decoder_only: there are no codes to decode yet; give start_from a trained tokenizer")
            self.quantizer.frozen = True
        batches = getattr(getattr(self.trainer, "datamodule", None), "statistics_batches", None)
        if not self._initialized and batches is not None:
            self.init_codebook(batches())

    def on_fit_start(self) -> None:
        super().on_fit_start()
        if self.hparams["compile"]:
            self.vqvae.encoder.compile()
            self.vqvae.decoder.compile()

    def on_train_start(self) -> None:
        super().on_train_start()
        if not self._initialized:  # there is no data module
            self.init_codebook(self.trainer.train_dataloader)  # type: ignore[arg-type]

    def on_train_batch_start(self, batch: Scene, batch_idx: int) -> None:
        if not self.quantizer.waits:
            return
        wished, last = self.hparams["quantizer"]["continuous_steps"], self.trainer.estimated_stepping_batches - 1
        if self.global_step >= min(wished, last / 2):  # a training of a single step ends with codes as well
            self.quantizer.waits = False
            batches = getattr(getattr(self.trainer, "datamodule", None), "statistics_batches", None)
            self.init_codebook([batch] if batches is None else batches())

    def take_weights(self, path: str | Path) -> None:
        """Copy another tokenizer's networks and statistics, and its codes if their number is the same."""
        _, state = read_checkpoint(path)
        mine = self.state_dict()
        kept = {name: value for name, value in state.items() if name in mine and mine[name].shape == value.shape}
        if lost := [name for name in mine if name.startswith("vqvae.") and name not in kept]:
            raise ValueError(f"start_from: {path} has other networks than this tokenizer: {lost[0]} does not fit")
        if "quantizer.codes" not in kept:
            kept = {name: value for name, value in kept.items() if not name.startswith("quantizer.")}
        self.load_state_dict(kept, strict=False)

    def augmented(self, scene: Scene, batch_idx: int) -> Scene:
        augment = self.augment
        generator = self._generator("augment", self.global_step, batch_idx, self.global_rank)
        if augment.limb_swap_prob:
            scene = swap_limbs(scene, augment.limb_swap_prob, generator)
        return joint_noise(scene, augment.joint_noise, generator) if augment.joint_noise else scene

    def training_step(self, batch: Scene, batch_idx: int) -> Tensor:
        batch = self.augmented(batch, batch_idx)
        seen = features(batch)
        losses, pose, quantized = self.losses(seen, batch_idx)
        if self._trainer is not None:
            self.log_loss(losses["loss"], batch_size=batch.scenes)
            logged = {f"train/{name}": value.detach() for name, value in losses.items()}
            if self.global_step % self.trainer.log_every_n_steps == 0:  # type: ignore[attr-defined]
                logged |= {f"train/{name}": value for name, value in by_quantizer(quantized.counts).items()}
                scenes = slice(0, GLANCE)
                error, _ = self._joint_errors(pose.detach()[scenes], batch.select(scenes))
                logged["train/mpjpe_cm"] = 100 * masked_mean(error, seen.counts[scenes])
            self.log_dict(logged, batch_size=batch.scenes)
        return losses["loss"]

    def losses(self, seen: Features, batch_idx: int = 0) -> tuple[dict[str, Tensor], Tensor, Quantized]:
        """Weighted sum and terms; decoded poses (B, T, P, 135); the quantizer's result."""
        with torch.set_grad_enabled(torch.is_grad_enabled() and not self.hparams["decoder_only"]):
            embedded = self.embed(seen.pose, seen.betas, seen.deltas, seen.valid)
        quantized = self.quantizer(embedded, seen.tokens, self._generator("codebook", self.global_step, batch_idx))
        deltas = seen.deltas
        if self.training and self.augment.root_noise:
            generator = self._generator("drift", self.global_step, batch_idx, self.global_rank)
            deltas = root_noise(deltas, self.augment.root_noise, generator)
        pose = self._reconstruct(quantized.latent, seen.betas, by_token(deltas), seen.valid)
        with torch.autocast(pose.device.type, enabled=False):
            joints = self._canonical_joints(seen) if any(getattr(self.loss, name) for name in JOINT_LOSSES) else None
            losses = reconstruction_losses(pose, seen.pose, seen.counts, joints, deltas, seen.deltas)
        losses["commitment"] = quantized.commitment
        total = sum(getattr(self.loss, name) * value for name, value in losses.items())
        return {"loss": total, **losses}, pose, quantized

    def _canonical_joints(self, seen: Features):  # type: ignore[no-untyped-def]
        body = self._require_body()
        return lambda pose: body.forward_kinematics(*matrices(pose), seen.betas[:, None])

    def _require_body(self) -> Body:
        if self.body is None:
            raise ValueError("joint errors need a body; set tokenizer.body = load_body(...), or train with a Trainer")
        return self.body

    def _joint_errors(self, pose: Tensor, scene: Scene) -> tuple[Tensor, Tensor]:
        """Mean distance in metres of the 21 joints beside the pelvis, (B, T, P): in the world with the root's
        canonical frame given, and with pelvis position and turn taken out."""
        body = self._require_body()
        scene = scene.slice(0, pose.shape[1])
        decoded = put(pose, scene)
        world = body.joints(decoded) - body.joints(scene)
        still = torch.eye(4, device=pose.device)
        betas = scene.betas[:, None]
        local = body.forward_kinematics(decoded.body_rot, still, betas)
        local = local - body.forward_kinematics(scene.body_rot, still, betas)
        return world[..., 1:, :].norm(dim=-1).mean(-1), local[..., 1:, :].norm(dim=-1).mean(-1)

    def validation_step(self, batch: Scene, batch_idx: int) -> None:
        self._evaluate(batch, "val")

    def test_step(self, batch: Scene, batch_idx: int) -> None:
        self._evaluate(batch, "test")

    def predict_step(self, batch: Scene, batch_idx: int) -> Scene:
        return self.reconstruct(batch)

    def _evaluate(self, batch: Scene, stage: str) -> None:
        seen = features(batch)
        losses, pose, quantized = self.losses(seen)
        world, local = self._joint_errors(pose, batch)
        weight = seen.counts.sum()
        self.mpjpe.update(100 * masked_mean(world, seen.counts), weight)
        self.local_mpjpe.update(100 * masked_mean(local, seen.counts), weight)
        self.code_use.update(quantized.counts)
        logged = {f"{stage}/{name}": value for name, value in losses.items()}
        log_means(self, logged, batch)
        self.log(f"{stage}/mpjpe_cm", self.mpjpe, batch_size=batch.scenes, prog_bar=True)
        self.log(f"{stage}/mpjpe_local_cm", self.local_mpjpe, batch_size=batch.scenes)

    def on_validation_epoch_end(self) -> None:
        self._finish("val")

    def on_test_epoch_end(self) -> None:
        self._finish("test")

    def _finish(self, stage: str) -> None:
        self.log_dict({f"{stage}/{name}": value for name, value in self.code_use.compute().items()})
        self.code_use.reset()

    def configure_optimizers(self) -> Any:
        trained = self.vqvae.decoder if self.hparams["decoder_only"] else self.vqvae
        return warmup_cosine(self, trained.parameters(), self.optimizer)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        if "tokenizer_hyper_parameters" in checkpoint:
            raise ValueError(
                "not a tokenizer's checkpoint, it holds a denoiser; --model.start_from takes over the tokenizer in one"
            )
        check_fields(checkpoint.get("hyper_parameters", {}), self.hparams)
        self.origin = origins.taken(checkpoint)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        origins.put(self.origin, None if self.body is None else self.body.id, checkpoint)
