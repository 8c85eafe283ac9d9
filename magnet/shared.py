"""Work that several runs in one process share: while `sharing()`, what is asked for again is not made again."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable, Hashable, Iterator
from typing import Any, TypeVar

from torch import Tensor

T = TypeVar("T")

_KEPT: list[dict[Hashable, Any]] = []


@contextlib.contextmanager
def sharing() -> Iterator[None]:
    """Keep all that is made `once` in memory, until the end of the block."""
    _KEPT.append({})
    try:
        yield
    finally:
        _KEPT.pop()


def is_sharing() -> bool:
    """Whether anything is kept: a key that costs something need not be made where nothing is."""
    return bool(_KEPT)


def once(key: Hashable, make: Callable[[], T]) -> T:
    """What `make` gives; while `sharing()`, what it gave when the key was asked for first. Nobody may change it.

    >>> with sharing():
    ...     once("a list", list) is once("a list", list)
    True
    >>> once("a list", list) is once("a list", list)
    False
    """
    if not _KEPT:
        return make()
    kept = _KEPT[-1]
    if key not in kept:
        kept[key] = make()
    return kept[key]


def digest(*tensors: Tensor | None) -> str:
    """Of tensors on the CPU: of their shapes, types and all their numbers."""
    found = hashlib.blake2b(digest_size=16)
    for tensor in tensors:
        found.update(b"none" if tensor is None else f"{tensor.dtype}{tuple(tensor.shape)}".encode())
        if tensor is not None:
            found.update(tensor.detach().contiguous().numpy().data)
    return found.hexdigest()
