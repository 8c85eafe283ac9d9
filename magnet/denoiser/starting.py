"""Training that starts from another denoiser: its transformer, and its tokenizer where none is given."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from magnet import checkpoints
from magnet.denoiser.pairwise_posterior import PairwisePosterior
from magnet.denoiser.statistics import with_pairwise_metres
from magnet.denoiser.transformer import Transformer
from magnet.motion.tokens import TokenLayout
from magnet.tokenizer.base import PoseTokenizer
from magnet.tokenizer.core import TokenizerCore
from magnet.tokenizer.normalizer import Normalizer
from magnet.tokenizer.raw import RawPose


def tokenizer_of(path: str | Path) -> TokenizerCore | RawPose:
    """The tokenizer inside a denoiser's checkpoint, or inside a shipped model by name.

    Raises:
        ValueError: no denoiser's checkpoint.
    """
    checkpoint = denoiser_of(path)
    if checkpoint["tokenizer_hyper_parameters"] is not None:
        return TokenizerCore.load(path)
    raw = RawPose()
    raw.load_state_dict(_part(checkpoint["state_dict"], "tokenizer."))
    return raw


def denoiser_of(path: str | Path) -> dict[str, Any]:
    """A denoiser's checkpoint.

    Raises:
        ValueError: no such checkpoint, or another model's.
    """
    checkpoint = checkpoints.read(checkpoints.resolve(path))
    checkpoints.require_denoiser(checkpoint, f"start_from: {path}", "a tokenizer is given with --model.tokenizer")
    return checkpoint


def start_from(
    path: str | Path,
    transformer: Transformer,
    tokenizer: PoseTokenizer,
    normalizer: Normalizer,
    pairwise_metres: float = 0.0,
    posterior: PairwisePosterior | None = None,
) -> None:
    """Take over another denoiser's transformer, and how tokens are normalized where both tokenizers are the same.

    With another tokenizer latents mean something else, and the normalizer is left to be fitted anew.

    Args:
        path: checkpoint of a denoiser, or the name of a shipped model.
        transformer: filled.
        tokenizer: the new model's; compared.
        normalizer: filled, where it can be.
        pairwise_metres: another scale of pairwise transforms; the weights are changed so that they make the same of it.
        posterior: filled where the other denoiser has one; its deviations, in metres and radians, know no scale.

    Raises:
        ValueError: the checkpoint is of a model of other sizes.
    """
    state = denoiser_of(path)["state_dict"]
    unconditional = {
        name: x for name, x in transformer.state_dict().items() if name.startswith(("cond_proj", "no_cond"))
    }
    try:
        transformer.load_state_dict(unconditional | _part(state, "transformer."))
    except RuntimeError as error:
        reason = str(error).splitlines()[1].strip()
        raise ValueError(
            f"start_from: {path} does not fit this model: {reason}; sizes, --data.max_agents and --data.window_frames "
            "must be those of that checkpoint"
        ) from error
    learnt = _part(state, "posterior.")
    if posterior is not None and learnt:
        posterior.load_state_dict(learnt)
    theirs, mine = _part(state, "tokenizer."), tokenizer.state_dict()
    same = theirs.keys() == mine.keys() and all(torch.equal(value, mine[name].cpu()) for name, value in theirs.items())
    if same:
        normalizer.load_state_dict(_part(state, "normalizer."))
        _rescale(transformer, normalizer, transformer.layout, pairwise_metres)


@torch.no_grad()
def _rescale(transformer: Transformer, normalizer: Normalizer, layout: TokenLayout, metres: float) -> None:
    """Another scale of pairwise transforms, with weights that make the same of it."""
    before = normalizer.std.clone()
    normalizer.std.copy_(with_pairwise_metres(layout, before, metres))
    grown = normalizer.std / before
    first, last = transformer.in_proj[0], transformer.out_proj
    assert isinstance(first, nn.Linear)
    first.weight[:, : len(grown)].mul_(grown)
    last.weight.div_(grown[:, None])
    last.bias.div_(grown)


def _part(state: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}
