"""Reads a tokenizer's checkpoint without running code in it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from magnet import checkpoints

SHAPING = {
    "network": ("width", "depth", "causal", "lookahead", "embed_dim"),
    "quantizer": ("kind", "codebook_size", "codebook_dim", "num_quantizers", "levels"),
}
"""Options that decide the shape of the weights, or what they mean, by their groups."""


def shaping(fields: Mapping[str, Any]) -> dict[str, Any]:
    """The options of `SHAPING` that some fields hold, by flag: `network.width`."""
    found: dict[str, Any] = {}
    for group, names in SHAPING.items():
        said = fields.get(group) or {}
        found |= {f"{group}.{name}": said[name] for name in names if name in said}
    unused = ("levels",) if found.get("quantizer.kind") != "fsq" else SHAPING["quantizer"][1:4]
    return {name: value for name, value in found.items() if name.removeprefix("quantizer.") not in unused}


def read_checkpoint(path: str | Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Fields and weights of a tokenizer, from its checkpoint, from that of a denoiser, or by a shipped model's name.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged, or holds no tokenizer.
    """
    path = checkpoints.named(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such tokenizer checkpoint; train one with `magnet fit`")
    checkpoints.verify(path)
    try:
        checkpoint = checkpoints.load(path, mmap=True)
    except Exception as error:  # whatever a damaged or foreign file makes torch raise
        reason = str(error).strip().split("\n")[0]
        raise ValueError(
            f"{path}: not a tokenizer's checkpoint ({type(error).__name__}: {reason}); expected one written by "
            f"`magnet fit`"
        ) from error
    held = checkpoints.contents(checkpoint)
    if held not in ("a tokenizer", "a denoiser") or "hyper_parameters" not in checkpoint:
        raise ValueError(
            f"{path}: not a tokenizer's checkpoint, it holds {held}; expected one that `magnet fit --model Tokenizer` "
            "wrote, or a denoiser's, which carries its tokenizer"
        )
    fields, state = checkpoint["hyper_parameters"], checkpoint["state_dict"]
    if "tokenizer_hyper_parameters" in checkpoint:
        fields = checkpoint["tokenizer_hyper_parameters"]
        if fields is None:
            raise ValueError(f"{path}: this denoiser was trained on raw poses and holds no tokenizer")
        prefix = "tokenizer."
        state = {name[len(prefix) :]: value for name, value in state.items() if name.startswith(prefix)}
    return dict(fields), state


def check_fields(stored: Mapping[str, Any], mine: Mapping[str, Any]) -> None:
    """Raises ValueError where a checkpoint's fields make other weights than `mine`."""
    own = shaping(mine)
    for name, there in shaping(stored).items():
        if name in own and plain_value(there) != plain_value(own[name]):
            raise ValueError(
                f"{name}: the checkpoint's tokenizer has {there}, this one {own[name]}; "
                f"give --model.{name} {there}, or start without the checkpoint"
            )


def plain_value(value: Any) -> Any:
    """Tuples as the lists that files make of them."""
    return list(value) if isinstance(value, tuple) else value


def check_weights(path: Path, state: Mapping[str, Tensor], expected: Mapping[str, Tensor], fields: object) -> None:
    """Raises ValueError that names the first weight of a checkpoint that is missing or of another shape."""
    if missing := sorted(expected.keys() - state.keys()):
        raise ValueError(f"{path}: not a tokenizer's checkpoint: it lacks {', '.join(missing[:3])}")
    for name, want in expected.items():
        if state[name].shape != want.shape:
            raise ValueError(
                f"{path}: {name} is {tuple(state[name].shape)}, expected {tuple(want.shape)} by its fields {fields}"
            )
