"""Metrics of all test scenes and of all but one, again and again: what differences between methods are judged by."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torchmetrics import MetricCollection

from magnet.evaluation.scoring import TRAINING, TRUTH, Scoring
from magnet.metrics import (
    BodyDepth,
    Diversity,
    FootSkating,
    FrechetBySecond,
    FrechetDistance,
    Interpenetration,
    MotionInteraction,
    PositionError,
    VelocityError,
)

SHOWN = ("fd", "div", "mi", "fs", "ip_ratio", "mpjpe", "mpjve", "fd_pair", "mpjpe_best", "mpjpe@1s")
"""Numbers that are kept of each cell: the paper's seven, and three of ours."""

COPIED = ", the given scored too"
"""What is behind the name of a row in which people who were given are scored, too."""

Row = dict[str, float]


class Folds:
    """Metrics by independent unit of scenes, fed as a `MetricCollection` is.

    Args:
        fps: frames a second.
        compares: also measure how far the motion is from the recording; False: the motion alone.
        everybody: score people who were given as well; their motion is the recording's.
    """

    def __init__(self, fps: float, compares: bool = True, everybody: bool = False) -> None:
        self.fps, self.compares, self.everybody = fps, compares, everybody
        self.units: dict[int, MetricCollection] = {}

    def _metrics(self) -> MetricCollection:
        chosen: dict[str, Any] = {
            "FD": FrechetDistance(fps=self.fps),
            "FD pair": FrechetBySecond("pair", fps=self.fps),
            "MI": MotionInteraction(),
            "FS": FootSkating(fps=self.fps),
            "IP": Interpenetration(),
            "depth": BodyDepth(),
        }
        if self.compares:
            chosen |= {"DIV": Diversity(), "MPJPE": PositionError(self.fps), "MPJVE": VelocityError(self.fps)}
        return MetricCollection(chosen, compute_groups=False)

    def update(self, joints: Tensor, future: Tensor, present: Tensor, agents: Tensor, units: Tensor) -> None:
        """(S, B, T, P, 22, 3), (B, T, P, 22, 3), (B, P), (1, T, P) bool, and (B,) int: each scene's unit."""
        if self.everybody:
            agents = torch.ones_like(agents)
        for unit in units.unique().tolist():
            here = units == unit
            if unit not in self.units:
                self.units[unit] = self._metrics()
            self.units[unit].update(joints[:, here], future[here], present[here], agents=agents)

    def rows(self) -> tuple[Row, dict[int, Row]]:
        """Numbers of all units together, and without each of them; of a single unit there is no without."""
        units = sorted(self.units)
        without = {left: self._together([unit for unit in units if unit != left]) for left in units}
        return self._together(units), {left: row for left, row in without.items() if row}

    def _together(self, units: list[int]) -> Row:
        if not units:
            return {}
        merged = copy.deepcopy(self.units[units[0]])
        for unit in units[1:]:
            for name, metric in merged.items():
                metric.merge_state(self.units[unit][name])
        values = {name: float(value) for name, value in merged.compute().items() if name in SHOWN}
        return {name: value for name, value in values.items() if math.isfinite(value)}


class FoldScoring(Scoring):
    """`Scoring` whose numbers come with those of all scenes but one.

    Where somebody is not generated at all, each method has a second row, in which everybody is scored.
    """

    def _metrics(self, fps: float) -> Any:
        measured = [*self.methods, TRAINING] if self.windows is not None else list(self.methods)
        self.folds = {TRUTH: Folds(fps, False), **{name: Folds(fps, name != TRAINING) for name in measured}}
        alone = bool((~self.sees(self.slots).generated).all(dim=0).any())
        self.copied = {name: Folds(fps, everybody=True) for name in self.given_methods if alone}
        self.fed = {name: _Both(folds, self.copied.get(name)) for name, folds in self.folds.items()}
        return self.fed

    def shown(self) -> dict[str, NDArray[np.float32]]:
        """By method: the first sample of the first scene, in the world that scenes share. -> each (T, P, 22, 3)"""
        first = {name: fed.first for name, fed in self.fed.items() if name != TRAINING}
        return {name: joints.cpu().float().numpy() for name, joints in first.items() if joints is not None}

    def rows(self) -> dict[str, dict[str, Any]]:
        """By method: `value`, and `without` each unit."""
        found = {}
        for name, folds in [*self.folds.items(), *((name + COPIED, folds) for name, folds in self.copied.items())]:
            value, without = folds.rows()
            if name == TRUTH:  # at no distance from itself
                value, without = _of_motion(value), {unit: _of_motion(row) for unit, row in without.items()}
            found[name] = {"value": value, "without": {str(unit): row for unit, row in without.items()}}
        return found


class _Both:
    """One batch to both rows of a method; remembers the first sample of the first scene."""

    def __init__(self, folds: Folds, copied: Folds | None) -> None:
        self.all = [folds] if copied is None else [folds, copied]
        self.first: Tensor | None = None

    def update(self, joints: Tensor, future: Tensor, present: Tensor, **kwargs: Tensor) -> None:
        if self.first is None:
            self.first = joints[0, 0][:, present[0]]
        for folds in self.all:
            folds.update(joints, future, present, **kwargs)


def _of_motion(row: Mapping[str, float]) -> Row:
    return {name: value for name, value in row.items() if name in ("fs", "ip_ratio")}
