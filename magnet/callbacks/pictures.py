"""Pictures for the logger at validation: what a denoiser samples, what a tokenizer makes of recordings."""

from __future__ import annotations

import copy
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from PIL import Image

from magnet.checks import require_whole
from magnet.denoiser.module import Denoiser
from magnet.export.picture import contact_sheet
from magnet.generation.rollout import generate
from magnet.motion.scene import Scene
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.sampling.options import SamplerOptions
from magnet.seeding import derive
from magnet.tasks import registry
from magnet.tokenizer.module import Tokenizer

TAG = "val/samples"


class SamplePictures(Callback):
    """Draws the first validation scenes beside what the model makes of them, and sends the picture to the loggers.

    A denoiser samples a task on the scenes, a tokenizer encodes and decodes them, with averaged weights if there are
    any. Training does not change, because the noise has its own generator. TensorBoard and Weights & Biases take
    pictures; if no logger does, a PNG is written into `pictures` in the run's folder.

    Args:
        scenes: how many of the first validation batch's scenes are drawn.
        every: validations from one picture to the next.
        task: what a denoiser samples; the first half of each scene is given as context.
        steps: denoising steps.
        columns: moments drawn of each scene.
        seed: seed of the sample's noise, the same at every validation.
    """

    def __init__(
        self,
        scenes: int = 2,
        every: int = 1,
        task: str = "joint_future",
        steps: int = SamplerOptions.steps,
        columns: int = 8,
        seed: int = 1111,
    ) -> None:
        for name, value in (("scenes", scenes), ("every", every), ("columns", columns)):
            require_whole(name, value, 1)
        self.task, self.sampler = registry.get(task)(), SamplerOptions(steps=steps, any_floor=True)
        self.scenes, self.every, self.columns, self.seed = scenes, every, columns, seed
        self.validations = 0

    def on_validation_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Scene,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        if trainer.sanity_checking or batch_idx or dataloader_idx or not trainer.is_global_zero:
            return
        self.validations += 1
        if (self.validations - 1) % self.every:
            return
        few = batch.select(slice(0, self.scenes))
        context = few.frames // 2 // TOKEN_FRAMES * TOKEN_FRAMES
        rows = [("recorded", few), *self.made(pl_module, few, context)]
        body = getattr(getattr(trainer, "datamodule", None), "body", None)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "samples.png"
            cpu = [(label, scene.to("cpu")) for label, scene in rows]
            body = None if body is None else copy.deepcopy(body).to("cpu")
            title = f"step {trainer.global_step}"
            contact_sheet(cpu, path, self.columns, context_frames=context, body=body, title=title)
            self.send(trainer, Image.open(path).convert("RGB"))

    def made(self, model: LightningModule, scene: Scene, context: int) -> list[tuple[str, Scene]]:
        """What a model makes of scenes, with a label; nothing if the model is not ours."""
        if isinstance(model, Tokenizer):
            return [("decoded", model.reconstruct(scene))]
        if not isinstance(model, Denoiser):
            return []
        generator = torch.Generator(device=scene.device).manual_seed(derive(self.seed, "pictures"))
        frames = scene.frames - context
        cond = model.condition(scene)
        sampled = generate(model, scene, self.task, context, frames, 1, self.sampler, generator, cond=cond)
        return [("sampled", sampled)]

    def send(self, trainer: Trainer, picture: Image.Image) -> None:
        """Hand a picture to every logger that takes one, or write it."""
        taken = False
        loggers: list[Any] = list(trainer.loggers)
        for logger in loggers:
            if hasattr(logger, "log_image"):  # Weights & Biases
                logger.log_image(key=TAG, images=[picture], step=trainer.global_step)
            elif hasattr(getattr(logger, "experiment", None), "add_image"):  # TensorBoard
                logger.experiment.add_image(TAG, np.asarray(picture), trainer.global_step, dataformats="HWC")
            else:
                continue
            taken = True
        if not taken:
            folder = Path(trainer.default_root_dir) / "pictures"
            folder.mkdir(parents=True, exist_ok=True)
            picture.save(folder / f"step_{trainer.global_step:08d}.png")
