"""What may be given as a model: a trained denoiser, or what `magnet.load` returns around one."""

from __future__ import annotations

from typing import Any, Protocol

from magnet.denoiser.core import DenoiserCore


class Loaded(Protocol):
    """What `magnet.load` returns: a trained denoiser with its sampler."""

    @property
    def denoiser(self) -> DenoiserCore: ...


def denoiser_of(model: DenoiserCore | Loaded) -> DenoiserCore:
    """The denoiser of what `magnet.load` returns, whose sampler is not read; or the denoiser itself.

    Raises:
        ValueError: neither.
    """
    denoiser: Any = getattr(model, "denoiser", model)
    if not hasattr(denoiser, "require_tokenizer"):
        raise ValueError(f'model: got {type(model).__name__}, expected a model, such as magnet.load("duet")')
    found: DenoiserCore = denoiser
    return found
