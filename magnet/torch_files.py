"""Reads tensors that torch saved as NumPy arrays, without running code in the file."""

from __future__ import annotations

import io
import pickle
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from magnet.errors import DataError
from magnet.files import ANYHOW, RATIO
from magnet.unpickle import AGAIN, contents


def load_tensors(path: str | Path) -> Any:
    """What torch.save wrote: dicts, lists, numbers and text as they are, tensors as arrays.

    Raises:
        DataError: it cannot be read, or holds anything else than tensors and plain values.
    """
    try:
        held = torch.load(io.BytesIO(contents(path)), map_location="cpu", weights_only=True)
    except DataError:
        raise
    except pickle.UnpicklingError as error:
        raise DataError(
            f"{path}: not a whole file of torch's, or one that holds more than tensors and plain values, which is not "
            "loaded because it can run code. If you trust it, load it by torch.load(FILE, weights_only=False) and save "
            "plain arrays"
        ) from error
    except Exception as error:  # damaged archives raise what they like
        raise DataError(f"{path}: not a file that torch.save wrote; {AGAIN}") from error
    return _arrays(path, held)


def _arrays(path: str | Path, held: Any) -> Any:
    """Tensors replaced by arrays."""
    if isinstance(held, dict):
        return {key: _arrays(path, value) for key, value in held.items()}
    if isinstance(held, list | tuple):
        return [_arrays(path, value) for value in held]
    if not isinstance(held, Tensor):
        return held
    try:
        plain = held.detach().float() if held.dtype == torch.bfloat16 else held.detach()
        if plain.numel() * plain.itemsize > max(ANYHOW, RATIO * plain.untyped_storage().nbytes()):  # strides of 0
            raise DataError(f"{path}: a tensor of {tuple(plain.shape)}, more numbers than the file has; {AGAIN}")
        return plain.numpy()
    except (RuntimeError, TypeError) as error:  # sparse, quantized
        raise DataError(f"{path}: a tensor that is no plain array ({held.layout}, {held.dtype})") from error
