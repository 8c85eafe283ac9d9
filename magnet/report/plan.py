"""What tables are made of: rows of cells, blocks of rows, orderings that are claimed, and what cells are made for."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from magnet import checkpoints
from magnet.files import file_hash
from magnet.report.cells import Budget, Cell, Kind, Weights

PAPER: dict[str, Any] = json.loads((Path(__file__).parent / "paper.json").read_text(encoding="utf-8"))
COLUMNS: tuple[str, ...] = tuple(PAPER["columns"])
FLOORS = ("RS", "NN", "zero velocity", "ridge", "training set", "ground truth")
"""Rows of the cell without a model."""
SHIPPED = "duet"
OURS = "ours"


@dataclass(frozen=True)
class Row:
    """A line of a table.

    Args:
        title: as the page names it.
        cells: one a seed.
        inside: name of the row in these cells.
    """

    title: str
    cells: tuple[Cell, ...]
    inside: str = OURS


@dataclass(frozen=True)
class Claim:
    """An ordering that the paper states.

    Args:
        metric: of which.
        better: title of the row that is said to have the lower number; of DIV and frames a second the higher.
        worse: title of the other.
        place: where the paper says so.
    """

    metric: str
    better: str
    worse: str
    place: str

    @property
    def lower(self) -> bool:
        """Whether the better one is the lower."""
        return self.metric not in ("div", "fps", "times_shipped")


@dataclass(frozen=True)
class Block:
    """A table's part on one task and data set.

    Args:
        title: what is measured.
        rows: its lines.
        claims: what the paper says of them.
        columns: what is shown.
    """

    title: str
    rows: tuple[Row, ...]
    claims: tuple[Claim, ...] = ()
    columns: tuple[str, ...] = COLUMNS


@dataclass(frozen=True)
class ReportOptions:
    """What cells are made for.

    Args:
        budget: how much each costs.
        data: name or file of test scenes of two people.
        checkpoint: of our model.
        only_shipped: leave out what has to be trained.
        configs: folder of the trainings' configurations.
        own_seeds: in place of 0, 1, ...
    """

    budget: Budget
    data: str = "salsa"
    checkpoint: str = SHIPPED
    only_shipped: bool = False
    configs: Path = Path("configs/report")
    own_seeds: tuple[int, ...] = ()

    def row(self, title: str, task: str, config: str = "", kind: Kind = "measure", **options: Any) -> Row | None:
        """A row of our checkpoint, or of a configuration that is trained; None where no training is wanted."""
        if config and self.only_shipped:
            return None
        if config:
            digest = digest_of_config(self.configs / f"{config}.yaml")
            model = Weights(config=config, steps=self.budget.steps, batch=self.budget.batch, digest=digest)
        else:
            model = Weights(self.checkpoint, digest=digest_of_weights(self.checkpoint))
        seeds = self.seeds[:1] if kind == "speed" else self.seeds  # a speed has rounds, and does not depend on the draw
        return Row(title, tuple(self._cell(kind, seed, model, task, **options) for seed in seeds))

    @property
    def seeds(self) -> tuple[int, ...]:
        """Of sampling or training."""
        return self.own_seeds or tuple(range(self.budget.seeds))

    def floors(self, task: str, among: Iterable[str] = FLOORS, kind: Kind = "measure", **options: Any) -> list[Row]:
        """Rows without a model; all but RS are the same for every seed, so one is enough."""
        cell = self._cell(kind, self.seeds[0], None, task, **options)
        return [Row(name, (cell,), name) for name in among]

    def _cell(self, kind: Kind, seed: int, model: Weights | None, task: str, **options: Any) -> Cell:
        task_options = tuple(sorted(options.pop("task_options", {}).items()))
        preset = {} if model is None or self.budget.sampler == "default" else {"preset": self.budget.sampler}
        sampler = tuple(sorted({**preset, **options.pop("sampler", {})}.items()))
        cell = Cell(kind, seed, self.data, model, task, task_options, sampler)
        if kind == "measure":
            return replace(cell, scenes=self.budget.scenes, samples=self.budget.samples, **options)
        if kind == "long":
            return replace(cell, scenes=self.budget.scenes, samples=1, frames=self.budget.frames, **options)
        return replace(cell, scenes=1, samples=1, **options)


def digest_of_config(path: Path) -> str:
    """Of a configuration and all that it extends; empty where there is none."""
    if not path.is_file():
        return ""
    text = path.read_text(encoding="utf-8")
    parts = [text, *map(digest_of_config, extended(path, yaml.safe_load(text) or {}))]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:12]


def extended(path: Path, said: dict[str, Any]) -> list[Path]:
    """The files that a configuration extends, by what it says."""
    below = said.get("extends") or []
    return [path.parent / name for name in ([below] if isinstance(below, str) else below)]


@functools.cache
def digest_of_weights(name: str) -> str:
    """Of a checkpoint's file, or of the index of a shipped model's parts."""
    path = checkpoints.resolve(name)
    return file_hash(path / "config.json" if path.is_dir() else path)[:12]
