"""Training that starts from another denoiser: its transformer, and its tokenizer where none is given."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from magnet import weights
from magnet.denoiser.statistics import with_pairwise_metres
from magnet.tokenizer.module import RawPose, Tokenizer

if TYPE_CHECKING:
    from magnet.denoiser.module import Denoiser


def tokenizer_of(path: str | Path) -> Tokenizer | RawPose:
    """The tokenizer inside a denoiser's checkpoint, or inside a shipped model by name.

    Raises:
        ValueError: no denoiser's checkpoint.
    """
    checkpoint = denoiser_of(path)
    if checkpoint["tokenizer_hyper_parameters"] is not None:
        return Tokenizer.load(path)
    raw = RawPose()
    raw.load_state_dict(_part(checkpoint["state_dict"], "tokenizer."))
    return raw


def denoiser_of(path: str | Path) -> dict[str, Any]:
    """A denoiser's checkpoint.

    Raises:
        ValueError: no such checkpoint, or another model's.
    """
    checkpoint = weights.read(weights.resolve(path))
    if "tokenizer_hyper_parameters" not in checkpoint:
        raise ValueError(
            f"start_from: {path} is not a denoiser's checkpoint, for it carries no tokenizer; a tokenizer's is given "
            "with --model.tokenizer"
        )
    return checkpoint


def start_from(model: Denoiser, path: str | Path) -> None:
    """Take over another denoiser's transformer, and how tokens are normalized where both tokenizers are the same.

    With another tokenizer latents mean something else, and `model.normalizer` is left to be fitted anew.

    Raises:
        ValueError: the checkpoint is of a model of other sizes.
    """
    state = denoiser_of(path)["state_dict"]
    try:
        model.transformer.load_state_dict(_part(state, "transformer."))
    except RuntimeError as error:
        reason = str(error).splitlines()[1].strip()
        raise ValueError(
            f"start_from: {path} does not fit this model: {reason}; sizes, --data.max_agents and --data.window_frames "
            "must be those of that checkpoint"
        ) from error
    theirs, mine = _part(state, "tokenizer."), model.tokenizer.state_dict()
    same = theirs.keys() == mine.keys() and all(torch.equal(value, mine[name].cpu()) for name, value in theirs.items())
    if same:
        model.normalizer.load_state_dict(_part(state, "normalizer."))
        _rescale(model)


@torch.no_grad()
def _rescale(model: Denoiser) -> None:
    """Another scale of pairwise transforms, with weights that make the same of it."""
    before = model.normalizer.std.clone()
    after = with_pairwise_metres(model.layout, before, model.hparams["pairwise_metres"])
    model.normalizer.std.copy_(after)
    grown = after / before
    first, last = model.transformer.in_proj[0], model.transformer.out_proj
    assert isinstance(first, nn.Linear)
    first.weight[:, : len(grown)].mul_(grown)
    last.weight.div_(grown[:, None])
    last.bias.div_(grown)


def _part(state: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}
