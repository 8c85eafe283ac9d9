"""A made-up body in the layout of SMPL-X's (or SMPL's) npz, for trying readers without the licensed file."""

from __future__ import annotations

from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from magnet.body.joints import WRISTS
from magnet.synthesis.people import SOLE

Kind = Literal["smplx", "smpl"]

ORIGIN = (0.0, -0.35, 0.01)
"""Rest pelvis of the mean shape, metres: as with SMPL-X far from the file's origin, so `transl` is not the pelvis."""
CORNERS = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=np.float64)
SIDES = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
SOLES = (10, 11)
"""Balls of the feet, whose octahedra reach down to the floor."""


def write_body(path: str | Path, kind: Kind = "smplx") -> Path:
    """Write the made-up body: the open body's rest joints, each with a small octahedron about it. Returns the path.

    smplx: 55 joints, 20 shape columns, posedirs (V, 3, 486). smpl: 24 joints, 10 columns, posedirs (V, 3, 207). The
    pelvis is 35 cm from the origin and moves with the shape. Always the same bytes. Folders of the npz are made.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, **arrays(kind))  # type: ignore[arg-type]
    return path


@lru_cache(maxsize=2)
def arrays(kind: Kind = "smplx") -> dict[str, NDArray]:
    """The body file's arrays by key."""
    J, dirs, parents = _joints(kind)
    K = len(J)
    size = np.where(np.arange(K) < 22, 0.05, 0.012)
    size[list(SOLES)] = SOLE
    regressor = np.zeros((K, 6 * K))
    v = (J[:, None] + size[:, None, None] * CORNERS).reshape(-1, 3)
    regressor[np.repeat(np.arange(K), 6), np.arange(6 * K)] = 1 / 6
    columns = 20 if kind == "smplx" else 10
    shapedirs = np.zeros((6 * K, 3, columns))
    shapedirs[:, :, :10] = np.repeat(dirs, 6, axis=0)
    weights = np.zeros((6 * K, K))
    weights[np.arange(6 * K), np.repeat(np.arange(K), 6)] = 1.0
    faces = (6 * np.arange(K)[:, None, None] + SIDES).reshape(-1, 3)
    kintree = np.stack([np.where(parents < 0, 2**32 - 1, parents), np.arange(K)])
    return {
        "v_template": v.astype(np.float32),
        "shapedirs": shapedirs.astype(np.float32),
        "posedirs": np.zeros((6 * K, 3, 9 * (K - 1)), dtype=np.float32),
        "J_regressor": regressor.astype(np.float32),
        "weights": weights.astype(np.float32),
        "kintree_table": kintree.astype(np.uint32),
        "f": faces.astype(np.uint32),
        "body_id": np.array(f"made-up-{kind}"),
    }


def _joints(kind: Kind) -> tuple[NDArray, NDArray, NDArray]:
    """Rest joints (K, 3), what shape numbers add to them (K, 3, 10), parents (K,)."""
    with (
        resources.as_file(resources.files("magnet.body") / "open_body.npz") as path,
        np.load(path, allow_pickle=False) as file,
    ):
        J, dirs = file["J_template"].astype(np.float64), file["J_shapedirs"].astype(np.float64)
        parents = file["kintree_table"][0].astype(np.int64)
    parents[0] = -1
    J = J - J[0] + ORIGIN
    dirs = dirs - dirs[:1]
    dirs[:, 1, 0] += 0.012  # the whole body, so that J0 depends on the shape
    dirs[:, 2, 1] += 0.004
    if kind == "smpl":
        hands = [int(np.flatnonzero(parents == wrist)[0]) for wrist in WRISTS]
        keep = [*range(22), *hands]
        return J[keep], dirs[keep], np.array([*parents[:22], *WRISTS])
    return J, dirs, parents
