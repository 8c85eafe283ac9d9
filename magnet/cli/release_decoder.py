"""The decoder of a released model: that of a tokenizer which was trained on by itself."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from magnet import checkpoints


def require_kind(checkpoint: dict[str, Any], kind: str) -> None:
    """Raises ValueError where a checkpoint is not of a `denoiser`, or not of a `tokenizer`."""
    state = checkpoint.get("state_dict") or {}
    found = "denoiser" if any(name.startswith("tokenizer.") for name in state) else "tokenizer"
    if not state or found != kind:
        raise ValueError(f"got a {found if state else 'file without weights'}, expected a {kind}'s checkpoint")


def with_decoder(checkpoint: dict[str, Any], tokenizer: dict[str, Any]) -> dict[str, Any]:
    """A denoiser's checkpoint with the decoder of a tokenizer that was trained on with `decoder_only`.

    Raises:
        ValueError: it is no tokenizer, or its codes mean something else: it has other codes, statistics or another
            encoder.
    """
    require_kind(tokenizer, "tokenizer")
    state = dict(checkpoint["state_dict"])
    for name, value in tokenizer["state_dict"].items():
        own = f"tokenizer.{name}"
        if name.startswith("vqvae.decoder."):
            state[own] = value
        elif name.startswith(("vqvae.", "quantizer.codes")) and not torch.equal(state[own], value):
            raise ValueError(f"this decoder belongs to other codes than the denoiser's: {name} differs")
    return checkpoint | {"state_dict": state, "tokenizer_hyper_parameters": dict(tokenizer["hyper_parameters"])}


def decoder_kept(state: dict[str, Tensor], replaced: Path) -> dict[str, Any]:
    """The record of the decoder's run in a released folder, where its decoder is the checkpoint's; else nothing."""
    said = replaced / "config.json"
    record = (json.loads(said.read_bytes()).get("about") or {}).get("decoder run") if said.is_file() else None
    if record is None:
        return {}
    before = checkpoints.read(replaced)["state_dict"]
    names = [name for name in before if name.startswith("tokenizer.vqvae.decoder.")]
    same = all(name in state and torch.equal(state[name].half(), before[name].half()) for name in names)
    return {"decoder run": record} if same else {}
