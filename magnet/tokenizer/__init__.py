"""Tokenizer: four frames of one person's pose to one vector of a codebook, and back (paper 3.1)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from magnet.tokenizer.quantizer import Quantized, ResidualVQ
from magnet.tokenizer.raw import RawPose

if TYPE_CHECKING:
    from magnet.tokenizer.module import Tokenizer

__all__ = ["Quantized", "RawPose", "ResidualVQ", "Tokenizer"]


if not TYPE_CHECKING:  # else type checkers would take any name for one of ours

    def __getattr__(name: str) -> Any:
        if name != "Tokenizer":
            raise AttributeError(f"module 'magnet.tokenizer' has no attribute {name!r}; it has {', '.join(__all__)}")
        from magnet.tokenizer.module import Tokenizer  # its training needs Lightning, its use does not

        return Tokenizer
