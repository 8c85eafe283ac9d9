"""What torch compiles if it can, and on a GPU a whole evaluation as one CUDA graph."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch._dynamo.exc import TorchDynamoException

from magnet.cuda_graphs import CudaGraph, replayed
from magnet.packing import Kept

Run = Callable[..., Any]

GRAPHS: Kept[dict[tuple[Any, ...], CudaGraph]] = Kept(lambda network: {})
"""CUDA graphs of a model's evaluations, of each kind of question, as long as its weights stay."""


def answered(
    model: Any, noisy: Tensor, levels: Tensor, present: Tensor, cond: Tensor | None, compiled: bool
) -> Tensor | None:
    """What `Denoiser.denoise` answers, by a CUDA graph of it, in which the network runs as it is trained.

    None: it was not asked for, or this is no GPU, or the question has a condition or wants a gradient.
    """
    if not compiled or cond is not None or noisy.device.type != "cuda" or torch.is_grad_enabled():
        return None
    return replayed(GRAPHS.of(model), model.denoise, {"noisy": noisy, "levels": levels, "present": present})


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
        try:
            return self._chosen(*given)
        except TorchDynamoException as error:  # what torch raises of a missing C++ compiler, too
            return self._as_written(str(error).strip().splitlines()[0])(*given)

    def _as_written(self, why: str) -> Run:
        warnings.warn(f"{self.option}: goes on without, {why}", stacklevel=3)
        self._chosen = self.run
        return self.run
