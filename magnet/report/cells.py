"""Cells: the small jobs that tables are made of, and the files of those that are done."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from magnet.files import write_whole

Kind = Literal["train", "measure", "speed", "long"]
FORMAT = 1


@dataclass(frozen=True)
class Budget:
    """How much is spent on every cell alike.

    Args:
        scenes: test scenes at most.
        samples: futures of each.
        seeds: of sampling, or of training where something is trained.
        steps: of each training; None: as its configuration says.
        frames: of a long generation.
        speed_rounds: how often a speed is taken; the median counts.
    """

    scenes: int
    samples: int
    seeds: int
    steps: int | None
    frames: int
    speed_rounds: int


BUDGETS = {
    "tiny": Budget(2, 2, 2, 2, 40, 1),
    "small": Budget(8, 5, 3, None, 300, 3),
    "paper": Budget(1_000_000, 10, 3, None, 1800, 5),
}
"""`tiny` is for tests, `small` for two cores and a day, `paper` for a GPU and the paper's own data."""


@dataclass(frozen=True)
class Weights:
    """Where weights come from: a checkpoint that is there, or a training of this report.

    Args:
        checkpoint: shipped name or path; None: `config` is trained.
        config: name of a configuration to train, without .yaml.
        steps: of its training; None: as the configuration says.
        digest: of the weights' file, or of the configuration with all that it extends.
    """

    checkpoint: str | None = None
    config: str | None = None
    steps: int | None = None
    digest: str = ""


@dataclass(frozen=True)
class Cell:
    """One job; equal cells are one.

    Args:
        kind: train a configuration; measure a task; take its speed; generate for long.
        seed: of everything.
        data: salsa, synthetic2 to synthetic4, or a file of data options.
        model: what is measured or trained; None: baselines and floors.
        task: name of the task.
        task_options: as `name=value`, sorted.
        sampler: options other than the budget's preset, as `name=value`, sorted.
        leak: `pairs`: pairwise transforms are as clean as their token, the paper read literally.
        scenes: test scenes at most.
        samples: of each.
        frames: generated, of a long generation.
    """

    kind: Kind
    seed: int
    data: str = ""
    model: Weights | None = None
    task: str = ""
    task_options: tuple[tuple[str, Any], ...] = ()
    sampler: tuple[tuple[str, Any], ...] = ()
    leak: str = ""
    scenes: int = 0
    samples: int = 0
    frames: int = 0

    @property
    def needs(self) -> Cell | None:
        """The training whose weights are used."""
        if self.kind == "train" or self.model is None or self.model.config is None:
            return None
        return Cell("train", self.seed, model=self.model)

    @property
    def settings(self) -> dict[str, Any]:
        """All that the result depends on, JSON-ready."""
        return json.loads(json.dumps({"format": FORMAT, **asdict(self)}))

    @property
    def name(self) -> str:
        """Of its file: readable, and unlike that of any other cell."""
        of = "" if self.model is None else self.model.config or Path(str(self.model.checkpoint)).stem
        words = [self.kind, of or "floors", self.task, Path(self.data).stem, self.leak, f"seed{self.seed}"]
        digest = hashlib.sha256(json.dumps(self.settings, sort_keys=True).encode()).hexdigest()[:10]
        return re.sub(r"[^A-Za-z0-9_-]+", "_", "-".join(word for word in words if word)) + f"-{digest}"


@dataclass
class Store:
    """Results of cells in a folder, one JSON file each, whole or not there.

    Args:
        folder: of the report.
    """

    folder: Path
    kept: dict[str, dict[str, Any]] = field(default_factory=dict)

    def path(self, cell: Cell) -> Path:
        return self.folder / "cells" / f"{cell.name}.json"

    def get(self, cell: Cell) -> dict[str, Any] | None:
        """What a cell gave; None where it is not done, or was done by other settings."""
        path = self.path(cell)
        if cell.name not in self.kept and path.is_file():
            try:
                content = json.loads(path.read_text(encoding="utf-8"))
            except ValueError:
                return None  # not ours: what is ours is whole
            if content.get("settings") == cell.settings:
                self.kept[cell.name] = content
        return self.kept.get(cell.name)

    def put(self, cell: Cell, result: Mapping[str, Any]) -> dict[str, Any]:
        """Keep what a cell gave: written aside, then renamed, so that a kill leaves all of it or nothing."""
        content = {"settings": cell.settings, **result}
        text = json.dumps(content, indent=1, sort_keys=True, allow_nan=False)
        path = self.path(cell)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path.parent, path.name, text.encode())
        self.kept[cell.name] = json.loads(text)
        return self.kept[cell.name]

    def of_kind(self, kind: Kind) -> list[float]:
        """Seconds that finished cells of a kind took."""
        seconds = []
        for path in sorted((self.folder / "cells").glob(f"{kind}-*.json")):
            try:
                seconds.append(float(json.loads(path.read_text(encoding="utf-8"))["seconds"]))
            except (ValueError, KeyError):
                continue
        return seconds
