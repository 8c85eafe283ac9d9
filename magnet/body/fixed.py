"""Who must not be moved, a mask `fixed` of one of three shapes: (P,) throughout, (T, P) in which frames of all scenes,
or (B, T, P) in which frames of each, where B may be 1 for all scenes; None: nobody."""

from __future__ import annotations

from torch import Tensor


def fixed_in(fixed: Tensor | None, frames: slice | Tensor) -> Tensor | None:
    """The mask of some of the frames. frames (F,) int, or a slice"""
    return fixed if fixed is None or fixed.ndim == 1 else fixed[..., frames, :]


def fixed_of(fixed: Tensor | None, some: slice | Tensor, scenes: int) -> Tensor | None:
    """The mask of some of so many scenes. some (S,) int, or a slice"""
    return fixed if fixed is None or fixed.ndim < 3 or len(fixed) != scenes else fixed[some]


def fixed_anywhere(fixed: Tensor) -> Tensor:
    """Who is fixed in some frame, and so is not moved as a whole. -> (P,), or (B, P) bool"""
    return fixed if fixed.ndim == 1 else fixed.any(dim=-2)
