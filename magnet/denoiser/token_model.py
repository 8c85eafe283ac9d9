"""`TokenModel`: what networks over motion tokens share in training."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor

from magnet import checkpoints
from magnet.body import Body, load_body
from magnet.denoiser.statistics import token_statistics
from magnet.denoiser.token_core import TokenModelCore
from magnet.precision import require_float32_scenes
from magnet.tokenizer.core import TokenizerCore
from magnet.training import origins
from magnet.training.optim import Trained


class TokenModel(TokenModelCore, Trained):
    """Base of networks that are trained to predict motion tokens: `TokenModelCore` as a LightningModule."""

    _body: tuple[Body, ...] = ()  # in a tuple, so that it is no part of the model that is saved and averaged
    origin: origins.Origin | None = None  # of its weights; None: nobody recorded it

    def keep(self, options: dict[str, Any]) -> None:
        # As a dictionary: inside a command line that builds another module, Lightning would store that one's fields.
        self.save_hyperparameters(options)

    @property
    def device(self) -> torch.device:
        return super(TokenModelCore, self).device  # Lightning's, which is known before there are parts

    # -- where its weights come from -------------------------------------------------------------

    @classmethod
    def load(cls, name_or_path: str | Path | None = None) -> Self:
        model = super().load(name_or_path)
        model.origin = origins.begun(checkpoints.DEFAULT if name_or_path is None else name_or_path)
        return model

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        super().on_save_checkpoint(checkpoint)
        origins.put(self.origin, None if self._trainer is None else self.require_body().id, checkpoint)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        super().on_load_checkpoint(checkpoint)
        self.origin = origins.taken(checkpoint)

    # -- before training ------------------------------------------------------------------------

    def setup(self, stage: str) -> None:
        require_float32_scenes(self.trainer.precision)

    def begin(self) -> None:
        if not self.normalizer.ready:
            self._fit_statistics()

    @torch.no_grad()
    def _fit_statistics(self) -> None:
        """z-scores from the first training batches; the same on every rank, because ranks draw alike here."""
        data: Any = getattr(self.trainer, "datamodule", None)
        if not hasattr(data, "statistics_batches"):
            self.require_statistics()
        scenes = [scene.to(self.device) for scene in data.statistics_batches()]
        if not isinstance(self.tokenizer, TokenizerCore):  # a `Tokenizer` has been trained
            self.tokenizer.fit_normalizers(scenes)
        parts = [self.tokenize(scene) for scene in scenes]
        self.fit_normalizer(torch.cat([tokens for tokens, _ in parts]), torch.cat([there for _, there in parts]))

    def fit_normalizer(self, tokens: Tensor, there: Tensor) -> None:
        """Set how tokens are normalized from real ones, as `tokenize` returns them."""
        self.normalizer.set(*token_statistics(self.layout, tokens, there, narrow=self.narrow))

    def require_body(self) -> Body:
        """The body whose joints decoded losses compare, on this model's device."""
        if not self._body:
            datamodule = getattr(self._trainer, "datamodule", None)
            # A copy, because this one moves to the model's device.
            self._body = (copy.deepcopy(getattr(datamodule, "body", None) or load_body()).to(self.device),)
        return self._body[0]
