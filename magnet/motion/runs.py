"""Masks over time: runs of True, and what stands in for the rest."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from magnet.motion.scene import Scene

Number = TypeVar("Number", bound=np.floating[Any])


def true_runs(mask: NDArray[np.bool_] | Sequence[bool], least: int = 1) -> list[tuple[int, int]]:
    """Runs of True that are at least so long, as (start, stop). mask (T,)

    >>> true_runs([True, True, False, True])
    [(0, 2), (3, 4)]
    """
    edges = np.flatnonzero(np.diff(np.asarray(mask, dtype=np.int8), prepend=0, append=0))
    return [(int(start), int(stop)) for start, stop in edges.reshape(-1, 2) if stop - start >= least]


def filled(array: NDArray[Number], valid: NDArray[np.bool_]) -> NDArray[Number]:
    """Fill invalid frames with the last valid frame before them, or else the first one. (T, P, ...), (T, P)"""
    if valid.all():
        return array
    T = len(valid)
    seen = np.maximum.accumulate(np.where(valid, np.arange(T)[:, None], -1), axis=0)
    take = np.where(seen < 0, valid.argmax(axis=0), seen)
    return array[take, np.arange(valid.shape[1])]


def held(scene: Scene, good: Tensor) -> Scene:
    """The scene with the last good pose before them in frames that are not good, or else the first. good (B, T) bool

    >>> from magnet.testing import random_scene
    >>> scene = random_scene(1, 3, 2, torch.Generator().manual_seed(0))
    >>> torch.equal(held(scene, torch.tensor([[True, False, True]])).body_rot[:, 1], scene.body_rot[:, 0])
    True
    """
    if bool(good.all()):
        return scene
    frames = torch.arange(scene.frames, device=good.device)
    last = torch.where(good, frames, -1).cummax(dim=1).values
    take = torch.where(last < 0, good.int().argmax(dim=1, keepdim=True), last)
    each = torch.arange(scene.scenes, device=good.device)[:, None]
    return scene.replace(body_rot=scene.body_rot[each, take], T_world_root=scene.T_world_root[each, take])
