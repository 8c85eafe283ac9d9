"""`Denoiser`: training the diffusion forcing transformer (paper 3.2, A.3)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from magnet.cuda_graphs import GraphedStep
from magnet.denoiser import starting
from magnet.denoiser.body_losses import BODY_LOSSES, decoded_losses
from magnet.denoiser.core import DenoiserCore
from magnet.denoiser.levels import FAINT, drawn
from magnet.denoiser.losses import consistency_losses, near_loss, shake_loss, snr_weights, token_losses
from magnet.denoiser.self_forcing import MadePasts, displaced_at_first, with_made_pasts, with_self_forcing
from magnet.denoiser.statistics import token_statistics
from magnet.denoiser.token_model import TokenModel
from magnet.denoiser.transformer import is_sharded
from magnet.motion.scene import Scene, all_valid
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.sampling.noise import LEVELS, add_noise
from magnet.seeding import derive, step_generator
from magnet.training import origins
from magnet.training.optim import warmup_cosine
from magnet.training.validation import log_means, of_one_size, places_of
from magnet.waiting import may_look


class Denoiser(DenoiserCore, TokenModel):
    """Diffusion forcing transformer over all agents' motion tokens (paper 3.2), and its training.

    Options are those of `DenoiserCore`.
    """

    made_pasts: MadePasts | None = None  # set by `magnet.callbacks.RollOuts`
    graphed: GraphedStep | None = None  # of the training that is going on
    validated = 0  # scenes of this process in the validation that is going on
    places: Sequence[int] = ()  # of a validation's batch: which scenes of the whole validation set they are

    # -- training ------------------------------------------------------------------------------

    def configure_model(self) -> None:
        """Shards the network block by block where the strategy has a mesh of devices (`ModelParallelStrategy`)."""
        if self.device_mesh is None or not self.built or is_sharded(self.transformer):
            return
        from torch.distributed.fsdp import fully_shard

        parts: list[nn.Module] = [*self.transformer.blocks, self.transformer]
        for part in parts if self.posterior is None else [*parts, self.posterior]:
            fully_shard(part, mesh=self.device_mesh["data_parallel"])

    def begin(self) -> None:
        if not self.normalizer.ready:
            if self.hparams["start_from"]:
                self.take_over(self.hparams["start_from"])
            self.origin = origins.begun(self.hparams["start_from"], self.hparams["tokenizer"])
            super().begin()

    def on_fit_start(self) -> None:
        super().on_fit_start()
        if self.hparams["cuda_graph"] and self.device.type == "cuda":
            self._require_recordable()
            self.graphed = GraphedStep(self.losses_of, self.trained())
        elif self.hparams["compile"]:
            for block in self.transformer.blocks:
                block.compile(dynamic=True)

    def setup(self, stage: str) -> None:
        self.graphed = None  # of a training that was interrupted; it cannot be copied
        stride = self.sampling.stride or 0
        if stage == "fit" and stride > self.window:
            raise ValueError(
                f"sampling.stride {stride}: is more token steps than the window of {self.window} has, so the "
                f"model could not be sampled; set --data.window_frames {TOKEN_FRAMES * stride} or more, as "
                f"of the model that it starts from, or --model.sampling.stride {self.window} or less"
            )
        super().setup(stage)

    def on_fit_end(self) -> None:
        self.graphed = None  # its memory

    def _require_recordable(self) -> None:
        """Refuse a training that a CUDA graph would not repeat.

        Raises:
            ValueError: weights in shards, a loss that is scaled, or conditions, which may read what is no tensor.
        """
        why = ""
        if is_sharded(self.transformer):
            why = "weights in shards cannot be recorded; use another strategy"
        if getattr(self.trainer.precision_plugin, "scaler", None) is not None:
            why = "gradients of 16-mixed would vanish before they are scaled; take --trainer.precision bf16-mixed"
        if type(self).condition is not DenoiserCore.condition:
            why = "conditions are not recorded"
        if why:
            raise ValueError(f"cuda_graph: {why}, or leave out --model.cuda_graph")

    def take_over(self, path: str | Path) -> None:
        """Start from another denoiser's weights; see `magnet.denoiser.starting.start_from`."""
        metres = self.noise.pairwise_metres
        starting.start_from(path, self.transformer, self.tokenizer, self.normalizer, metres, self.posterior)

    def fit_normalizer(self, tokens: Tensor, there: Tensor) -> None:
        """Set how tokens are normalized from real ones, as `tokenize` returns them."""
        scales = (self.noise.pairwise_metres, self.narrow)
        self.normalizer.set(*token_statistics(self.layout, tokens, there, *scales))

    def training_step(self, batch: Scene, batch_idx: int) -> Tensor:
        place = (self.hparams["seed"], "train", self.global_step, batch_idx, self.global_rank)
        generator = step_generator(self.device, *place)
        scene = displaced_at_first(batch, self.self_forcing.displaced, generator, self.self_forcing.far)
        scene, made = with_made_pasts(scene, self.made_pasts, generator)
        if self.graphed is None:
            losses = self.losses(scene, generator, made)
        else:
            settings = (self.loss, self.noise, self.self_forcing)
            losses = self.graphed(self._inputs(scene, made), derive(*place, "graph"), settings)
        self.log_dict({f"train/{name}": value for name, value in losses.items()}, prog_bar=False)
        self.log_loss(losses["loss"])
        return losses["loss"]

    def on_validation_epoch_start(self) -> None:
        self.validated = 0

    def validation_step(self, batch: Scene, batch_idx: int) -> None:
        # The same noise at every validation, in whatever batches and processes: epochs and runs can be compared.
        generator = torch.Generator(device=self.device).manual_seed(derive(self.hparams["seed"], "validation"))
        places = places_of(self, batch, self.validated)
        self.validated += batch.scenes
        # Means over pairs weigh by people where all scenes have as many; processes must run shards equally often.
        alike = [list(range(batch.scenes))] if is_sharded(self.transformer) else of_one_size(batch)
        try:
            for rows in alike:
                part, self.places = batch.select(rows), [places[b] for b in rows]
                losses = self.losses(part, generator)
                log_means(self, {f"val/{name}": value for name, value in losses.items()}, part)
        finally:
            self.places = ()

    def _inputs(self, scene: Scene, made: Tensor | None) -> dict[str, Tensor]:
        """What `losses` depends on in a training step, as tensors; `losses_of` takes it."""
        if made is None:
            made = torch.zeros(scene.scenes, scene.frames // TOKEN_FRAMES, dtype=torch.bool, device=scene.device)
        scene = scene.replace(valid=all_valid(scene) if scene.valid is None else scene.valid, given=None)
        scene = scene.pad_agents(self.layout.agents)  # one recording for all
        return {**scene.tensors(), "made": made, "ramp": torch.full((), self._ramp(), device=scene.device)}

    def losses_of(self, inputs: dict[str, Tensor], generator: torch.Generator) -> dict[str, Tensor]:
        """`losses` of a training step whose batch is tensors by name: what a CUDA graph of it replays."""
        tensors = dict(inputs)
        made, ramp = tensors.pop("made"), tensors.pop("ramp")
        return self.losses(Scene(**tensors), generator, made, ramp)  # type: ignore[arg-type]

    def _ramp(self) -> float:
        """Share of the consistency loss that counts by now."""
        return min(1.0, (self.global_step + 1) / max(self.loss.consistency_warmup, 1)) if self.training else 1.0

    def losses(
        self,
        scene: Scene,
        generator: torch.Generator,
        made: Tensor | None = None,
        ramp: float | Tensor | None = None,
    ) -> dict[str, Tensor]:
        """The weighted sum `loss` and its parts, unweighted; all noise comes from the generator (paper Eq. 9-11).

        made (B, N) bool: token steps that the model has made itself; they are shown clean and do not count. ramp:
        share of the consistency loss that counts; None: as far as training has come.

        Raises:
            ValueError: nobody has set how tokens are normalized (on a CPU; a GPU would be waited for).
        """
        if may_look(self.device):
            self.require_statistics()
        layout, weight = self.layout, self.loss
        with torch.no_grad():
            scene = scene.absent_at_origin()  # NaN there would be in every gradient
            tokens, there = self.tokenize(scene)
            named = scene.pad_agents(layout.agents)
            scene = named.replace(names=())  # by which a GPU would be waited for
            truth = self.normalizer.normalize(tokens)
            levels, noise = drawn(self.noise, truth.shape, generator, scene.present, self.places)
            # What was not tracked, or lies behind a clip's end, is unknown, not people who stand still.
            levels = levels.masked_fill(scene.present[:, None] & ~there[..., 0], LEVELS)
            if made is not None:
                levels, there = levels.masked_fill(made[..., None], 0), there & ~made[..., None, None]
            group_levels = layout.group_levels(levels)
            cond = self.shown_condition(named, generator)
            shown = self._self_forced(truth, levels, scene, cond, generator)
            noisy = add_noise(shown, noise, layout.spread(group_levels))
        own = self.predict_tokens(noisy, levels, scene.present, cond)
        clean = self.fused(own, noisy, levels, scene.present).float()
        snr = snr_weights(group_levels, weight.snr_gamma) if weight.weighting == "min_snr" else None
        losses = token_losses(clean, truth, layout, there, snr, weight.huber)
        total = weight.latent * losses["latent"] + weight.delta * losses["delta"]
        predicted = self.normalizer.denormalize(clean)
        if weight.shake:
            losses["shake"] = shake_loss(predicted, tokens, layout, there, group_levels)
            total = total + weight.shake * losses["shake"]
        if layout.slots:
            rotation, translation = consistency_losses(predicted, layout, there)
            losses["consistency"] = rotation + translation
            ramp = self._ramp() if ramp is None else ramp
            total = total + weight.pairwise * losses["pairwise"] + ramp * weight.consistency * losses["consistency"]
            if weight.near:
                losses["near"] = near_loss(predicted, tokens, layout, there, group_levels)
                total = total + weight.near * losses["near"]
            if self.posterior is not None and weight.unfused:
                # Through its posterior alone the network's own guess is hardly trained, and gets lost.
                losses["unfused"] = self._unfused(own.float(), tokens, truth, there, group_levels, snr)
                total = total + weight.unfused * losses["unfused"]
        if any(getattr(weight, name) for name in BODY_LOSSES):
            batch = clean, tokens, levels, scene, there
            bodies = decoded_losses(self, self.require_body(), *batch, weight.decoded_share)
            total = total + sum(getattr(weight, name) * value for name, value in bodies.items())
            losses |= bodies
        return {"loss": total, **losses}

    def _unfused(
        self, own: Tensor, tokens: Tensor, truth: Tensor, there: Tensor, levels: Tensor, snr: Tensor | None
    ) -> Tensor:
        """Errors of the network's own deltas and pairwise transforms, weighted as those of their posterior."""
        weight = self.loss
        losses = token_losses(own, truth, self.layout, there, snr, weight.huber)
        near = near_loss(self.normalizer.denormalize(own), tokens, self.layout, there, levels)
        return weight.delta * losses["delta"] + weight.pairwise * losses["pairwise"] + weight.near * near

    def shown_condition(self, scene: Scene, generator: torch.Generator) -> Tensor | None:
        """The condition of a batch, hidden from some of its scenes in training."""
        cond = self.condition(scene)
        if cond is None or not (self.training and self.network.cond_dropout):
            return cond
        hidden = torch.rand(len(cond), generator=generator, device=cond.device) < self.network.cond_dropout
        return torch.where(hidden.view(-1, *[1] * (cond.ndim - 1)), torch.nan, cond)

    def _self_forced(
        self, truth: Tensor, levels: Tensor, scene: Scene, cond: Tensor | None, generator: torch.Generator
    ) -> Tensor:
        if not (self.training and self.self_forcing.share):
            return truth
        faint = FAINT if self.noise.faint_past else 0
        shown = with_self_forcing(self, truth, levels, scene, self.self_forcing, generator, cond, faint)
        if shown is truth and is_sharded(self.transformer):  # nobody ran it; processes must run shards equally often
            self.denoise(truth[:1], levels[:1], scene.present[:1], None if cond is None else cond[:1])
        return shown

    def configure_optimizers(self) -> Any:
        self.require_tokenizer()
        return warmup_cosine(self, self.trained(), self.optimizer)

    def trained(self) -> list[nn.Parameter]:
        """The parameters that training moves: the network's and the posterior's."""
        parts: list[nn.Module] = [self.transformer]
        if self.posterior is not None:
            parts.append(self.posterior)
        return [parameter for part in parts for parameter in part.parameters()]
