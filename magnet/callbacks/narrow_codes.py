"""A tokenizer's codes in few numbers, at the end of its training."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.utilities import rank_zero_info

from magnet import checkpoints
from magnet.checks import require_whole
from magnet.tokenizer.module import Tokenizer
from magnet.tokenizer.narrow import narrowed
from magnet.version import __version__

NAME = "narrow.ckpt"


class NarrowCodes(Callback):
    """Writes narrow.ckpt beside a tokenizer's last.ckpt when its training is over; see `narrowed` (ours).

    A denoiser's `--model.tokenizer` and a decoder's `--model.start_from` take it as any tokenizer.

    Args:
        size: numbers of a code.
    """

    def __init__(self, size: int = 18) -> None:
        require_whole("size", size, 2)
        self.size = size

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        kept = trainer.checkpoint_callback
        done = trainer.global_step >= trainer.max_steps > 0 or trainer.current_epoch == trainer.max_epochs
        if not done or not isinstance(kept, ModelCheckpoint) or not kept.dirpath or not trainer.is_global_zero:
            return
        assert isinstance(pl_module, Tokenizer)
        wide = copy.deepcopy(pl_module).cpu().eval()
        scenes = [scene.to(wide.device) for scene in trainer.datamodule.statistics_batches()]  # type: ignore[attr-defined]
        made, lost = narrowed(wide, scenes, self.size)
        path = Path(kept.dirpath) / NAME
        fields: dict[str, Any] = {"state_dict": made.state_dict(), "hyper_parameters": dict(made.hparams)}
        pl_module.on_save_checkpoint(fields)  # where its weights come from
        checkpoints.save({**fields, "global_step": trainer.global_step, "magnet_version": __version__}, path)
        rank_zero_info(f"{path}: codes of {self.size} numbers, which leave out {lost:.2%} of the variance of latents")
