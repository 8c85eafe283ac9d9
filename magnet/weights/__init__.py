"""Trained models that come with the package, and the format they are kept in.

A released model is a folder: `config.json` (how to build it, what it was trained on, a hash of every
part) and tensors in safetensors files of at most 16 MB. Nothing in it can run code.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO
from safetensors.torch import load_file, save_file
from torch import Tensor

FOLDER = Path(__file__).parent
DEFAULT = "duet"
PART_BYTES = 16_000_000
FORMAT = 1

KEPT = ("hyper_parameters", "tokenizer_hyper_parameters", "magnet_config")


def names() -> list[str]:
    """Models that come with the package."""
    return sorted(path.parent.name for path in FOLDER.glob("*/config.json"))


def resolve(name_or_path: str | Path | None = None) -> Path:
    """The checkpoint that a name or path means; None is the model that comes with the package.

    Raises:
        ValueError: neither a model of the package nor a file.
    """
    if name_or_path is None:
        name_or_path = DEFAULT
    shipped = FOLDER / str(name_or_path)
    if (shipped / "config.json").exists():
        return shipped
    path = Path(name_or_path)
    if path.exists():
        return path
    there = ", ".join(names()) or "none"
    raise ValueError(f"no checkpoint {name_or_path}: not a file, nor a model that comes with the package ({there})")


def read(path: str | Path) -> dict[str, Any]:
    """A checkpoint as Lightning wants it, from a released folder or a file of Lightning's own.

    Raises:
        ValueError: not a checkpoint, damaged, or of a later format.
    """
    path = Path(path)
    if path.is_dir():
        return _read_folder(path)
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise
    except Exception as error:
        raise ValueError(
            f"{path}: not a checkpoint that can be read safely ({type(error).__name__}: {error})"
        ) from error


def _read_folder(folder: Path) -> dict[str, Any]:
    if not (folder / "config.json").exists():
        raise ValueError(f"{folder}: a folder without config.json is no released model")
    config = json.loads((folder / "config.json").read_text())
    if config["format"] > FORMAT:
        raise ValueError(f"{folder}: weights format {config['format']}, this version reads up to {FORMAT}")
    state: dict[str, Tensor] = {}
    for part in config["parts"]:
        file = folder / part["file"]
        if not file.exists():
            raise ValueError(f"{file} is missing: fetch the release again")
        if hashlib.sha256(file.read_bytes()).hexdigest() != part["sha256"]:
            raise ValueError(f"{file} is damaged: its hash is not the one in config.json")
        state |= {name: _widen(value) for name, value in load_file(file).items()}
    return {
        "state_dict": state,
        "pytorch-lightning_version": "2.6.4",
        "epoch": 0,
        "global_step": config["steps"],
        **{name: config[name] for name in KEPT},
    }


def _widen(value: Tensor) -> Tensor:
    return value.float() if value.dtype == torch.float16 else value


def with_decoder(checkpoint: dict[str, Any], tokenizer: dict[str, Any]) -> dict[str, Any]:
    """A denoiser's checkpoint with the decoder of a tokenizer that was trained on with `decoder_only`.

    Raises:
        ValueError: the tokenizer's codes mean something else: it has other codes, statistics or another encoder.
    """
    state = dict(checkpoint["state_dict"])
    for name, value in tokenizer["state_dict"].items():
        own = f"tokenizer.{name}"
        if name.startswith("vqvae.decoder."):
            state[own] = value
        elif name.startswith(("vqvae.", "codebook.codes")) and not torch.equal(state[own], value):
            raise ValueError(f"this decoder belongs to other codes than the denoiser's: {name} differs")
    return checkpoint | {"state_dict": state, "tokenizer_hyper_parameters": dict(tokenizer["hyper_parameters"])}


def write(checkpoint: dict[str, Any], folder: Path, about: dict[str, Any] | None = None, half: bool = True) -> Path:
    """Release a checkpoint as a folder.

    Args:
        checkpoint: as Lightning saved it.
        folder: made if missing; older parts in it are removed.
        about: for config.json: what the model was trained on, and how.
        half: keep two-dimensional and larger weights in float16; statistics stay as they are.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("*.safetensors"):
        old.unlink()
    exact = ("statistics", "mean", "std")
    state = {
        name: value.half()
        if half and value.is_floating_point() and value.dim() > 1 and not _any(exact, name)
        else value
        for name, value in checkpoint["state_dict"].items()
    }
    parts: list[dict[str, Tensor]] = [{}]
    size = 0
    for name, value in state.items():
        weight = value.numel() * value.element_size()
        if parts[-1] and size + weight > PART_BYTES:
            parts.append({})
            size = 0
        parts[-1][name] = value.contiguous()
        size += weight
    listed = []
    for number, part in enumerate(parts, 1):
        file = folder / f"weights-{number:02d}.safetensors"
        save_file(part, file)
        listed.append({"file": file.name, "sha256": hashlib.sha256(file.read_bytes()).hexdigest()})
    config = {
        "format": FORMAT,
        "steps": int(checkpoint.get("global_step", 0)),
        "parts": listed,
        **{name: checkpoint.get(name) for name in KEPT},
        "about": about or {},
    }
    (folder / "config.json").write_text(json.dumps(config, indent=1, default=str) + "\n")
    return folder


def _any(parts: tuple[str, ...], name: str) -> bool:
    return any(part in name for part in parts)


class CheckpointIO(TorchCheckpointIO):
    """Lets Lightning load released folders as it loads its own checkpoints; never unpickles anything else."""

    def load_checkpoint(self, path: Any, map_location: Any = None, weights_only: bool | None = None) -> dict[str, Any]:
        return read(path)
