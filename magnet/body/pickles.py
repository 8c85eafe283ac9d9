"""SMPL's pickled body files, read without chumpy or SciPy and without running code in them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from magnet.errors import DataError
from magnet.unpickle import StandIn, contents, unpickled


class _Nothing(StandIn):
    """A class whose numbers are not needed."""

    def real(self, inner: Callable[[Any], Any]) -> None:
        """None."""


class _Chumpy(StandIn):
    """An array of chumpy: `Ch` holds numbers, other classes compute theirs from another array."""

    def real(self, inner: Callable[[Any], Any]) -> NDArray:
        """The array's numbers."""
        if "x" in self.state:
            return _numbers(inner(self.state["x"]))
        return self.made(_numbers(inner(self.state.get("a"))), inner)

    def made(self, a: NDArray, inner: Callable[[Any], Any]) -> NDArray:
        """The numbers, computed from the array `a`."""
        raise DataError("an array of chumpy holds no numbers")

    def shape(self, key: str, size: int, inner: Callable[[Any], Any]) -> tuple[int, ...]:
        """The shape under a key of its state; it must hold `size` numbers."""
        found = tuple(int(n) for n in np.ravel(inner(self.state.get(key))))
        if min(found, default=0) < 0 or math.prod(found) != size:
            raise DataError(f"{size} numbers of chumpy for an array of shape {found}")
        return found


class _Select(_Chumpy):
    """chumpy.reordering.Select: elements of a flattened array by index."""

    def made(self, a: NDArray, inner: Callable[[Any], Any]) -> NDArray:
        at = _numbers(inner(self.state.get("idxs"))).astype(np.int64).ravel()
        if at.size and not (at.min() >= 0 and at.max() < a.size):
            raise DataError(f"chumpy takes number {at.max()} of {a.size}")
        shape = self.state.get("preferred_shape")
        return a.ravel()[at].reshape(self.shape("preferred_shape", at.size, inner) if shape is not None else at.shape)


class _Reshape(_Chumpy):
    """chumpy.reordering.Reshape."""

    def made(self, a: NDArray, inner: Callable[[Any], Any]) -> NDArray:
        return a.reshape(self.shape("newshape", a.size, inner))


class _Transpose(_Chumpy):
    """chumpy.reordering.Transpose."""

    def made(self, a: NDArray, inner: Callable[[Any], Any]) -> NDArray:
        axes = inner(self.state.get("axes"))
        order = tuple(range(a.ndim))[::-1] if axes is None else tuple(int(axis) for axis in np.ravel(axes))
        if sorted(order) != list(range(a.ndim)):
            raise DataError(f"chumpy puts axes {order} of {a.ndim} in order")
        return a.transpose(order)


class _Sparse(StandIn):
    """A compressed sparse matrix of scipy."""

    by_column: ClassVar[bool] = True

    def real(self, inner: Callable[[Any], Any]) -> NDArray:
        """As a dense matrix."""
        state = {key.lstrip("_"): value for key, value in self.state.items() if isinstance(key, str)}
        parts = {key: _numbers(inner(state.get(key))).ravel() for key in ("data", "indices", "indptr", "shape")}
        rows, columns = (int(n) for n in parts["shape"]) if parts["shape"].size == 2 else (0, 0)
        many, across = (columns, rows) if self.by_column else (rows, columns)
        ends, indices = parts["indptr"].astype(np.int64), parts["indices"].astype(np.int64)
        counts = ends[1:] - ends[:-1]
        sound = 0 < many * across < LARGEST and len(counts) == many and bool((counts >= 0).all())
        sound = sound and ends[0] == 0 and ends[-1] == len(indices) == len(parts["data"])
        if not sound or (indices.size and not 0 <= indices.min() <= indices.max() < across):
            raise DataError(f"a sparse matrix of {rows} rows and {columns} columns that its numbers do not fit")
        dense = np.zeros((many, across))
        np.add.at(dense, (np.repeat(np.arange(many), counts), indices), parts["data"])
        return dense.T if self.by_column else dense


class _Rows(_Sparse):
    by_column = False


LARGEST = 10**7
"""Most elements of a dense matrix: SMPL-X's joints by vertices are half a million."""


def _instance(kind: Any, *_: object) -> Any:
    """Stands for copyreg's function that makes instances; only stand-ins may be made."""
    if not (isinstance(kind, type) and issubclass(kind, StandIn)):
        raise DataError("the pickle makes an instance of something that is no class")
    return kind()


STAND_INS: dict[str, Any] = {
    "copyreg _reconstructor": _instance,
    "copy_reg _reconstructor": _instance,
    "builtins object": StandIn,
    "__builtin__ object": StandIn,
    "chumpy.ch Ch": _Chumpy,
    "chumpy.reordering Select": _Select,
    "chumpy.reordering Reshape": _Reshape,
    "chumpy.reordering Transpose": _Transpose,
    **{
        f"scipy.sparse.{module} {kind}_{what}": stand_in
        for kind, stand_in in (("csc", _Sparse), ("csr", _Rows))
        for module in (kind, f"_{kind}")
        for what in ("matrix", "array")
    },
}
"""What body files may name besides numpy's arrays."""


def stand_in(module: str, name: str) -> Any:
    """The stand-in for a class in a body file; unknown classes of chumpy and SciPy become `_Nothing`."""
    known = STAND_INS.get(f"{module} {name}")
    return known or (_Nothing if module.split(".")[0] in ("chumpy", "scipy", "weakref") else None)


def pickled_arrays(path: Path, keys: Sequence[str]) -> tuple[dict[str, NDArray], set[str]]:
    """The arrays under `keys` in a pickled body file, as far as they are there, and all its keys.

    Raises:
        DataError: damaged, no dict, or it names a class that is not admitted.
    """
    held = unpickled(contents(path), str(path), stand_in)
    if not isinstance(held, dict):
        raise DataError(f"{path}: holds a {type(held).__name__}, expected a dict of SMPL's arrays")
    return {key: np.asarray(held[key]) for key in keys if key in held}, set(map(str, held))


def _numbers(held: Any) -> NDArray:
    if not isinstance(held, np.ndarray | list | tuple | int | float | np.generic):
        raise DataError(f"a {type(held).__name__} where numbers were expected")
    array = np.asarray(held)
    if array.dtype.kind not in "iufb":
        raise DataError(f"an array of {array.dtype} where numbers were expected")
    return array
