"""Body files as SMPL hands them out: pickles of Python 2 with arrays of chumpy and a sparse regressor, all made up."""

from __future__ import annotations

import copyreg
import pickle
import sys
import types
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magnet.datamodules.fakes.body import Kind, arrays


class Ch:
    """An array of chumpy, as its pickles describe one: everything in __dict__, numbers under x."""

    def __init__(self, x: NDArray | None = None, **state: Any) -> None:
        self.__dict__ = {"_dirty_vars": {"x"}, "_itr": None, "_parents": {}, "_cache": {"r": None, "drs": {}}}
        self.__dict__ |= state if x is None else {"x": x}

    def __reduce_ex__(self, protocol: int) -> Any:
        if protocol < 2:  # as Python 2 reduces instances of a new class
            return copyreg._reconstructor, (type(self), object, None), self.__dict__  # type: ignore[attr-defined]
        return copyreg.__newobj__, (type(self),), self.__dict__  # type: ignore[attr-defined]


class Select(Ch):
    pass


class Reshape(Ch):
    pass


class Transpose(Ch):
    pass


class MatVecMult(Ch):
    pass


class csc_matrix(Ch):
    """SciPy's, by the names that it had in Python 2."""


PLACES: dict[str, list[type]] = {
    "chumpy": [],
    "chumpy.ch": [Ch],
    "chumpy.ch_ops": [MatVecMult],
    "chumpy.reordering": [Select, Reshape, Transpose],
    "scipy.sparse.csc": [csc_matrix],
}


@contextmanager
def named_as_the_real_ones() -> Iterator[None]:
    """The classes above under the names that pickles of the real ones hold."""
    before = {name: sys.modules.get(name) for name in PLACES}
    for name, classes in PLACES.items():
        module = types.ModuleType(name)
        for one in classes:
            one.__module__, one.__qualname__ = name, one.__name__
            setattr(module, one.__name__, one)
        sys.modules[name] = module
    try:
        yield
    finally:
        for name, module_before in before.items():
            if module_before is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module_before


def sparse(dense: NDArray) -> csc_matrix:
    """A matrix by columns, as SciPy's instances keep it."""
    columns, rows = np.nonzero(dense.T)
    ends = np.concatenate([[0], np.cumsum(np.bincount(columns, minlength=dense.shape[1]))])
    state = {"_shape": dense.shape, "maxprint": 50, "indices": rows.astype(np.int32), "indptr": ends.astype(np.int32)}
    return csc_matrix(**state, data=dense[rows, columns], format="csc")


def smpl_dict(kind: Kind = "smpl") -> dict[str, Any]:
    """What basicModel_neutral_lbs_10_207_0_v1.0.0.pkl holds, of the made-up body."""
    held = dict(arrays(kind))
    del held["body_id"]
    double = {key: held[key].astype(np.float64) for key in ("v_template", "shapedirs", "posedirs", "weights")}
    return {
        **held,
        **{key: Ch(value) for key, value in double.items()},
        "J_regressor": sparse(held["J_regressor"].astype(np.float64)),
        "J_regressor_prior": sparse(np.eye(3)),
        "J": MatVecMult(mtx=sparse(np.eye(3)), vec=Ch(np.ones(3))),
        "bs_style": "lbs",
        "bs_type": "lrotmin",
        "pose_training_info": {"preprocessed": True, "subjects": ["a", "b"]},
    }


def write_smpl_pkl(path: Path, kind: Kind = "smpl", protocol: int = 0, **changes: Any) -> Path:
    """The made-up body as SMPL's pickle."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with named_as_the_real_ones():
        path.write_bytes(pickle.dumps({**smpl_dict(kind), **changes}, protocol=protocol))
    return path
