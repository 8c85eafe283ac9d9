"""What torch compiles if it can, and on a GPU a whole evaluation as one CUDA graph."""

from __future__ import annotations

import itertools
import warnings
import weakref
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from magnet.cuda_graphs import CudaGraph, replayed
from magnet.denoiser.transformer import is_sharded

Run = Callable[..., Any]

_GRAPHS: weakref.WeakKeyDictionary[nn.Module, tuple[list[int], dict[tuple[Any, ...], CudaGraph]]]
_GRAPHS = weakref.WeakKeyDictionary()
"""CUDA graphs of a model's evaluations, and where its numbers lie that these read: other values there are seen."""


def answered(
    model: Any, noisy: Tensor, levels: Tensor, present: Tensor, cond: Tensor | None, compiled: bool
) -> Tensor | None:
    """What `Denoiser.denoise` answers, by a CUDA graph of it, in which the network runs as it is trained.

    None: it was not asked for, or cannot be: this is no GPU, or the question has a condition or wants a gradient, or
    weights lie in shards, or this is a crowd, which asks in views that change.
    """
    if not compiled or cond is not None or not records(noisy) or torch.is_grad_enabled():
        return None
    if "denoise" in vars(model) or is_sharded(model.transformer):
        return None
    where = [each.data_ptr() for each in itertools.chain(model.parameters(), model.buffers())]
    kept = _GRAPHS.get(model)
    if kept is None or kept[0] != where:
        kept = _GRAPHS[model] = (where, {})
    return replayed(kept[1], model.denoise, {"noisy": noisy, "levels": levels, "present": present})


def records(tensor: Tensor) -> bool:
    """Whether what runs on this tensor's device can be recorded."""
    return tensor.device.type == "cuda"


class Compiled:
    """A function that is compiled at its first call; where that cannot be, it says so once and runs as it is written.

    What is compiled serves all numbers of tokens; one scene and several are compiled apart. torch keeps it on disk for
    later runs (the folder of TORCHINDUCTOR_CACHE_DIR).

    Args:
        run: the function, of tensors.
        option: what asked for it, for the message.
        refused: why it cannot be compiled here; None: it is tried.
    """

    def __init__(self, run: Run, option: str, refused: str | None = None) -> None:
        self.run, self.option, self.refused = run, option, refused
        self._chosen: Run | None = None

    def __call__(self, *given: Any) -> Any:
        if self._chosen is None:
            if self.refused is not None:
                return self._as_written(self.refused)(*given)
            self._chosen = torch.compile(self.run, dynamic=True)
        from torch._dynamo.exc import TorchDynamoException  # two seconds, and only who compiles needs it

        try:
            return self._chosen(*given)
        except TorchDynamoException as error:  # what torch raises of a missing C++ compiler, too
            return self._as_written(str(error).strip().splitlines()[0])(*given)

    def _as_written(self, why: str) -> Run:
        warnings.warn(f"{self.option}: goes on without, {why}", stacklevel=3)
        self._chosen = self.run
        return self.run
